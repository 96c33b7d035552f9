"""Sparse points with who sees them: from the source's own points, from depth maps, or from silhouettes."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import binary_erosion

from fieldfuse.camera import Array, project, unproject
from fieldfuse.capture.images import load_depth, load_image, turns_by_exif
from fieldfuse.capture.types import Capture
from fieldfuse.poses.overlap import convergence
from fieldfuse.progress import SILENT, Progress

DEPTH_FRAMES = 40  # depth maps that are sampled
DEPTH_SAMPLES = 1500  # pixels of each
SEEN_FRAMES = 80  # frames into which points without tracks are projected
GRID = 64  # cells a side of the visual hull
HULL_FRAMES = 32
LONG_SIDE = 256  # pixels of the silhouettes
MISSES = 0.05  # share of the frames that look at a cell which may see through it (silhouettes are never perfect)


@dataclass
class Cloud:
    """Points in the input's frame, and observations: which frame sees which point at which depth."""

    points: Array  # (P, 3) float64
    point: Array  # (M,) int64 index into points
    frame: Array  # (M,) int64 index into the capture's frames
    depth: Array  # (M,) float64 along that frame's z
    source: str  # "source", "depth", "triangulated" or "silhouettes"

    @property
    def views(self) -> Array:
        """(P,) number of observations of each point."""
        return np.bincount(self.point, minlength=len(self.points))

    def median_depth(self) -> float:
        """Median over frames of the median depth that each sees."""
        order = np.argsort(self.frame, kind="stable")
        starts = np.flatnonzero(np.diff(self.frame[order], prepend=-1))
        return float(np.median([np.median(part) for part in np.split(self.depth[order], starts[1:])]))

    @classmethod
    def empty(cls, source: str) -> Cloud:
        return cls(np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0), source)


def every(count: int, most: int) -> Array:
    """At most `most` indices spread evenly over range(count)."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64))


def cloud_of_points(capture: Capture, points: Array, source: str) -> Cloud:
    """Points without tracks: each is taken as seen by every frame (of up to 80) that has it inside its image, hidden or not."""
    seen_point, seen_frame, seen_depth = [], [], []
    for i in every(len(capture.frames), SEEN_FRAMES):
        frame = capture.frames[i]
        assert frame.intrinsics is not None and frame.world_from_camera is not None
        # A lens bends far-off points back into the image: the pinhole camera decides which are in view.
        pixels, depth = project(frame.intrinsics.pinhole(), frame.world_from_camera, points)
        with np.errstate(invalid="ignore"):
            inside = (depth > 0) & np.all((pixels >= 0) & (pixels <= [frame.intrinsics.width, frame.intrinsics.height]), axis=1)
        found = np.flatnonzero(inside)
        seen_point.append(found)
        seen_frame.append(np.full(len(found), i))
        seen_depth.append(depth[found])
    return Cloud(points, np.concatenate(seen_point), np.concatenate(seen_frame), np.concatenate(seen_depth), source)


def cloud_of_depth(capture: Capture, progress: Progress = SILENT) -> Cloud:
    """Pixels of some depth maps, unprojected. Every sample is one point with one observation."""
    frames = [i for i, frame in enumerate(capture.frames) if frame.depth is not None]
    random = np.random.default_rng(0)
    points, owner, depths = [], [], []
    chosen = every(len(frames), DEPTH_FRAMES)
    for n, k in enumerate(chosen):
        progress.check()
        progress.update(n, len(chosen), "looking at depth")
        i = frames[k]
        frame = capture.frames[i]
        assert frame.intrinsics is not None and frame.world_from_camera is not None
        depth = load_depth(frame, capture)
        rows, columns = np.nonzero(depth)
        if len(rows) == 0:
            continue
        pick = random.choice(len(rows), min(DEPTH_SAMPLES, len(rows)), replace=False)
        z = depth[rows[pick], columns[pick]].astype(np.float64)
        camera = (frame.depth_intrinsics or frame.intrinsics).pinhole().scaled(depth.shape[1], depth.shape[0])
        pixels = np.stack([columns[pick] + 0.5, rows[pick] + 0.5], axis=1)
        points.append(unproject(camera, frame.world_from_camera, pixels, z))
        owner.append(np.full(len(z), i))
        depths.append(z)
    if not points:
        return Cloud.empty("depth")
    stacked = np.concatenate(points)
    return Cloud(stacked, np.arange(len(stacked)), np.concatenate(owner), np.concatenate(depths), "depth")


def silhouette_cloud(capture: Capture, progress: Progress = SILENT) -> Cloud:
    """Where the object is when images carry alpha: surface cells of a coarse visual hull (Laurentini 1994) as points. Empty when no cell
    lies within all silhouettes."""
    chosen = [int(i) for i in every(len(capture.frames), HULL_FRAMES)]
    exif = turns_by_exif(capture)
    silhouettes = []
    for n, i in enumerate(chosen):
        progress.check()
        progress.update(n, len(chosen), f"silhouette {n + 1} of {len(chosen)}")
        image = load_image(capture.frames[i], exif=exif)
        alpha = image[..., 3] if image.shape[2] == 4 else np.full(image.shape[:2], 255, np.uint8)
        factor = min(1.0, LONG_SIDE / max(alpha.shape))
        small = cv2.resize(alpha, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
        # Grown by a pixel: thin parts must survive the shrinking.
        silhouettes.append(np.asarray(cv2.dilate((small > 16).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0))
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
            return Cloud.empty("silhouettes")
        cells = grid[full & ~binary_erosion(full)]  # those that have an empty neighbour
        low, high = cells.min(axis=0) - 1.5 * size, cells.max(axis=0) + 1.5 * size
    return cloud_of_points(capture, cells, "silhouettes")


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
