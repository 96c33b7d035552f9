"""Where the object is when pictures carry alpha: a coarse visual hull (Laurentini 1994) on a grid of 64³."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.ndimage import binary_erosion

from fieldfuse.camera import Array, project
from fieldfuse.capture.images import load_image, turns_by_exif
from fieldfuse.capture.types import Capture
from fieldfuse.poses.cloud import Cloud, cloud_of_points, every
from fieldfuse.poses.overlap import convergence
from fieldfuse.progress import SILENT, Progress

GRID = 64
FRAMES = 32
LONG_SIDE = 256  # pixels of the silhouettes
MISSES = 0.05  # share of the frames that look at a cell which may see through it (silhouettes are never perfect)


def silhouette_cloud(capture: Capture, progress: Progress = SILENT) -> Cloud:
    """Surface cells of the visual hull as points. Empty when no cell lies within all silhouettes."""
    chosen = [int(i) for i in every(len(capture.frames), FRAMES)]
    exif = turns_by_exif(capture)
    silhouettes = []
    for n, i in enumerate(chosen):
        progress.check()
        progress.update(n, len(chosen), f"silhouette {n + 1} of {len(chosen)}")
        silhouettes.append(_silhouette(load_image(capture.frames[i], exif=exif)))
    poses = np.array([capture.frames[i].world_from_camera for i in chosen], dtype=np.float64)
    point, _, _ = convergence(poses)
    reach = float(np.median(np.linalg.norm(poses[:, :3, 3] - point, axis=1)))
    low, high = point - reach, point + reach
    cells = np.zeros((0, 3))
    for _ in range(2):  # once over all that the cameras surround, once over what was found
        size = (high - low) / GRID
        axes = [low[k] + (np.arange(GRID) + 0.5) * size[k] for k in range(3)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        full = _carved(capture, chosen, silhouettes, grid.reshape(-1, 3)).reshape(GRID, GRID, GRID)
        if not full.any():
            return Cloud(np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0), "silhouettes")
        cells = grid[full & ~binary_erosion(full)]  # those that have an empty neighbour
        low, high = cells.min(axis=0) - 1.5 * size, cells.max(axis=0) + 1.5 * size
    return cloud_of_points(capture, cells, "silhouettes")


def _silhouette(picture: Array) -> Array:
    """(h, w) bool, grown by a pixel: thin parts must survive the shrinking."""
    alpha = picture[..., 3] if picture.shape[2] == 4 else np.full(picture.shape[:2], 255, np.uint8)
    factor = min(1.0, LONG_SIDE / max(alpha.shape))
    small = cv2.resize(alpha, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.dilate((small > 16).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)


def _carved(capture: Capture, chosen: list[int], silhouettes: list[Array], cells: Array) -> Array:
    """(C,) bool: cells that lie within nearly every silhouette of the frames that have them in view, and in view of half of them."""
    looked = np.zeros(len(cells), dtype=np.int32)
    hit = np.zeros(len(cells), dtype=np.int32)
    for i, silhouette in zip(chosen, silhouettes, strict=True):
        frame = capture.frames[i]
        assert frame.intrinsics is not None and frame.world_from_camera is not None
        height, width = silhouette.shape
        pixels, depth = project(frame.intrinsics.scaled(width, height), frame.world_from_camera, cells)
        with np.errstate(invalid="ignore"):
            inside = (depth > 0) & np.all((pixels >= 0) & (pixels < [width, height]), axis=1)
        column, row = pixels[inside, 0].astype(int), pixels[inside, 1].astype(int)
        looked += inside
        hit[inside] += silhouette[row, column]
    return (looked >= 0.5 * len(chosen)) & (looked - hit <= MISSES * looked)
