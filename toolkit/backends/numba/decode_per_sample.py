"""The paper's decoder, compiled: densities of a few samples at a time, colours of many. The twin in torch is `decoder.PerSample`."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from fieldfuse.backends.constants import DIRECTION, FREQUENCIES
from fieldfuse.backends.numba import common as K
from fieldfuse.backends.numba.decode import rectify, sigmoid
from fieldfuse.backends.numba.lookup import gather_feature
from fieldfuse.backends.numba.matrix import TILE, product

F, ZERO, HALF, ONE, TWO = K.F, K.ZERO, K.HALF, K.ONE, K.TWO
PI = F(math.pi)
MOST = 1024  # samples of one ray, or a few more: it ends there
BATCH = 128  # samples whose colours are decoded at a time, or a few more: what they need fits into the second cache
SAMPLES = BATCH + MOST + 64 + 2 * TILE  # a step of the march has at most 64 samples


class Net(NamedTuple):
    """The decoder's weights: (inputs, outputs), and `…_back` transposed. Outputs are padded with zeros to whole LANES, inputs likewise."""

    w1: Any  # (I, H), I ≥ 11 C
    w1_back: Any  # (H, I)
    b1: Any
    w2: Any  # (H, H)
    w2_back: Any
    b2: Any
    density: Any  # (H,)
    density_bias: Any  # (1,)
    w3: Any  # (H + DIRECTION, H): the hidden layer, harmonics
    w3_back: Any  # (H, H), of the hidden layer alone
    b3: Any
    w4: Any  # (3, H)
    b4: Any


class Tape(NamedTuple):
    """What is known of the samples of a few rays, a row a sample."""

    rows: Any  # (S, 8) int32 lattice corners
    values: Any  # (S, VALUES) float32
    corners: Any  # (S, 8) float32 trilinear weights
    given: Any  # (S, I) features, their encoding, zeros
    h1: Any  # (S, H)
    h2: Any  # (S, H + DIRECTION) hidden layer and encoded direction, what the colour layers are given
    h3: Any  # (S, H)
    colour: Any  # (S, 3)


def make_tape(net: Net) -> Tape:
    """Room for `SAMPLES` samples."""
    inputs, hidden = net.w1.shape
    widths = (8, inputs, hidden, hidden + DIRECTION, hidden, 3)
    floats = [K.aligned((SAMPLES, width), np.float32, zeroed=True) for width in widths]
    return Tape(np.zeros((SAMPLES, 8), np.int32), np.zeros((SAMPLES, K.VALUES), np.float32), *floats)


@njit(**K.LEAF)
def encode(width: Any, out: Any) -> None:
    """Fill out[C : 11 C] with sin and cos of 2^k π v of the features v in out[:C]; see `networks.encoding.positional`.

    Sine and cosine of π v come from their series after taking quarter turns off; every next frequency from the double-angle formulas,
    which at most double an error: 16 times some 1e-7 at the last, no more than rounding the angle itself costs.
    """
    c_count = len(width)
    first_cosine = c_count * (1 + FREQUENCIES)
    for c in range(c_count):
        v = out[c]
        turns = math.floor(TWO * v + HALF)  # quarter turns
        x = (v - HALF * turns) * PI
        x2 = x * x
        sine = x * (ONE + x2 * (F(-1 / 6) + x2 * (F(1 / 120) + x2 * (F(-1 / 5040) + x2 * F(1 / 362880)))))
        cosine = ONE + x2 * (F(-1 / 2) + x2 * (F(1 / 24) + x2 * (F(-1 / 720) + x2 * (F(1 / 40320) + x2 * F(-1 / 3628800)))))
        half_turns = math.floor(turns * HALF)
        odd = turns - TWO * half_turns > HALF
        sign = ONE - TWO * (half_turns - TWO * math.floor(half_turns * HALF))
        out[c_count + c] = sign * (cosine if odd else sine)
        out[first_cosine + c] = sign * (-sine if odd else cosine)
    for k in range(1, FREQUENCIES):
        for c in range(c_count):
            sine, cosine = out[c_count * k + c], out[first_cosine + c_count * (k - 1) + c]
            out[c_count * (k + 1) + c] = TWO * sine * cosine
            out[first_cosine + c_count * k + c] = ONE - TWO * sine * sine


@njit(**K.OPTIONS)
def decode_densities(space: Any, volume: Any, net: Net, tape: Tape, first: Any, count: Any) -> None:
    """Complete raw densities of samples first … first + count, of which the trilinear part is known: add the decoder's."""
    for i in range(first, first + count):
        x, y, z = tape.values[i, K.X], tape.values[i, K.Y], tape.values[i, K.Z]
        gather_feature(space.width, volume.feature, tape.rows[i], x, y, z, tape.corners[i], tape.given[i])
        encode(space.width, tape.given[i])
    product(tape.given, first, count, net.w1, tape.h1)
    rectify(tape.h1, first, count, net.b1)
    product(tape.h1, first, count, net.w2, tape.h2)
    rectify(tape.h2, first, count, net.b2)
    for i in range(first, first + count):
        raw, own = net.density_bias[0], tape.h2[i]
        for j in range(len(net.density)):
            raw += own[j] * net.density[j]
        tape.values[i, K.RAW] += raw


@njit(**K.OPTIONS)
def decode_colours(net: Net, tape: Tape, count: Any) -> None:
    """Colours of the first `count` samples, whose densities and directions are there."""
    product(tape.h2, K.START, count, net.w3, tape.h3)
    rectify(tape.h3, K.START, count, net.b3)
    for i in range(count):
        own = tape.h3[i]
        a, b, c = net.b4[0], net.b4[1], net.b4[2]
        for j in range(len(own)):
            a += own[j] * net.w4[0, j]
            b += own[j] * net.w4[1, j]
            c += own[j] * net.w4[2, j]
        given = tape.given[i]
        tape.colour[i, 0], tape.colour[i, 1], tape.colour[i, 2] = sigmoid(given[0] + a), sigmoid(given[1] + b), sigmoid(given[2] + c)
