"""The deferred decoder of a training step, compiled: a few rays at a time, forward and backward, as products of small matrices.

One ray at a time a layer is a product of a matrix with a vector, which reads every weight for 64 multiplications of its own; several rays
share what is read. `networks/decoder.py` is the reference.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numba import njit

from toolkit.networks.decoder import Deferred
from toolkit.render import kernels as K
from toolkit.render.compiled import decoder_arrays
from toolkit.render.kernels_decode import sigmoid
from toolkit.render.kernels_matrix import LANES, TILE, add_outer, product
from toolkit.render.kernels_net import rectify

Array = np.ndarray[Any, Any]
F, ZERO, ONE = K.F, K.ZERO, K.ONE
MOVED = ("w1", "b1", "w2", "b2", "w3", "b3")
RAYS = 32  # rays at a time: what they need fits into the second cache, and the weights are read once for all of them


class Layers(NamedTuple):
    """The decoder's weights, (inputs, outputs), and `…_back` transposed. All widths are padded with zeros to whole LANES, which stay zero."""

    w1: Any  # (I, H), I ≥ C + 9
    w1_back: Any  # (H, C'), of the features alone
    b1: Any
    w2: Any  # (H, H)
    w2_back: Any
    b2: Any
    w3: Any  # (3, H)
    b3: Any


class Tape(NamedTuple):
    """What is known of `RAYS` rays, a row a ray; and sums over a batch of the gradients of the weights, `total`."""

    given: Any  # (R, I) mean features, encoded direction, zeros
    h1: Any  # (R, H)
    h2: Any
    colour: Any  # (R, 3)
    g_logit: Any  # (R, 3)
    g1: Any  # (R, H)
    g2: Any
    g_given: Any  # (R, C')
    total: Layers  # the transposed ones are not used


def whole_lanes(width: int) -> int:
    """The next multiple of LANES."""
    return -(-width // LANES) * LANES


def layers_of(decoder: Deferred) -> Layers:
    """Copies of the weights."""
    d = decoder_arrays(decoder)
    inputs, hidden, channels = whole_lanes(d.w1.shape[0]), whole_lanes(d.w1.shape[1]), whole_lanes(decoder.channels)
    layers = Layers(*(K.aligned(shape, np.float32, zeroed=True) for shape in _shapes(inputs, hidden, channels)))
    for padded, weight in ((layers.w1, d.w1), (layers.w2, d.w2), (layers.w3, d.w3)):
        padded[: weight.shape[0], : weight.shape[1]] = weight
    for padded, bias in ((layers.b1, d.b1), (layers.b2, d.b2), (layers.b3, d.b3)):
        padded[: len(bias)] = bias
    turn(layers)
    return layers


def moved(layers: Layers) -> tuple[Array, ...]:
    """What Adam moves, in the order of MOVED."""
    return tuple(getattr(layers, name) for name in MOVED)


def write_layers(layers: Layers, decoder: Deferred) -> None:
    """Put the weights back into the decoder."""
    with torch.no_grad():
        for layer, (weight, bias) in zip(decoder.layers, in_order(layers), strict=True):
            layer.weight.copy_(torch.from_numpy(weight[: layer.out_features, : layer.in_features]))
            layer.bias.copy_(torch.from_numpy(bias[: layer.out_features]))


def turn(layers: Layers) -> None:
    """Renew what is kept of the weights a second time."""
    layers.w1_back[:], layers.w2_back[:] = layers.w1[: layers.w1_back.shape[1]].T, layers.w2.T


def in_order(layers: Layers) -> list[tuple[Array, Array]]:
    """Weight (out, in) and bias of each layer, as torch has them, with their padding."""
    return [(layers.w1.T, layers.b1), (layers.w2.T, layers.b2), (layers.w3, layers.b3)]


def make_tape(layers: Layers) -> Tape:
    """Room for one thread."""
    (inputs, hidden), channels = layers.w1.shape, layers.w1_back.shape[1]
    widths = (inputs, hidden, hidden, 3, 3, hidden, hidden, channels)
    rows = [K.aligned((RAYS, width), np.float32, zeroed=True) for width in widths]
    return Tape(*rows, Layers(*(K.aligned(weight.shape, np.float32, zeroed=True) for weight in layers)))


def _shapes(inputs: int, hidden: int, channels: int) -> list[tuple[int, ...]]:
    assert RAYS % TILE == 0
    return [(inputs, hidden), (hidden, channels), (hidden,), (hidden, hidden), (hidden, hidden), (hidden,), (3, hidden), (3,)]


@njit(**K.OPTIONS)
def forget_gradients(total: Layers) -> None:
    """Begin a batch."""
    total.w1[:], total.b1[:], total.w2[:], total.b2[:], total.w3[:], total.b3[:] = ZERO, ZERO, ZERO, ZERO, ZERO, ZERO


@njit(**K.OPTIONS)
def forward(layers: Layers, tape: Tape, rays: Any) -> None:
    """`Deferred.forward` of the first `rays` rows: tape.given → tape.h1, tape.h2, tape.colour."""
    product(tape.given, 0, rays, layers.w1, tape.h1)
    rectify(tape.h1, 0, rays, layers.b1)
    product(tape.h1, 0, rays, layers.w2, tape.h2)
    rectify(tape.h2, 0, rays, layers.b2)
    _colours(layers, tape.given, tape.h2, rays, tape.colour)


@njit(**K.LEAF)
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


@njit(**K.OPTIONS)
def backward(layers: Layers, tape: Tape, rays: Any) -> None:
    """From tape.g_logit of the first `rays` rows to tape.g_given, and the sums of the weights' gradients in tape.total."""
    _last_backward(layers, tape.h2, tape.g_logit, rays, tape.g2)
    product(tape.g2, 0, rays, layers.w2_back, tape.g1)
    _stop(tape.h1, rays, tape.g1)
    product(tape.g1, 0, rays, layers.w1_back, tape.g_given)
    add_outer(tape.given, tape.g1, rays, tape.total.w1)
    add_outer(tape.h1, tape.g2, rays, tape.total.w2)
    _add_sums(tape, tape.total, rays)


@njit(**K.LEAF)
def _last_backward(layers: Any, hidden: Any, g_logit: Any, rays: Any, out: Any) -> None:
    w3 = layers.w3
    for ray in range(rays):
        a, b, c = g_logit[ray, 0], g_logit[ray, 1], g_logit[ray, 2]
        for j in range(w3.shape[1]):
            total = a * w3[0, j] + b * w3[1, j] + c * w3[2, j]
            out[ray, j] = total if hidden[ray, j] > ZERO else ZERO


@njit(**K.LEAF)
def _stop(hidden: Any, rays: Any, gradient: Any) -> None:
    """No gradient through a unit that is off."""
    for ray in range(rays):
        for j in range(hidden.shape[1]):
            gradient[ray, j] = gradient[ray, j] if hidden[ray, j] > ZERO else ZERO


@njit(**K.LEAF)
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
