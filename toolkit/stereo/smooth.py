"""Semi-global matching (Hirschmüller 2008) over a volume of matching costs: smooth depth with steps only where they pay."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numba
import numpy as np

from fieldfuse.backends.numba.vectors import lesser
from fieldfuse.camera import Array

SMALL_STEP = 0.03  # penalty of a change by one plane between neighbouring pixels, in units of the cost (0 to 1)
LARGE_STEP = 1.0  # penalty of any larger change on even ground
SOFT_EDGE = 8.0  # grey levels between two pixels that halve the large penalty: depth steps where colour does
# Directions that a path moves on by are taken together in two passes over the picture, downwards and to the right, and back: along the row,
# and from the row before straight on and askew.
DOWN, UP = 1, -1
STRAIGHT = (0,)  # columns that a path moves by from row to row
ALL = (0, 1, -1)
PATHS = tuple(path for way in (DOWN, UP) for path in ((0, way), *((way, way * slant) for slant in ALL)))  # (rows, columns)
F = np.float32
HIGH = F(1e9)
OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "fastmath": True, "error_model": "numpy"}
ONE, TWO = np.uintp(1), np.uintp(2)  # places that cannot be negative need not be asked whether they are


@numba.njit(**OPTIONS)
def _begin(cost: Array, total: Array, at: Any, line: Array, own: Any, planes: int) -> Any:
    """The first pixel of a path; arguments and answer as in `_go_on`."""
    lowest = HIGH
    for number in range(planes):
        d = np.uintp(number)
        value = cost[at + d]
        line[own + d + ONE] = value
        total[at + d] += value
        lowest = lesser(lowest, value)
    return lowest


@numba.njit(**OPTIONS)
def _go_on(cost: Array, total: Array, at: Any, line: Array, past: Any, own: Any, planes: int, base: Any, most: Any, small: Any) -> Any:
    """One pixel further along a path; equation 13 of the paper.

    Args:
        cost, total: (H · W · D,) of which those of this pixel begin at `at`; the path's are added to `total`.
        line: costs along the path, of the pixel before from `past` on, of this one from `own` on; each with `HIGH` before and after it.
        base: the lowest cost of the pixel before; most: that and the penalty of a step.

    Returns:
        the lowest cost of this pixel.
    """
    lowest = HIGH
    for number in range(planes):
        d = np.uintp(number)
        stay = lesser(line[past + d + ONE], most)
        value = lesser(stay, lesser(line[past + d], line[past + d + TWO]) + small) + cost[at + d] - base
        line[own + d + ONE] = value
        total[at + d] += value
        lowest = lesser(lowest, value)
    return lowest


@numba.njit(**OPTIONS)
def _add_paths(cost: Array, grey: Array, way: int, slants: tuple[int, ...], small: float, large: float, soft: float, total: Array) -> None:
    """Add the costs aggregated along some directions to `total` (H · W · D,): along the rows, and from row to row with each of `slants`;
    downwards and to the right, or the other `way`."""
    height, width = grey.shape
    planes = len(cost) // max(height * width, 1)
    room = planes + 2
    # Of each direction two rows, this one and the one before; and two pixels of the row's own path.
    lines = np.full((2 * len(slants) * width + 2) * room, HIGH, np.float32)
    least = np.zeros((2, len(slants), width), np.float32)
    single = 2 * len(slants) * width
    step, lowest = F(small), F(0)
    for number in range(height):
        y = number if way > 0 else height - 1 - number
        now = number & 1
        for i in range(width):
            x = i if way > 0 else width - 1 - i
            at = np.uintp((y * width + x) * planes)
            own, past = np.uintp((single + (i & 1)) * room), np.uintp((single + (1 - (i & 1))) * room)
            if i == 0:
                lowest = _begin(cost, total, at, lines, own, planes)
            else:
                jump = max(F(large) / (F(1) + abs(grey[y, x] - grey[y, x - way]) / F(soft)), F(1.5) * step)
                lowest = _go_on(cost, total, at, lines, past, own, planes, lowest, lowest + jump, step)
            for k in range(len(slants)):
                before = x - way * slants[k]
                own = np.uintp(((2 * k + now) * width + x) * room)
                if number == 0 or before < 0 or before >= width:
                    least[now, k, x] = _begin(cost, total, at, lines, own, planes)
                    continue
                past = np.uintp(((2 * k + 1 - now) * width + before) * room)
                jump = max(F(large) / (F(1) + abs(grey[y, x] - grey[y - way, before]) / F(soft)), F(1.5) * step)
                base = least[1 - now, k, before]
                least[now, k, x] = _go_on(cost, total, at, lines, past, own, planes, base, base + jump, step)


@numba.njit(**OPTIONS)
def _lowest(total: Array, plane: Array, margin: Array) -> None:
    """The best plane of each pixel between planes (parabola through three), and how much worse the best one elsewhere is."""
    height, width, planes = total.shape
    for y in range(height):
        for x in range(width):
            values = total[y, x]
            least = HIGH
            for d in range(planes):
                least = lesser(least, values[d])
            best = 0
            while best < planes - 1 and values[best] > least:
                best += 1
            second = HIGH
            for d in range(best - 1):
                second = lesser(second, values[d])
            for d in range(best + 2, planes):
                second = lesser(second, values[d])
            offset = F(0)
            if 0 < best < planes - 1:
                low, mid, high = values[best - 1], values[best], values[best + 1]
                bend = low - F(2) * mid + high
                if bend > F(1e-9):
                    offset = min(max(F(0.5) * (low - high) / bend, F(-0.5)), F(0.5))
            plane[y, x] = F(best) + offset
            margin[y, x] = (second - values[best]) / max(second, F(1e-6))


def summed_paths(cost: Array, grey: Array, small: float, large: float, slants: tuple[int, ...], ways: Sequence[int] = (DOWN, UP)) -> Array:
    """(H, W, D) float32: costs aggregated along the rows and, from row to row, along each of `slants` (`STRAIGHT` or `ALL`), there and
    back, summed; `ways` may name one of both. Other arguments as in `smoothed_planes`."""
    total = np.zeros(cost.size, np.float32)
    for way in ways:
        _add_paths(cost.reshape(-1), grey, way, slants, small, large, SOFT_EDGE, total)
    return total.reshape(cost.shape)


def smoothed_planes(cost: Array, grey: Array, small: float = SMALL_STEP, large: float = LARGE_STEP) -> tuple[Array, Array]:
    """The plane of each pixel that fits best together with its neighbours.

    Args:
        cost: (H, W, D) float32 matching costs, 0 to 1, at least three planes.
        grey: (H, W) picture, 0 to 255.

    Returns:
        (H, W) float32 plane number with its fraction, and (H, W) float32 relative margin to the best plane that is not its neighbour.
    """
    cost = np.ascontiguousarray(cost, dtype=np.float32)
    grey = np.ascontiguousarray(grey, dtype=np.float32)
    total = summed_paths(cost, grey, small, large, ALL)
    plane, margin = np.empty(grey.shape, np.float32), np.empty(grey.shape, np.float32)
    _lowest(total, plane, margin)
    return plane, margin
