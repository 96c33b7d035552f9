"""Depth maps seen from another place (`capture.depth_reprojection`)."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

Array = np.ndarray[Any, np.dtype[Any]]
CRACK = 0.03  # share of depth by which what shows between two neighbours must lie behind them to be a crack


@numba.njit(cache=True, nogil=True)
def splat_nearest(u: Array, v: Array, z: Array, valid: Array, out: Array) -> None:
    """Write each valid depth z (H, W) to the pixel (u, v) of `out` (H, W); of several the nearest stays."""
    height, width = out.shape
    for y in range(height):
        for x in range(width):
            if not valid[y, x] or not (0 <= u[y, x] < width and 0 <= v[y, x] < height):
                continue
            row, column = int(v[y, x]), int(u[y, x])
            if out[row, column] == 0 or z[y, x] < out[row, column]:
                out[row, column] = z[y, x]


@numba.njit(cache=True, nogil=True)
def close_cracks(out: Array, axis: int) -> None:
    """Fill pixels that are open, or lie behind both neighbours along the axis, where these are of one surface."""
    before = out.copy()
    height, width = out.shape
    down, right = (1, 0) if axis == 0 else (0, 1)
    for y in range(down, height - down):
        for x in range(right, width - right):
            one, other, own = before[y - down, x - right], before[y + down, x + right], before[y, x]
            if one > 0 and other > 0 and abs(one - other) < CRACK * min(one, other):
                middle = 0.5 * (one + other)
                if own == 0 or own > (1 + CRACK) * max(one, other):
                    out[y, x] = middle
