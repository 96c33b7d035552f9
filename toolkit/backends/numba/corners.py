"""Corners of a baked field, compiled: which are written, and how they differ from what their neighbours predict (`export/corners.py`)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

CORNERS = 9  # along a block's side
OPTIONS: dict[str, Any] = {"cache": True, "nogil": True}


@njit(**OPTIONS)
def mark_written(table: Any, keys: Any, rows: Any, written: Any) -> None:
    """Of the stored corners, those that no block before has at the same place.

    Args:
        table, rows: see `render.bake.Baked`.
        keys: (M, 3) x, y, z of the blocks, from the table's first cell.
        written: (R,) bool.
    """
    at = 0
    for block in range(len(rows)):
        for row in range(CORNERS * CORNERS):
            z, y = row // CORNERS, row % CORNERS
            for x in range(CORNERS):
                if rows[block, row] >> x & 1:
                    written[at] = not _stored_before(table, keys[block], rows, block, z, y, x)
                    at += 1


@njit(**OPTIONS)
def _stored_before(table: Any, key: Any, rows: Any, block: int, z: int, y: int, x: int) -> bool:
    last = CORNERS - 1
    for k in range(-1 if z == 0 else 0, 2 if z == last else 1):
        for j in range(-1 if y == 0 else 0, 2 if y == last else 1):
            for i in range(-1 if x == 0 else 0, 2 if x == last else 1):
                u, v, w = key[0] + i, key[1] + j, key[2] + k
                if not (0 <= u < table.shape[2] and 0 <= v < table.shape[1] and 0 <= w < table.shape[0]):
                    continue
                other = table[w, v, u]
                if 0 <= other < block and rows[other, (z - last * k) * CORNERS + y - last * j] >> (x - last * i) & 1:
                    return True
    return False


@njit(**OPTIONS)
def differences(rows: Any, values: Any, written: Any, out: Any) -> None:
    """Values (R, C) uint8 of the written corners, less what the neighbours at lower z, y and x in their blocks predict: (C, W) uint8."""
    index = np.empty((CORNERS + 1, CORNERS + 1, CORNERS + 1), np.int64)  # with a margin at the low faces
    at, done = 0, 0
    for block in range(len(rows)):
        index[:] = -1
        for row in range(CORNERS * CORNERS):
            for x in range(CORNERS):
                if rows[block, row] >> x & 1:
                    index[row // CORNERS + 1, row % CORNERS + 1, x + 1] = at
                    at += 1
        for z in range(1, CORNERS + 1):
            for y in range(1, CORNERS + 1):
                for x in range(1, CORNERS + 1):
                    own = index[z, y, x]
                    if own >= 0 and written[own]:
                        _difference(index, z, y, x, values, out, done)
                        done += 1


@njit(**OPTIONS)
def _difference(index: Any, z: int, y: int, x: int, values: Any, out: Any, place: int) -> None:
    own, down, back, left = index[z, y, x], index[z - 1, y, x], index[z, y - 1, x], index[z, y, x - 1]
    flat_z, flat_y, flat_x = index[z, y - 1, x - 1], index[z - 1, y, x - 1], index[z - 1, y - 1, x]  # in the plane across each axis
    deep = index[z - 1, y - 1, x - 1]
    count: Any = np.int32(down >= 0) + np.int32(back >= 0) + np.int32(left >= 0)
    in_plane = np.int32(0)  # the first plane whose other three corners are known: across z, y, x
    if left >= 0 and back >= 0 and flat_z >= 0:
        in_plane = np.int32(1)
    elif left >= 0 and down >= 0 and flat_y >= 0:
        in_plane = np.int32(2)
    elif back >= 0 and down >= 0 and flat_x >= 0:
        in_plane = np.int32(3)
    whole = count == 3 and flat_z >= 0 and flat_y >= 0 and flat_x >= 0 and deep >= 0
    for c in range(values.shape[1]):
        a: Any = np.int32(values[down, c]) if down >= 0 else np.int32(0)
        b: Any = np.int32(values[back, c]) if back >= 0 else np.int32(0)
        d: Any = np.int32(values[left, c]) if left >= 0 else np.int32(0)
        if whole:
            pairs: Any = np.int32(values[flat_z, c]) + np.int32(values[flat_y, c]) + np.int32(values[flat_x, c])
            guess = (10 * (a + b + d) - 5 * pairs + np.int32(values[deep, c]) + 8) >> 4
        elif in_plane == 1:
            guess = (3 * (d + b) - 2 * np.int32(values[flat_z, c]) + 2) >> 2
        elif in_plane == 2:
            guess = (3 * (d + a) - 2 * np.int32(values[flat_y, c]) + 2) >> 2
        elif in_plane == 3:
            guess = (3 * (b + a) - 2 * np.int32(values[flat_x, c]) + 2) >> 2
        else:
            guess = (2 * (a + b + d) + count) // max(2 * count, 1)
        out[c, place] = np.uint8((np.int32(values[own, c]) - min(max(guess, 0), 255)) & 255)
