"""Lattice values, compiled: corners of a voxel, trilinear density and features."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from fieldfuse.backends.numba.common import INLINE, LEAF, ONE, X, Y, Z
from fieldfuse.backends.numba.rows import mix

X_ROW, Y_ROW, Z_ROW = np.uintp(1), np.uintp(8), np.uintp(64)  # rows from a corner of a block to the next one along each axis


@njit(**INLINE)
def corner_rows(upper: Any, cell: Any, rows: Any, index: Any) -> None:
    """The eight lattice corners of voxel `cell` into rows[index, 0 … 7], x fastest; an absent block's corner is the zero row."""
    slot, local = cell >> 9, cell & 511
    x, y, z = local & 7, (local >> 3) & 7, local >> 6
    if x < 7 and y < 7 and z < 7:
        rows[index, 0], rows[index, 1], rows[index, 2], rows[index, 3] = cell, cell + 1, cell + 8, cell + 9
        rows[index, 4], rows[index, 5], rows[index, 6], rows[index, 7] = cell + 64, cell + 65, cell + 72, cell + 73
        return
    zero_row = upper.shape[0] * 512
    for corner in range(8):
        u, v, w = x + (corner & 1), y + ((corner >> 1) & 1), z + (corner >> 2)
        block = upper[slot, (u >> 3) | ((v >> 3) << 1) | ((w >> 3) << 2)]
        rows[index, corner] = min(block * 512 + ((w & 7) * 8 + (v & 7)) * 8 + (u & 7), zero_row)


@njit(**INLINE)
def raw_density(density: Any, upper: Any, cell: Any, x: Any, y: Any, z: Any) -> Any:
    """Trilinear raw density in voxel `cell`."""
    slot, local = cell >> 9, cell & 511
    u, v, w = local & 7, (local >> 3) & 7, local >> 6
    if u < 7 and v < 7 and w < 7:
        at = np.uintp(cell)  # unsigned, so that no check for negative indices is compiled
        p0, p1, p2, p3 = density[at], density[at + Y_ROW], density[at + Z_ROW], density[at + Y_ROW + Z_ROW]
        at += X_ROW
        q0, q1, q2, q3 = density[at], density[at + Y_ROW], density[at + Z_ROW], density[at + Y_ROW + Z_ROW]
    else:
        zero_row = upper.shape[0] * 512
        hx, hy, hz = (u + 1) >> 3, (v + 1) >> 3, (w + 1) >> 3
        x1, y0, y1, z0, z1 = (u + 1) & 7, v * 8, ((v + 1) & 7) * 8, w * 64, ((w + 1) & 7) * 64
        p0, q0 = density[cell], density[min(upper[slot, hx] * 512 + z0 + y0 + x1, zero_row)]
        p1 = density[min(upper[slot, hy * 2] * 512 + z0 + y1 + u, zero_row)]
        q1 = density[min(upper[slot, hy * 2 + hx] * 512 + z0 + y1 + x1, zero_row)]
        p2 = density[min(upper[slot, hz * 4] * 512 + z1 + y0 + u, zero_row)]
        q2 = density[min(upper[slot, hz * 4 + hx] * 512 + z1 + y0 + x1, zero_row)]
        p3 = density[min(upper[slot, hz * 4 + hy * 2] * 512 + z1 + y1 + u, zero_row)]
        q3 = density[min(upper[slot, hz * 4 + hy * 2 + hx] * 512 + z1 + y1 + x1, zero_row)]
    p0 += x * (q0 - p0)
    p1 += x * (q1 - p1)
    p2 += x * (q2 - p2)
    p3 += x * (q3 - p3)
    p0 += y * (p1 - p0)
    p2 += y * (p3 - p2)
    return p0 + z * (p2 - p0)


@njit(**LEAF)
def gather_row(width: Any, feature: Any, rows: Any, values: Any, weights: Any, out: Any, index: Any) -> None:
    """Trilinear feature of sample `index`, whose corners are in rows (S, 8), into out (S, …)[index, :C], and its weights into (S, 8).

    Rows are never taken as arrays of their own inside a loop over samples: each such view is counted, by an atomic operation.
    """
    x, y, z = values[index, X], values[index, Y], values[index, Z]
    a, b, c = ONE - x, ONE - y, ONE - z
    w0, w1, w2, w3 = a * b * c, x * b * c, a * y * c, x * y * c
    w4, w5, w6, w7 = a * b * z, x * b * z, a * y * z, x * y * z
    weights[index, 0], weights[index, 1], weights[index, 2], weights[index, 3] = w0, w1, w2, w3
    weights[index, 4], weights[index, 5], weights[index, 6], weights[index, 7] = w4, w5, w6, w7
    mix(width, feature, rows, weights, index, out)
