"""Features to colour, compiled: the encoding of directions and the deferred decoder; `nerfusion/decoder.py` is the reference.

A few rays are decoded at a time, as products of small matrices. One ray at a time a layer is a product of a matrix with a vector, which
reads every weight for one multiplication; several rays share what is read.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from fieldfuse.backends.constants import SH
from fieldfuse.backends.numba.common import LEAF, ONE, OPTIONS, START, ZERO, Decoder, F, aligned
from fieldfuse.backends.numba.matrix import LANES, product

_C0, _C1, _C2, _C3, _C4, _C5, _C6, _C7, _C8, _C9 = (F(value) for value in SH)

RAYS = 32  # at a time: what they need fits into the second cache, and the weights are read once for all of them


class Layers(NamedTuple):
    """The deferred decoder's weights, (inputs, outputs) but for the last. All widths are padded to whole LANES with zeros."""

    w1: Any  # (I, H), I ≥ C + 16
    b1: Any
    w2: Any  # (H, H)
    b2: Any
    w3: Any  # (3, H)
    b3: Any


class Rays(NamedTuple):
    """What goes into the decoder of `RAYS` rays, and what comes out: a row a ray."""

    given: Any  # (R, I) mean features, encoded direction, zeros
    h1: Any  # (R, H) hidden layers
    h2: Any
    colour: Any  # (R, 3)


@njit(**LEAF)
def encode_direction(x: Any, y: Any, z: Any, out: Any, row: Any, at: Any) -> None:
    """Spherical harmonics up to degree 3 into out[row, at … at + 15]; see `networks.encoding.spherical_harmonics`."""
    xx, yy, zz = x * x, y * y, F(5) * z * z
    out[row, at], out[row, at + 1], out[row, at + 2], out[row, at + 3] = _C0, -_C1 * y, _C1 * z, -_C1 * x
    out[row, at + 4], out[row, at + 5], out[row, at + 6] = _C2 * x * y, -_C2 * y * z, _C3 * (F(3) * z * z - ONE)
    out[row, at + 7], out[row, at + 8] = -_C2 * x * z, _C4 * (xx - yy)
    out[row, at + 9], out[row, at + 10] = -_C5 * y * (F(3) * xx - yy), _C6 * x * y * z
    out[row, at + 11], out[row, at + 12] = -_C7 * y * (zz - ONE), _C8 * z * (zz - F(3))
    out[row, at + 13], out[row, at + 14], out[row, at + 15] = -_C7 * x * (zz - ONE), _C9 * z * (xx - yy), -_C5 * x * (xx - F(3) * yy)


@njit(**LEAF)
def sigmoid(value: Any) -> Any:
    """1 / (1 + e^{-v}) without overflow."""
    return ONE / (ONE + math.exp(-min(max(value, F(-80)), F(80))))


def whole_lanes(width: int) -> int:
    """The next multiple of LANES."""
    return -(-width // LANES) * LANES


def layers_of(decoder: Decoder) -> Layers:
    """Copies of the weights, padded."""
    inputs, hidden = (whole_lanes(width) for width in decoder.w1.shape)
    shapes = ((inputs, hidden), (hidden,), (hidden, hidden), (hidden,), (3, hidden), (3,))
    layers = Layers(*(aligned(shape, np.float32, zeroed=True) for shape in shapes))
    for name, weight in layers._asdict().items():
        given = getattr(decoder, name)
        weight[tuple(slice(0, size) for size in given.shape)] = given
    return layers


def rays_of(layers: Layers) -> Rays:
    """Room for one thread."""
    inputs, hidden = layers.w1.shape
    return Rays(*(aligned((RAYS, width), np.float32, zeroed=True) for width in (inputs, hidden, hidden, 3)))


@njit(**OPTIONS)
def decode(layers: Any, tape: Any, rays: Any) -> None:
    """`Deferred.forward` of the first `rays` rows of `tape`, which is `Rays` or has what they have: given → h1, h2, colour."""
    product(tape.given, START, rays, layers.w1, tape.h1)
    rectify(tape.h1, START, rays, layers.b1)
    product(tape.h1, START, rays, layers.w2, tape.h2)
    rectify(tape.h2, START, rays, layers.b2)
    _colours(layers, tape.given, tape.h2, rays, tape.colour)


@njit(**LEAF)
def rectify(values: Any, first: Any, count: Any, bias: Any) -> None:
    """values[first : first + count, :H] = max(values + bias, 0)."""
    for row in range(first, first + count):
        own = values[row]
        for j in range(len(bias)):
            own[j] = max(own[j] + bias[j], ZERO)


@njit(**LEAF)
def _colours(layers: Any, given: Any, hidden: Any, rays: Any, colour: Any) -> None:
    w3, b3 = layers.w3, layers.b3
    for ray in range(rays):
        a, b, c = b3[0] + given[ray, 0], b3[1] + given[ray, 1], b3[2] + given[ray, 2]
        for j in range(w3.shape[1]):
            value = hidden[ray, j]
            a += value * w3[0, j]
            b += value * w3[1, j]
            c += value * w3[2, j]
        colour[ray, 0], colour[ray, 1], colour[ray, 2] = sigmoid(a), sigmoid(b), sigmoid(c)
