"""Features to colour and back, compiled: the encoding of directions and the deferred decoder; `nerfusion/decoder.py` is the reference.

A few rays are decoded at a time, as products of small matrices. One ray at a time a layer is a product of a matrix with a vector, which
reads every weight for one multiplication; several rays share what is read.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from numba import njit

from fieldfuse.backends.constants import SH
from fieldfuse.backends.numba.common import LEAF, ONE, OPTIONS, START, ZERO, Decoder, F, aligned
from fieldfuse.backends.numba.matrix import LANES, add_outer, product

if TYPE_CHECKING:
    from fieldfuse.nerfusion.decoder import Deferred

Array = np.ndarray[Any, Any]

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


class Turned(NamedTuple):
    """Weights a second time, transposed: for what goes back."""

    w1: Any  # (H, C), of the features alone, C rounded up to whole LANES
    w2: Any  # (H, H)


class Tape(NamedTuple):
    """What is known of `RAYS` rays, a row a ray; and sums over a batch of the gradients of the weights, `total`."""

    given: Any  # as in `decode.Rays`
    h1: Any
    h2: Any
    colour: Any
    g_logit: Any  # (R, 3)
    g1: Any  # (R, H)
    g2: Any
    g_given: Any  # (R, C), of the features
    total: Layers


def turned(layers: Layers, channels: int) -> Turned:
    """Room for the transposed weights, and they in it."""
    hidden = len(layers.b1)
    out = Turned(aligned((hidden, whole_lanes(channels)), np.float32), aligned((hidden, hidden), np.float32))
    turn(layers, out)
    return out


def turn(layers: Layers, out: Turned) -> None:
    """Renew them."""
    out.w1[:], out.w2[:] = layers.w1[: out.w1.shape[1]].T, layers.w2.T


def make_tape(layers: Layers, channels: int) -> Tape:
    """Room for one thread."""
    hidden = len(layers.b1)
    rows = [aligned((RAYS, width), np.float32, zeroed=True) for width in (3, hidden, hidden, whole_lanes(channels))]
    total = Layers(*(aligned(weight.shape, np.float32, zeroed=True) for weight in layers))
    return Tape._make([*rays_of(layers), *rows, total])


def in_order(layers: Layers) -> list[tuple[Array, Array]]:
    """Weight (out, in) and bias of each layer, as torch has them, with their padding."""
    return [(layers.w1.T, layers.b1), (layers.w2.T, layers.b2), (layers.w3, layers.b3)]


def write_layers(layers: Layers, decoder: Deferred) -> None:
    """Put the weights back into the decoder."""
    with torch.no_grad():
        for layer, (weight, bias) in zip(decoder.layers, in_order(layers), strict=True):
            layer.weight.copy_(torch.from_numpy(weight[: layer.out_features, : layer.in_features]))
            layer.bias.copy_(torch.from_numpy(bias[: layer.out_features]))


@njit(**OPTIONS)
def forget_gradients(total: Layers) -> None:
    """Begin a batch."""
    total.w1[:], total.b1[:], total.w2[:], total.b2[:], total.w3[:], total.b3[:] = ZERO, ZERO, ZERO, ZERO, ZERO, ZERO


@njit(**OPTIONS)
def decode_backward(layers: Layers, back: Turned, tape: Tape, rays: Any) -> None:
    """From tape.g_logit of the first `rays` rows to tape.g_given; gradients of the weights are added to tape.total."""
    _last_backward(layers, tape.h2, tape.g_logit, rays, tape.g2)
    product(tape.g2, START, rays, back.w2, tape.g1)
    _stop(tape.h1, rays, tape.g1)
    product(tape.g1, START, rays, back.w1, tape.g_given)
    add_outer(tape.given, tape.g1, rays, tape.total.w1)
    add_outer(tape.h1, tape.g2, rays, tape.total.w2)
    _add_sums(tape, tape.total, rays)


@njit(**LEAF)
def _last_backward(layers: Any, hidden: Any, g_logit: Any, rays: Any, out: Any) -> None:
    w3 = layers.w3
    for ray in range(rays):
        a, b, c = g_logit[ray, 0], g_logit[ray, 1], g_logit[ray, 2]
        for j in range(w3.shape[1]):
            total = a * w3[0, j] + b * w3[1, j] + c * w3[2, j]
            out[ray, j] = total if hidden[ray, j] > ZERO else ZERO


@njit(**LEAF)
def _stop(hidden: Any, rays: Any, gradient: Any) -> None:
    """No gradient through a unit that is off."""
    for ray in range(rays):
        for j in range(hidden.shape[1]):
            gradient[ray, j] = gradient[ray, j] if hidden[ray, j] > ZERO else ZERO


@njit(**LEAF)
def _add_sums(tape: Any, total: Any, rays: Any) -> None:
    """Biases, the last layer, and what goes past the layers: colours are added to the first three features."""
    g1, g2, g_logit, hidden, g_given = tape.g1, tape.g2, tape.g_logit, tape.h2, tape.g_given
    b1, b2, b3, w3 = total.b1, total.b2, total.b3, total.w3
    for ray in range(rays):
        a, b, c = g_logit[ray, 0], g_logit[ray, 1], g_logit[ray, 2]
        b3[0] += a
        b3[1] += b
        b3[2] += c
        g_given[ray, 0] += a
        g_given[ray, 1] += b
        g_given[ray, 2] += c
        for j in range(hidden.shape[1]):
            b1[j] += g1[ray, j]
            b2[j] += g2[ray, j]
            value = hidden[ray, j]
            w3[0, j] += a * value
            w3[1, j] += b * value
            w3[2, j] += c * value
