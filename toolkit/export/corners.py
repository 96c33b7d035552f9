"""Values at the corners of a baked field as differences from what their neighbours predict: about half as many bytes once deflated, and
none is lost. `web/unpack.js` undoes it.

A corner on a face between blocks is stored with each of them, but written only with the first. What is written comes block by block and,
in a block, row by row, so that the neighbours at lower x, y and z are known when a corner is decoded: all seven of them predict it, else
the three in a plane, else the mean of those next to it along an axis.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from fieldfuse.render.bake import CHUNK, CORNERS, BakedField, stored_corners

Array = np.ndarray[Any, Any]
SIDE = CORNERS + 1  # of a block's corners with a margin at the low faces
PLANES = ((2, 1), (2, 0), (1, 0))  # pairs of axes (z, y, x), in the order in which they are tried


def written_corners(field: BakedField) -> Array:
    """(R,) bool: stored corners that no block before has at the same place."""
    block, corner = np.nonzero(stored_corners(field.arrays.rows))
    z, y, x = corner // CORNERS**2, corner // CORNERS % CORNERS, corner % CORNERS
    place = (field.keys() - field.table_origin).astype(np.int64)[block] * (CORNERS - 1) + np.stack([x, y, z], 1)
    size = place.max(0, initial=0) + 1
    _, first = np.unique((place[:, 2] * size[1] + place[:, 1]) * size[0] + place[:, 0], return_index=True)
    out = np.zeros(len(place), bool)
    out[first] = True
    return out


def corner_differences(field: BakedField, written: Array) -> Array:
    """(C + 1, W) uint8: of every written corner its features and its density (last), less what is predicted, modulo 256."""
    values = np.concatenate([np.asarray(field.arrays.feature), field.corner_densities()[:, None]], 1)
    stored, out, done = stored_corners(field.arrays.rows), [], 0
    for start in range(0, len(stored), CHUNK):
        block, corner = np.nonzero(stored[start : start + CHUNK])
        at = corner // CORNERS**2 + 1, corner // CORNERS % CORNERS + 1, corner % CORNERS + 1
        grid = np.zeros((len(stored[start : start + CHUNK]), SIDE, SIDE, SIDE, values.shape[1]), np.int16)
        there = np.zeros(grid.shape[:4], bool)
        part = slice(done, done + len(block))
        grid[block, *at], there[block, *at] = values[part], True
        mine = written[part]
        chosen = (block[mine], *(axis[mine] for axis in at))
        out.append(((values[part][mine] - _predicted(grid, there, chosen)) & 255).astype(np.uint8))
        done = part.stop
    return np.ascontiguousarray(np.concatenate(out).T)


def _predicted(grid: Array, there: Array, at: tuple[Array, ...]) -> Array:
    """(W, C) int16 from the neighbours at lower z, y, x of the places `at`: (block, z, y, x) of W corners each."""

    def look(*axes: int) -> tuple[Array, Array]:
        place = (at[0], *(at[1 + axis] - (axis in axes) for axis in range(3)))
        return grid[place], there[place]

    beside = [look(axis) for axis in range(3)]
    pairs = [look(*pair) for pair in PLANES]
    across, deep = look(0, 1, 2)
    count: Array = np.stack([known for _, known in beside]).sum(0, dtype=np.int16)
    total: Array = np.stack([np.where(known[:, None], value, 0) for value, known in beside]).sum(0, dtype=np.int16)
    out: Array = (2 * total + count[:, None]) // np.maximum(2 * count, 1)[:, None]
    flat: Array = np.zeros(len(count), bool)
    for (value, known), (one, two) in zip(pairs, PLANES, strict=True):
        here: Array = known & beside[one][1] & beside[two][1] & ~flat
        out[here] = (3 * (beside[one][0] + beside[two][0]) - 2 * value + 2)[here] >> 2
        flat |= here
    whole: Array = deep & np.all([known for _, known in (*beside, *pairs)], 0)
    out[whole] = (10 * total - 5 * np.stack([value for value, _ in pairs]).sum(0, dtype=np.int16) + across + 8)[whole] >> 4
    return np.asarray(np.clip(out, 0, 255))
