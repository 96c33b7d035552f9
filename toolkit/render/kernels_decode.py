"""Features to colour, compiled: the encoding of directions and the deferred decoder; `networks/decoder.py` is the reference."""

from __future__ import annotations

import math
from typing import Any

from numba import njit

from toolkit.networks.encoding import SH
from toolkit.render.kernels import LEAF, ONE, ZERO, F

_C0, _C1, _C2, _C3, _C4 = (F(value) for value in SH)


@njit(**LEAF)
def encode_direction(x: Any, y: Any, z: Any, out: Any, at: Any) -> None:
    """Spherical harmonics up to degree 2 into out[at … at + 8]; see `networks.encoding.spherical_harmonics`."""
    out[at], out[at + 1], out[at + 2], out[at + 3] = _C0, -_C1 * y, _C1 * z, -_C1 * x
    out[at + 4], out[at + 5], out[at + 6] = _C2 * x * y, -_C2 * y * z, _C3 * (F(3) * z * z - ONE)
    out[at + 7], out[at + 8] = -_C2 * x * z, _C4 * (x * x - y * y)


@njit(**LEAF)
def sigmoid(value: Any) -> Any:
    """1 / (1 + e^{-v}) without overflow."""
    return ONE / (ONE + math.exp(-min(max(value, F(-80)), F(80))))


@njit(**LEAF)
def multiply(rows: Any, columns: Any, matrix: Any, given: Any, out: Any) -> None:
    """out[j] = Σ_i matrix[j, i] given[i]; four sums at a time, which the compiler turns into seven times faster code than one."""
    n = len(columns)
    whole = len(rows) // 4 * 4
    for j in range(0, whole, 4):
        a, b, c, d = ZERO, ZERO, ZERO, ZERO
        for i in range(n):
            value = given[i]
            a += value * matrix[j, i]
            b += value * matrix[j + 1, i]
            c += value * matrix[j + 2, i]
            d += value * matrix[j + 3, i]
        out[j], out[j + 1], out[j + 2], out[j + 3] = a, b, c, d
    for j in range(whole, len(rows)):
        a = ZERO
        for i in range(n):
            a += given[i] * matrix[j, i]
        out[j] = a


@njit(**LEAF)
def decode(space: Any, decoder: Any, given: Any, h1: Any, h2: Any, colour: Any) -> None:
    """`Deferred.forward` of one ray: given (I,) mean features, encoded direction and zeros → h1, h2 (H,) hidden layers and colour (3,)."""
    hidden = len(space.hidden)
    multiply(space.hidden, space.inputs, decoder.w1_out, given, h1)
    for j in range(hidden):
        h1[j] = max(h1[j] + decoder.b1[j], ZERO)
    multiply(space.hidden, space.hidden, decoder.w2_out, h1, h2)
    a, b, c = ZERO, ZERO, ZERO
    for j in range(hidden):
        value = max(h2[j] + decoder.b2[j], ZERO)
        h2[j] = value
        a += value * decoder.w3[0, j]
        b += value * decoder.w3[1, j]
        c += value * decoder.w3[2, j]
    colour[0] = sigmoid(given[0] + a + decoder.b3[0])
    colour[1] = sigmoid(given[1] + b + decoder.b3[1])
    colour[2] = sigmoid(given[2] + c + decoder.b3[2])
