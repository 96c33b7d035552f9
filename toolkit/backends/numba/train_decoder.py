"""The deferred decoder of a training step, compiled: the gradients of a few rays at a time. `backends/numba/decode.py` goes forward."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from numba import njit

from fieldfuse.backends.numba import common as K
from fieldfuse.backends.numba.decode import RAYS, Layers, rays_of, whole_lanes
from fieldfuse.backends.numba.matrix import add_outer, product

if TYPE_CHECKING:
    from fieldfuse.nerfusion.decoder import Deferred

Array = np.ndarray[Any, Any]
ZERO = K.ZERO


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
    out = Turned(K.aligned((hidden, whole_lanes(channels)), np.float32), K.aligned((hidden, hidden), np.float32))
    turn(layers, out)
    return out


def turn(layers: Layers, out: Turned) -> None:
    """Renew them."""
    out.w1[:], out.w2[:] = layers.w1[: out.w1.shape[1]].T, layers.w2.T


def make_tape(layers: Layers, channels: int) -> Tape:
    """Room for one thread."""
    hidden = len(layers.b1)
    rows = [K.aligned((RAYS, width), np.float32, zeroed=True) for width in (3, hidden, hidden, whole_lanes(channels))]
    total = Layers(*(K.aligned(weight.shape, np.float32, zeroed=True) for weight in layers))
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


@njit(**K.OPTIONS)
def forget_gradients(total: Layers) -> None:
    """Begin a batch."""
    total.w1[:], total.b1[:], total.w2[:], total.b2[:], total.w3[:], total.b3[:] = ZERO, ZERO, ZERO, ZERO, ZERO, ZERO


@njit(**K.OPTIONS)
def decode_backward(layers: Layers, back: Turned, tape: Tape, rays: Any) -> None:
    """From tape.g_logit of the first `rays` rows to tape.g_given; gradients of the weights are added to tape.total."""
    _last_backward(layers, tape.h2, tape.g_logit, rays, tape.g2)
    product(tape.g2, K.START, rays, back.w2, tape.g1)
    _stop(tape.h1, rays, tape.g1)
    product(tape.g1, K.START, rays, back.w1, tape.g_given)
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
