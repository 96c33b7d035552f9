"""Pixels between those that were rendered, compiled (`render/coarse_to_fine.py`)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

QUARTER = np.float32(0.25)


@njit(cache=True, nogil=True)
def fill_between(values: Any, row: int, column: int, smooth: Any, wanted: Any) -> None:
    """Give every second pixel of every second row, from `row` and `column` on, the mean of the four nearest ones that are known: those
    askew where both numbers are odd, else those beside it. At a border the one across counts twice.

    Args:
        values: (H, W, C) float32, with even sides.
        smooth: (C,) float32 how much the four may differ: (H / 2, W / 2) `wanted` is true where they differ by more.
    """
    height, width, channels = values.shape
    askew = row == 1 and column == 1
    for y in range(row, height, 2):
        above, below = y - 1 if y > 0 else y + 1, y + 1 if y + 1 < height else y - 1
        for x in range(column, width, 2):
            left, right = x - 1 if x > 0 else x + 1, x + 1 if x + 1 < width else x - 1
            rough = False
            for k in range(channels):
                if askew:
                    a, b, c, d = values[above, left, k], values[below, left, k], values[above, right, k], values[below, right, k]
                else:
                    a, b, c, d = values[above, x, k], values[below, x, k], values[y, left, k], values[y, right, k]
                rough |= max(max(a, b), max(c, d)) - min(min(a, b), min(c, d)) > smooth[k]
                values[y, x, k] = (a + b + c + d) * QUARTER
            wanted[y // 2, x // 2] = rough
