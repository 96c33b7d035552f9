"""Matching costs: how unlike one image is to another where that shows its points, by normalised correlation of windows, a row at a time."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

WINDOW = 7  # pixels a side that are compared
HALF = WINDOW // 2
RING = 8  # rows that are kept, a power of two: those of a window and the one that leaves it
NOISE = 4.0  # variance (grey levels²) below which a window holds nothing to compare: correlation is drawn to 0 there
UNKNOWN = 0.5  # cost where no neighbour shows anything, which is that of no correlation
GROUP = 16  # planes that are put into a volume at once: as many costs as a cache line holds
LANES = 16  # float32 that a processor takes at once: rows are as many times that long, so that their loops leave no rest to be taken singly
MIDDLE = 128  # is taken from grey levels so that their squares keep their digits
# What is looked up is rounded to quarters of a grey level (adding this leaves no finer digits). Sums of such values, of their squares and
# of their products with whole ones, over a window, are exact in float32, so a window may move on by adding what comes and taking what
# goes.
ROUNDER = 1.5 * 2**21
F = np.float32
OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy"}  # exact: the same whichever way a loop becomes vectors


@njit(**OPTIONS)
def _places(
    height: int, width: int, far: Any, move: Any, inverse: Any, columns: Any, v: int, place: Any, share: Any, inside: Any
) -> None:
    """Where a image of this size shows the points of row `v` at `columns` with the inverse depths `inverse`: upper left pixel, shares of
    its right and lower neighbours, and 1 where it is in the image, 0 elsewhere. A loop of its own, because it becomes vectors, and what
    is read by it not."""
    zero, one, least = F(0), F(1), F(1e-6)
    bottom, right = F(height - 1), F(width - 1)
    bx, by, bz = far[0, 1] * F(v) + far[0, 2], far[1, 1] * F(v) + far[1, 2], far[2, 1] * F(v) + far[2, 2]
    ax, ay, az, mx, my, mz = far[0, 0], far[1, 0], far[2, 0], move[0], move[1], move[2]
    last, below, across = np.int32(width - 2), np.int32(height - 2), np.int32(width)
    for i in range(len(columns)):
        depth, u = inverse[i], columns[i]
        z = az * u + bz + depth * mz
        scale = one / max(z, least)
        x, y = (ax * u + bx + depth * mx) * scale, (ay * u + by + depth * my) * scale
        x_in, y_in = min(max(x, zero), right), min(max(y, zero), bottom)
        inside[i] = one if (z > least) & (x == x_in) & (y == y_in) else zero
        # Whole numbers are bounded once more: what is no number (a camera out of this world) must not be read at.
        column = min(max(np.int32(min(x_in, right - one)), np.int32(0)), last)
        row = min(max(np.int32(min(y_in, bottom - one)), np.int32(0)), below)
        share[0, i], share[1, i] = x_in - F(column), y_in - F(row)
        place[i] = row * across + column


@njit(**OPTIONS)
def _take(quads: Any, place: Any, share: Any, inside: Any, found: Any, out: Any) -> None:
    """Grey levels less `MIDDLE` between the pixels of `quads` (h · w,) at `_places`, in quarters; 0 outside."""
    low, rounder = np.uint32(255), F(ROUNDER)
    for u in range(len(place)):
        found[u] = quads[np.uintp(place[u])]
    across, down = share[0], share[1]
    for u in range(len(place)):
        four = found[u]
        left, right = F(np.int32(four & low)), F(np.int32((four >> np.uint32(8)) & low))
        lower_left, lower_right = F(np.int32((four >> np.uint32(16)) & low)), F(np.int32(four >> np.uint32(24)))
        upper = left + across[u] * (right - left)
        lower = lower_left + across[u] * (lower_right - lower_left)
        value = (upper + down[u] * (lower - upper) - F(MIDDLE) + rounder) - rounder
        out[u] = value if inside[u] > F(0) else F(0)


@njit(**OPTIONS)
def _move_on(new: Any, new_own: Any, old: Any, old_own: Any, sums: Any) -> None:
    """Sums over the rows of a window, (3, wide) of values, squares and products: one row more and one less."""
    values, squares, products = sums[0], sums[1], sums[2]
    for x in range(len(new)):
        come, gone = new[x], old[x]
        values[x] += come - gone
        squares[x] += come * come - gone * gone
        products[x] += come * new_own[x] - gone * old_own[x]


@njit(**OPTIONS)
def _correlated(sums: Any, mean: Any, steep: Any, seen: Any, out: Any) -> None:
    """Costs of a row from the sums over the rows of its windows, which begin `HALF` before their middles, as does what is `seen`; `mean`
    and `steep` (1 / deviation) are those of the windows that they are compared with."""
    zero, half, part_of = F(0), F(0.5), F(1 / (WINDOW * WINDOW))
    values, squares, products = sums[0], sums[1], sums[2]
    for x in range(len(out)):
        value, square, product = zero, zero, zero
        for shift in range(WINDOW):
            value += values[x + shift]
            square += squares[x + shift]
            product += products[x + shift]
        their = value * part_of
        spread = max(square * part_of - their * their, zero) + F(NOISE)
        cost = half - half * (product * part_of - mean[x] * their) * steep[x] / np.sqrt(spread)
        out[x] = cost if seen[x + HALF] > zero else F(-1)


@njit(**OPTIONS)
def correlate(
    own: Any, mean: Any, steep: Any, columns: Any, quads: Any, far: Any, move: Any, inverse: Any, out: Any
) -> None:
    """Costs of one other image, a row at a time: what was warped stays in the cache until all windows that hold it are done.

    Args:
        own, mean, steep: (H, wide) grey levels less `MIDDLE`; mean and 1 / deviation of windows, which begin `HALF` before their middles.
        columns: (wide,) float32 of the image.
        quads: (h, w) of the other image, both at least 2 (`cost_volume.GreyView.quads`).
        far, move: (3, 3) and (3,) of `cost_volume.between`.
        inverse: (H, wide) inverse depths, whose first `HALF` stand before the first column.
        out: (H, wide), −1 where the other image does not show a point; nothing of meaning beyond the image's width.
    """
    height, wide = own.shape
    pixels = quads.reshape(-1)
    place, found, share = np.empty(wide, np.int32), np.empty(wide, np.uint32), np.empty((2, wide), np.float32)
    warped, inside = np.empty((RING, wide), np.float32), np.zeros((RING, wide + LANES), np.float32)
    sums, nothing = np.zeros((3, wide + LANES), np.float32), np.zeros(wide, np.float32)
    bottom = height - 1
    for ahead in range(-HALF, height + HALF):
        new, old = min(max(ahead, 0), bottom), ahead - WINDOW  # rows at the ends are repeated
        come = new % RING
        if ahead == -HALF or 0 < ahead < height:
            _places(quads.shape[0], quads.shape[1], far, move, inverse[new], columns, new, place, share, inside[come])
            _take(pixels, place, share, inside[come], found, warped[come])
        if old < -HALF:
            _move_on(warped[come], own[new], nothing, nothing, sums)
        else:
            old = max(old, 0)
            _move_on(warped[come], own[new], warped[old % RING], own[old], sums)
        y = ahead - HALF
        if y >= 0:
            _correlated(sums, mean[y], steep[y], inside[y % RING], out[y])


@njit(**OPTIONS)
def _best_of_four(costs: Any, out: Any) -> None:
    """`best_half` of four; comparisons without a branch become vectors."""
    zero, never, half = F(0), F(1e3), F(0.5)
    for y in range(costs.shape[1]):
        for x in range(costs.shape[2]):
            a, b, c, d = costs[0, y, x], costs[1, y, x], costs[2, y, x], costs[3, y, x]
            a, b = a if a >= zero else never, b if b >= zero else never
            c, d = c if c >= zero else never, d if d >= zero else never
            low, high, lower, higher = min(a, b), max(a, b), min(c, d), max(c, d)
            first, second = min(low, lower), min(max(low, lower), min(high, higher))
            third = max(max(low, lower), min(high, higher))
            value = first if third >= never else half * (first + second)
            out[y, x] = value if first < never else F(UNKNOWN)


@njit(**OPTIONS)
def _into_order(low: Any, high: Any) -> None:
    """The smaller of each two values into `low`, the larger into `high`."""
    for x in range(len(low)):
        one, other = low[x], high[x]
        low[x], high[x] = min(one, other), max(one, other)


@njit(**OPTIONS)
def best_half(costs: Any, out: Any) -> None:
    """(K, H, W) costs, −1 unknown → (H, W) the mean of the better half of the known ones: the worse half may be hidden behind something.

    Rows are sorted against each other, all their pixels at once: sorting pixel by pixel takes ten times as long.
    """
    count, height, width = costs.shape
    if count == 4:
        _best_of_four(costs, out)
        return
    zero, never = F(0), F(1e3)
    rows, known = np.empty((count, width), np.float32), np.empty(width, np.int32)
    for y in range(height):
        known[:] = 0
        for k in range(count):
            row, given = rows[k], costs[k, y]
            for x in range(width):
                row[x] = given[x] if given[x] >= zero else never
                known[x] += np.int32(given[x] >= zero)
        for turn in range(count):  # odd-even transposition sort
            for k in range(turn & 1, count - 1, 2):
                _into_order(rows[k], rows[k + 1])
        total = out[y]
        total[:] = zero
        for k in range((count + 1) // 2):
            row = rows[k]
            for x in range(width):
                total[x] += row[x] if k < (known[x] + 1) // 2 else zero
        for x in range(width):
            total[x] = total[x] / F((known[x] + 1) // 2) if known[x] > 0 else F(UNKNOWN)
