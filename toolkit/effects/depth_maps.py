"""Depth maps of many frames, asked at points: what the sensor tells there, with its camera where it may stand.

    X_d = R·s·X + t,    r = D(π(X_d)) / (X_d)_z − 1

X: a point in the axes of the picture's camera; D: the depth map; s: a scale.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fieldfuse.camera import Array, Intrinsics, distort
from fieldfuse.capture.calibration import fitted
from fieldfuse.capture.images import load_depth
from fieldfuse.capture.types import Capture
from fieldfuse.poses.points import undistorted
from fieldfuse.progress import SILENT, Progress

SIDE = 320  # pixels along the long side, of larger maps every so manieth is kept
SMOOTH = 0.05  # share of depth within which four pixels are of one surface
LOOKS = 4  # from a guess of where a ray meets the surface to where it does


@dataclass(frozen=True)
class DepthMaps:
    """M maps, one after the other in memory."""

    values: Array  # (sum of pixels,) float32, 0 = missing
    start: Array  # (M,) where each begins
    size: Array  # (M, 2) its width and height
    step: Array  # (M,) pixels of its camera from one of its pixels to the next
    cameras: tuple[Intrinsics, ...]  # (M,) each frame may have its own

    @cached_property
    def _lens(self) -> Array:
        """(M, 4) fx, fy, cx, cy."""
        return np.array([(camera.fx, camera.fy, camera.cx, camera.cy) for camera in self.cameras])

    @cached_property
    def _bent(self) -> list[tuple[Intrinsics, Array]]:
        """Cameras that are no pinholes, and (M,) bool whose they are."""
        kinds = dict.fromkeys(camera for camera in self.cameras if camera.distorted)
        return [(camera, np.array([other == camera for other in self.cameras])) for camera in kinds]

    def off(self, places: Array, which: Array, depth_from_picture: Array, scale: float = 1.0) -> Array:
        """(N,) r; NaN: the four pixels around are not all known, or not of one surface.

        Args:
            places: (N, 3) in the axes of the pictures' cameras.
            which: (N,) int, the map of each.
            depth_from_picture: (4, 4).
        """
        out = np.full(len(places), np.nan)
        places = scale * places @ depth_from_picture[:3, :3].T + depth_from_picture[:3, 3]
        front = np.flatnonzero(places[:, 2] > 0)
        ideal, mine = places[front, :2] / places[front, 2:], which[front]
        for camera, maps in self._bent:
            one = maps[mine]
            ideal[one] = distort(camera, ideal[one])
        lens = self._lens[mine]
        pixels = (ideal * lens[:, :2] + lens[:, 2:] - 0.5) / self.step[mine, None]
        inside = (pixels >= 0).all(axis=1) & (pixels < self.size[mine] - 1).all(axis=1)
        front, pixels, mine = front[inside], pixels[inside], mine[inside]
        whole = pixels.astype(np.intp)
        a, b = (pixels - whole).T
        width = self.size[mine, 0]
        first = self.start[mine] + whole[:, 1] * width + whole[:, 0]
        corners = self.values[np.stack([first, first + 1, first + width, first + width + 1])]
        low, high = corners.min(axis=0), corners.max(axis=0)
        told = (corners[0] * (1 - a) + corners[1] * a) * (1 - b) + (corners[2] * (1 - a) + corners[3] * a) * b
        out[front] = np.where((low > 0) & (high - low < SMOOTH * high), told / places[front, 2] - 1, np.nan)
        return out

    def surface(self, which: int, across: int) -> Array:
        """(N, 3) what one map sees, in the axes of its camera, at `across` pixels along its long side, others as far apart."""
        width, height = self.size[which]
        apart = max(1, int(max(width, height) // across))
        rows, columns = np.mgrid[apart // 2 : height : apart, apart // 2 : width : apart]
        depth = self.values[self.start[which] + rows.ravel() * width + columns.ravel()].astype(np.float64)
        pixels = np.stack([columns.ravel(), rows.ravel()], axis=1)[depth > 0] * self.step[which] + 0.5
        flat = undistorted(self.cameras[which], pixels)
        places = np.concatenate([flat, np.ones((len(flat), 1))], axis=1) * depth[depth > 0, None]
        return np.asarray(places[np.isfinite(places).all(axis=1)])

    def along(self, places: Array, which: Array, depth_from_picture: Array) -> Array:
        """(N,) z at which rays from the pictures' cameras through `places` (N, 3), as in `off`, meet what the sensor sees; NaN: untold."""
        ray, z = places / places[:, 2:], places[:, 2].copy()
        for _ in range(LOOKS):
            z = z * (1 + self.off(ray * z[:, None], which, depth_from_picture))
        return z


def read(capture: Capture, frames: Sequence[int], progress: Progress = SILENT) -> DepthMaps:
    """The maps of the frames `frames`, which all have depth and a camera.

    Raises:
        InputError: a depth map cannot be read.
    """
    maps, sizes, steps, cameras = [], [], [], []
    for index in frames:
        progress.check()
        frame = capture.frames[index]
        depth, camera = load_depth(frame, capture), frame.depth_intrinsics or frame.intrinsics
        assert camera is not None
        cameras.append(fitted(camera, (depth.shape[1], depth.shape[0]), str(frame.depth)))
        step = max(1, round(max(depth.shape) / SIDE))
        depth = depth[::step, ::step]
        maps.append(depth.ravel())
        sizes.append((depth.shape[1], depth.shape[0]))
        steps.append(step)
    start = np.cumsum([0, *(len(one) for one in maps)])[:-1]
    return DepthMaps(np.concatenate(maps), start, np.array(sizes), np.array(steps, float), tuple(cameras))
