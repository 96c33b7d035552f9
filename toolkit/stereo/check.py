"""Which depths of several views agree: what other views do not confirm is dropped, what they do is averaged with theirs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numba
import numpy as np

from fieldfuse.camera import Array, Intrinsics, invert

TOLERANCE = 0.02  # share of depth by which two views may differ
HIDDEN = 0.03  # share of a point's depth by which another view's surface before it hides its colour
SPECKLE = 1 / 2000  # share of the picture: smaller patches of kept depth are dropped
NO_PICTURE, NO_COLOURS = np.empty((0, 0, 3), np.uint8), np.empty((0, 0), np.float32)


@dataclass(frozen=True)
class Agreement:
    """What other views say of each pixel of a depth map."""

    agree: Array  # (H, W) int32 how many have the same point …
    through: Array  # … and how many see through it
    total: Array  # (H, W) float64 sum of the inverse depths of the pixel itself and of those that agree
    colours: Array  # (others or 0, H, W) float32 how much the colours there differ, in levels; NaN: hidden, or out of sight


@numba.njit(cache=True, nogil=True)
def _compare(
    depth: Array,
    camera: Array,
    other: Array,
    other_camera: Array,
    there: Array,
    tolerance: float,
    noise: float,
    picture: Array,
    other_picture: Array,
    agree: Array,
    through: Array,
    total: Array,
    colours: Array,
) -> None:
    """Count for each pixel whether one other view confirms its depth or sees through it, and sum up the inverse depths that confirm it.

    Pictures, (H, W, 3) uint8 or of height 0, are compared where nothing stands before the point, whether the other's depth is known or not.
    """
    height, width = depth.shape
    rows, columns = other.shape
    fx, fy, cx, cy = camera
    gx, gy, ox, oy = other_camera
    for y in range(height):
        for x in range(width):
            z = depth[y, x]
            if z <= 0:
                continue
            px, py = (x + 0.5 - cx) / fx * z, (y + 0.5 - cy) / fy * z
            qz = there[2, 0] * px + there[2, 1] * py + there[2, 2] * z + there[2, 3]
            if qz <= 0:
                continue
            qx = there[0, 0] * px + there[0, 1] * py + there[0, 2] * z + there[0, 3]
            qy = there[1, 0] * px + there[1, 1] * py + there[1, 2] * z + there[1, 3]
            u, v = qx / qz * gx + ox, qy / qz * gy + oy
            if not (0 <= u < columns and 0 <= v < rows):
                continue
            column, row = int(u), int(v)
            seen = other[row, column]
            if len(picture) > 0 and not 0 < seen < (1 - HIDDEN) * qz:
                difference = 0.0
                for channel in range(3):
                    difference += abs(float(picture[y, x, channel]) - float(other_picture[row, column, channel]))
                colours[y, x] = difference / 3
            if seen <= 0:
                continue
            if abs(seen - qz) <= max(tolerance, noise * seen) * qz:
                # The other's point, brought back: rotation transposed.
                rx = (column + 0.5 - ox) / gx * seen - there[0, 3]
                ry = (row + 0.5 - oy) / gy * seen - there[1, 3]
                rz = seen - there[2, 3]
                back = there[0, 2] * rx + there[1, 2] * ry + there[2, 2] * rz
                if back > 0:
                    agree[y, x] += 1
                    total[y, x] += 1 / back
            elif seen > qz:
                through[y, x] += 1


def confirmed(
    index: int,
    others: Sequence[int],
    depths: Sequence[Array],
    cameras: Sequence[Intrinsics],
    world_from_camera: Array,
    needed: int = 2,
    tolerance: float = TOLERANCE,
    noise: float = 0.0,
) -> tuple[Array, Array]:
    """The depth map `index` checked against the maps `others`.

    A depth is kept when at least `needed` others have the same point, and more of them than see through it; it becomes the mean, over
    inverse depths, of its own value and theirs. Small patches are dropped.

    Args:
        depths: (H, W) along z, 0 = missing.
        world_from_camera: (N, 4, 4).
        tolerance: share of depth by which two views may differ …
        noise: … or inverse depth, whichever is more: what is far moves by fewer pixels, so it cannot be told as well (`StereoDepth.noise`).

    Returns:
        (H, W) float32 depth, 0 where it is not kept, and (H, W) float32 confidence in [0, 1): a / (a + t + 1) for a others that agree and t
        that see through the point.
    """
    depth, found = depths[index], agreement(index, others, depths, cameras, world_from_camera, tolerance, noise)
    agree, through, total = found.agree, found.through, found.total
    kept = (depth > 0) & (agree >= needed) & (agree > through)
    mean = np.where(kept, (agree + 1) / np.maximum(total, 1e-12), 0)
    kept &= ~_speckles(mean, tolerance)
    confidence = np.where(kept, agree / (agree + through + 1), 0)
    return np.where(kept, mean, 0).astype(np.float32), confidence.astype(np.float32)


def agreement(
    index: int,
    others: Sequence[int],
    depths: Sequence[Array],
    cameras: Sequence[Intrinsics],
    world_from_camera: Array,
    tolerance: float = TOLERANCE,
    noise: float = 0.0,
    pictures: Sequence[Array] | None = None,
) -> Agreement:
    """What the views `others` say of each pixel of the depth map `index`.

    Args:
        depths, world_from_camera, tolerance, noise: as in `confirmed`.
        pictures: (H, W, 3) uint8 of all views, of the size of their depth maps; None: colours are not compared.
    """
    depth = np.ascontiguousarray(depths[index], dtype=np.float32)
    agree, through = np.zeros(depth.shape, np.int32), np.zeros(depth.shape, np.int32)
    total = np.where(depth > 0, 1 / np.maximum(depth, 1e-12), 0)
    colours = np.full((0 if pictures is None else len(others), *depth.shape), np.nan, np.float32)
    for number, other in enumerate(others):
        there = invert(world_from_camera[other]) @ world_from_camera[index]
        theirs = np.ascontiguousarray(depths[other], dtype=np.float32)
        here, away = (depth, numbers(cameras[index])), (theirs, numbers(cameras[other]))
        if pictures is None:
            shown, out = (NO_PICTURE, NO_PICTURE), NO_COLOURS
        else:
            shown, out = (pictures[index], pictures[other]), colours[number]
        _compare(*here, *away, there, tolerance, noise, *shown, agree, through, total, out)
    return Agreement(agree, through, total, colours)


def numbers(camera: Intrinsics) -> Array:
    """(4,) fx, fy, cx, cy for kernels."""
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy])


def _speckles(depth: Array, tolerance: float) -> Array:
    """(H, W) bool: pixels of patches (pixels that differ by little from a neighbour) smaller than `SPECKLE` of the picture."""
    known = depth > 0
    if not known.any():
        return known
    # The filter takes 16-bit whole numbers; steps of the logarithm make its one threshold a share of depth everywhere.
    steps = np.log(np.where(known, depth, 1.0))
    low = float(steps[known].min())
    unit = max(tolerance / 4, (float(steps[known].max()) - low) / 30000)
    levels = np.where(known, np.round((steps - low) / unit) + 1, 0).astype(np.int16)
    out = levels.copy()
    cv2.filterSpeckles(out, 0, int(np.ceil(SPECKLE * depth.size)), round(3 * tolerance / unit))
    return np.asarray((out == 0) & known)
