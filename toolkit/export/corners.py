"""Values at the corners of a baked field as differences from what their neighbours predict: about half as many bytes once deflated, and
none is lost. `web/unpack.js` undoes it.

A corner on a face between blocks is stored with each of them, but written only with the first. What is written comes block by block and,
in a block, row by row, so that the neighbours at lower x, y and z are known when a corner is decoded: all seven of them predict it, else
the three in a plane, else the mean of those next to it along an axis.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from fieldfuse.backends.numba.corners import differences, mark_written
from fieldfuse.render.bake import BakedField

Array = np.ndarray[Any, Any]


def written_corners(field: BakedField) -> Array:
    """(R,) bool: stored corners that no block before has at the same place."""
    out = np.empty(field.corners, bool)
    mark_written(field.arrays.table, (field.keys() - field.table_origin).astype(np.int64), field.arrays.rows, out)
    return out


def corner_differences(field: BakedField, written: Array) -> Array:
    """(C + 1, W) uint8: of every written corner its features and its density (last), less what is predicted, modulo 256."""
    values = np.concatenate([np.asarray(field.arrays.feature), field.corner_densities()[:, None]], 1)
    out = np.empty((values.shape[1], int(written.sum())), np.uint8)
    differences(field.arrays.rows, values, written, out)
    return out
