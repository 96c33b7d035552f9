"""A checkerboard seen through a lens, for tests. The lens formulas stand here a second time, independent of `fieldfuse.camera`."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import cv2
import numpy as np

from fieldfuse.camera import FISHEYE, Array, Intrinsics
from fieldfuse.capture.types import Capture, Frame

SQUARE = 0.25
DISTANCE = 2.0  # the board lies in the plane z = DISTANCE of a camera at the origin,
TURN = np.array([[0.94, -((1 - 0.94**2) ** 0.5)], [(1 - 0.94**2) ** 0.5, 0.94]])  # turned, so that edges do not run along pixels


def bend(intrinsics: Intrinsics, x: Array, y: Array) -> tuple[Array, Array]:
    """Brown-Conrady with k1, k2, p1, p2, k3 (OpenCV's documentation, camera calibration), or the equidistant fisheye."""
    if intrinsics.lens == FISHEYE:
        k1, k2, k3, k4 = intrinsics.distortion
        radius = np.hypot(x, y)
        theta = np.arctan(radius)
        bent = theta * (1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8)
        scale = np.where(radius > 1e-12, bent / np.maximum(radius, 1e-12), 1.0)
        return x * scale, y * scale
    k1, k2, p1, p2, k3 = (*intrinsics.distortion, 0.0, 0.0, 0.0, 0.0, 0.0)[:5]
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    return x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y


def unbend(intrinsics: Intrinsics, x: Array, y: Array) -> tuple[Array, Array]:
    ideal_x, ideal_y = x.copy(), y.copy()
    for _ in range(15 if intrinsics.distorted else 0):
        bent_x, bent_y = bend(intrinsics, ideal_x, ideal_y)
        ideal_x, ideal_y = ideal_x + (x - bent_x), ideal_y + (y - bent_y)
    return ideal_x, ideal_y


@cache
def photograph(intrinsics: Intrinsics, samples: int = 4) -> Array:
    """(H, W, 3) uint8: the board as this camera sees it, averaged over samples² points of each pixel, slightly blurred."""
    height, width = intrinsics.height, intrinsics.width
    v, u = np.mgrid[0 : height * samples, 0 : width * samples]
    x = ((u + 0.5) / samples - intrinsics.cx) / intrinsics.fx
    y = ((v + 0.5) / samples - intrinsics.cy) / intrinsics.fy
    x, y = unbend(intrinsics, x, y)
    across, along = (TURN[0, 0] * x + TURN[0, 1] * y, TURN[1, 0] * x + TURN[1, 1] * y)
    squares = np.floor(across * DISTANCE / SQUARE) + np.floor(along * DISTANCE / SQUARE)
    sharp = np.where(squares % 2 == 0, np.float32(220), np.float32(40))
    # As optics do: without any blur the picture itself would be aliased, and corners in it ill-defined.
    grey = cv2.GaussianBlur(sharp, (0, 0), 0.7 * samples).reshape(height, samples, width, samples).mean(axis=(1, 3))
    return np.repeat(np.round(grey).astype(np.uint8)[:, :, None], 3, axis=2)


def corners(target: Intrinsics, margin: float = 12) -> Array:
    """(N, 2) pixels (centres at +0.5) where a pinhole camera sees the board's corners, those well inside the picture."""
    steps = np.arange(-20, 21) * SQUARE / DISTANCE
    x, y = (np.stack([grid.ravel() for grid in np.meshgrid(steps, steps)], axis=1) @ TURN).T
    place = np.stack([x * target.fx + target.cx, y * target.fy + target.cy], axis=1)
    return place[((place > margin) & (place < np.array([target.width, target.height]) - margin)).all(axis=1)]


def found_corners(picture: Array, expected: Array, window: int = 4) -> Array:
    """(N, 2) corners (centres at +0.5) located in the picture, the search started at `expected`."""
    # The search assumes a band-limited picture; on ideal steps it is off by up to a quarter of a pixel.
    grey = cv2.GaussianBlur(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), (0, 0), 1.2)
    start = (expected - 0.5).astype(np.float32).reshape(-1, 1, 2).copy()
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 100, 1e-4)
    return np.asarray(cv2.cornerSubPix(grey, start, (window, window), (-1, -1), criteria)[:, 0] + 0.5, dtype=np.float64)


def save(path: Path, picture: Array, *options: int) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    if picture.ndim == 3:
        picture = cv2.cvtColor(picture, cv2.COLOR_RGBA2BGRA if picture.shape[2] == 4 else cv2.COLOR_RGB2BGR)
    assert cv2.imwrite(str(path), picture, list(options))
    return path


def texture(height: int, width: int, seed: int = 0, blur: float = 1.5) -> Array:
    """(H, W, 3) uint8 noise with detail at the scale of `blur` pixels and above."""
    rng = np.random.default_rng(seed)
    noise = sum(cv2.GaussianBlur(rng.normal(size=(height, width, 3)), (0, 0), blur * scale) * scale for scale in (1, 4, 12))
    noise = noise - noise.min()
    return np.asarray(noise / noise.max() * 255).astype(np.uint8)


def posed(path: Path, intrinsics: Intrinsics, index: int = 0, **more: object) -> Frame:
    pose = np.eye(4)
    pose[0, 3] = 0.1 * index
    return Frame(name=path.stem, image=path, intrinsics=intrinsics, world_from_camera=pose, **more)  # type: ignore[arg-type]


def capture_of(root: Path, frames: list[Frame], kind: str = "transforms", **facts: object) -> Capture:
    return Capture(kind=kind, root=root, frames=tuple(frames), **facts)  # type: ignore[arg-type]
