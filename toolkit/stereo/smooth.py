"""Semi-global matching (Hirschmüller 2008) over a volume of matching costs: smooth depth with steps only where they pay."""

from __future__ import annotations

from collections.abc import Sequence

import numba
import numpy as np

from toolkit.camera import Array

SMALL_STEP = 0.03  # penalty of a change by one plane between neighbouring pixels, in units of the cost (0 to 1)
LARGE_STEP = 1.0  # penalty of any larger change on even ground
SOFT_EDGE = 8.0  # grey levels between two pixels that halve the large penalty: depth steps where colour does
PATHS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1, 1))  # (rows, columns) a path moves on by


@numba.njit(cache=True, nogil=True, fastmath=True)
def _add_path(cost: Array, grey: Array, down: int, right: int, small: float, large: float, soft: float, total: Array) -> None:
    """Add the costs aggregated along one direction to `total` (H, W, D); equation 13 of the paper."""
    height, width, planes = cost.shape
    line = np.zeros((2, width, planes), np.float32)  # aggregated costs of this row and of the one before
    least = np.zeros((2, width), np.float32)
    one = np.float32(small)
    for step_y in range(height):
        y = step_y if down >= 0 else height - 1 - step_y
        now = step_y & 1
        for step_x in range(width):
            x = step_x if right >= 0 else width - 1 - step_x
            before_y, before_x = y - down, x - right
            here, own, out = cost[y, x], line[now, x], total[y, x]
            lowest = np.float32(1e9)
            if before_y < 0 or before_y >= height or before_x < 0 or before_x >= width:
                for d in range(planes):
                    own[d] = here[d]
                    out[d] += here[d]
                    lowest = min(lowest, here[d])
            else:
                row = now if down == 0 else 1 - now
                past, base = line[row, before_x], least[row, before_x]
                jump = large / (1 + abs(grey[y, x] - grey[before_y, before_x]) / soft)
                most = base + np.float32(max(jump, 1.5 * small))
                for d in range(1, planes - 1):
                    value = min(min(past[d], most), min(past[d - 1], past[d + 1]) + one) + here[d] - base
                    own[d] = value
                    out[d] += value
                    lowest = min(lowest, value)
                for d in (0, planes - 1):
                    inner = 1 if d == 0 else planes - 2
                    value = min(min(past[d], most), past[inner] + one) + here[d] - base
                    own[d] = value
                    out[d] += value
                    lowest = min(lowest, value)
            least[now, x] = lowest


@numba.njit(cache=True, nogil=True)
def _lowest(total: Array, plane: Array, margin: Array) -> None:
    """The best plane of each pixel between planes (parabola through three), and how much worse the best one elsewhere is."""
    height, width, planes = total.shape
    for y in range(height):
        for x in range(width):
            values = total[y, x]
            best = 0
            for d in range(1, planes):
                if values[d] < values[best]:
                    best = d
            second = np.float32(1e9)
            for d in range(planes):
                if abs(d - best) > 1:
                    second = min(second, values[d])
            offset = 0.0
            if 0 < best < planes - 1:
                low, mid, high = values[best - 1], values[best], values[best + 1]
                bend = low - 2 * mid + high
                if bend > 1e-9:
                    offset = min(max(0.5 * (low - high) / bend, -0.5), 0.5)
            plane[y, x] = best + offset
            margin[y, x] = (second - values[best]) / max(second, np.float32(1e-6))


def summed_paths(cost: Array, grey: Array, small: float, large: float, paths: Sequence[tuple[int, int]]) -> Array:
    """(H, W, D) float32: costs aggregated along each of these directions (a part of `PATHS`), summed; arguments as in `smoothed_planes`."""
    total = np.zeros_like(cost)
    for down, right in paths:
        _add_path(cost, grey, down, right, small, large, SOFT_EDGE, total)
    return total


def smoothed_planes(
    cost: Array, grey: Array, small: float = SMALL_STEP, large: float = LARGE_STEP, paths: int = len(PATHS)
) -> tuple[Array, Array]:
    """The plane of each pixel that fits best together with its neighbours.

    Args:
        cost: (H, W, D) float32 matching costs, 0 to 1, at least three planes.
        grey: (H, W) float32 picture, 0 to 255.
        paths: how many of the directions in `PATHS` costs are summed along.

    Returns:
        (H, W) float32 plane number with its fraction, and (H, W) float32 relative margin to the best plane that is not its neighbour.
    """
    cost = np.ascontiguousarray(cost, dtype=np.float32)
    grey = np.ascontiguousarray(grey, dtype=np.float32)
    total = summed_paths(cost, grey, small, large, PATHS[:paths])
    plane, margin = np.empty(grey.shape, np.float32), np.empty(grey.shape, np.float32)
    _lowest(total, plane, margin)
    return plane, margin
