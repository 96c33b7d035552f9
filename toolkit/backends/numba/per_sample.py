"""The paper's decoder, compiled: it gives density and colour at every sample, so what stops a ray is known after decoding.

A ray collects TILE samples, decodes their densities in one go, and goes on while light is left; colours of many rays are decoded together.
Places along a ray are those of `march`; the twins in torch are `decoder.PerSample` and `render/rays.py`.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from numba import njit

from fieldfuse.backends.constants import DIRECTION, FREQUENCIES
from fieldfuse.backends.numba import common as K
from fieldfuse.backends.numba.decode import encode_direction, rectify, sigmoid, whole_lanes
from fieldfuse.backends.numba.lookup import corner_rows, gather_row, raw_density
from fieldfuse.backends.numba.march import (
    block_slot,
    fine_length,
    half_way,
    mark,
    mark_surface,
    next_step,
    place_at,
    start_ray,
    weight_of,
)
from fieldfuse.backends.numba.matrix import TILE, product

if TYPE_CHECKING:
    from fieldfuse.nerfusion.decoder import PerSample

Array = np.ndarray[Any, Any]

F, ZERO, HALF, ONE, TWO = K.F, K.ZERO, K.HALF, K.ONE, K.TWO
PI = F(math.pi)
LAYERS = ("body.0", "body.2", "density", "colour.0", "colour.2")  # of `decoder.PerSample`
NEGLIGIBLE = 1e-6  # samples of smaller weight have no colour and get no gradient
MOST = 1024  # samples of one ray, or a few more: it ends there
RAYS = 64  # rays whose colours are decoded together, when they have few samples
BATCH = 128  # samples whose colours are decoded at a time, or a few more: what they need fits into the second cache
SAMPLES = BATCH + MOST + 64 + 2 * TILE  # a step of the march has at most 64 samples
BEGIN, SPAN = K.AFTER, K.WEIGHT  # columns of a sample that waits for its density: distance where it begins, and how long it is


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


def _padded(values: Array, rows: int, columns: int) -> Array:
    """`values` (r, c) in the corner of zeros (rows, columns), at the start of a cache line."""
    out = K.aligned((rows, columns), np.float32, zeroed=True)
    out[: values.shape[0], : values.shape[1]] = values
    return out


def net_of(decoder: PerSample) -> Net:
    """Copies of the weights, padded."""
    state = {name: value.detach().cpu().numpy() for name, value in decoder.state_dict().items()}
    w1, w2, wd, w3, w4 = (state[f"{name}.weight"] for name in LAYERS)
    b1, b2, bd, b3, b4 = (state[f"{name}.bias"][None] for name in LAYERS)
    hidden, inputs = whole_lanes(decoder.hidden), whole_lanes(decoder.channels * (1 + 2 * FREQUENCIES))
    third = _padded(w3[:, : decoder.hidden].T, hidden + DIRECTION, hidden)
    third[hidden : hidden + DIRECTION, : decoder.hidden] = w3[:, decoder.hidden :].T
    net = Net(
        w1=_padded(w1.T, inputs, hidden),
        w1_back=K.aligned((hidden, inputs), np.float32),
        b1=_padded(b1, 1, hidden)[0],
        w2=_padded(w2.T, hidden, hidden),
        w2_back=K.aligned((hidden, hidden), np.float32),
        b2=_padded(b2, 1, hidden)[0],
        density=_padded(wd, 1, hidden)[0],
        density_bias=_padded(bd, 1, 1)[0],
        w3=third,
        w3_back=K.aligned((hidden, hidden), np.float32),
        b3=_padded(b3, 1, hidden)[0],
        w4=_padded(w4, 3, hidden),
        b4=_padded(b4, 1, 3)[0],
    )
    turn(net)
    return net


def turn(net: Net) -> None:
    """Renew what is kept transposed too."""
    net.w1_back[:], net.w2_back[:], net.w3_back[:] = net.w1.T, net.w2.T, net.w3[: len(net.b3)].T


def write_net(net: Net, decoder: PerSample) -> None:
    """The weights into the decoder."""
    h = decoder.hidden
    third = np.concatenate([net.w3[:h], net.w3[len(net.b3) : len(net.b3) + DIRECTION]])
    values = {
        "body.0.weight": net.w1[: decoder.channels * (1 + 2 * FREQUENCIES), :h].T,
        "body.0.bias": net.b1[:h],
        "body.2.weight": net.w2[:h, :h].T,
        "body.2.bias": net.b2[:h],
        "density.weight": net.density[None, :h],
        "density.bias": net.density_bias,
        "colour.0.weight": third[:, :h].T,
        "colour.0.bias": net.b3[:h],
        "colour.2.weight": net.w4[:, :h],
        "colour.2.bias": net.b4,
    }
    decoder.load_state_dict({name: torch.from_numpy(np.ascontiguousarray(value)) for name, value in values.items()})


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
        gather_row(space.width, volume.feature, tape.rows, tape.values, tape.corners, tape.given, i)
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


@njit(**K.OPTIONS)
def _move(array: Any, source: Any, target: Any) -> None:
    for j in range(array.shape[1]):
        array[target, j] = array[source, j]


@njit(**K.OPTIONS)
def settle(
    space: Any, volume: Any, net: Net, tape: Tape, first: Any, count: Any, stop: Any, threshold: Any, marks: Any, cells: Any, light: Any
) -> Any:
    """Decode the waiting samples first … first + count, composite them, and keep those whose weight exceeds `threshold`.

    Args:
        cells: (TILE,) voxels of the samples.
        light: (5,) float32 of the ray, carried from call to call: optical depth, transmittance, distance where half of the light was
            stopped, samples decoded, strongest weight.

    Returns:
        samples kept, and the voxel of the strongest one if it is among these, else −1.
    """
    decode_densities(space, volume, net, tape, first, count)
    kept, strongest_cell = first, -1
    marking = marks.shape[0] > 0
    for i in range(first, first + count):
        values = tape.values[i]
        raw, begin, span = values[K.RAW], values[BEGIN], values[SPAN]
        tau = math.exp(min(raw, K.RAW_MAX)) * K.UNITS * values[K.TAU]
        transmittance = light[1]
        light[0] += tau
        light[3] += ONE
        after = F(math.exp(-light[0]))
        weight = weight_of(transmittance, after, tau)
        if transmittance > HALF and after <= HALF:
            light[2] = begin + span * half_way(transmittance, after)
        if marking:
            mark(marks, cells[i - first], weight)
            if weight > light[4]:
                light[4], strongest_cell = weight, cells[i - first]
        light[1] = after
        if weight > threshold:
            values[K.TAU], values[K.WEIGHT], values[K.AFTER] = tau, weight, after
            if kept < i:
                _move(tape.rows, i, kept)
                _move(tape.values, i, kept)
                _move(tape.corners, i, kept)
                _move(tape.given, i, kept)
                _move(tape.h1, i, kept)
                _move(tape.h2, i, kept)
            kept += 1
        if after < stop:
            break
    return kept - first, strongest_cell


@njit(**K.OPTIONS)
def march_ray(
    space: Any, volume: Any, net: Net, tape: Tape, first: Any, line: Any, jitter: Any, stop: Any, threshold: Any, marks: Any, light: Any
) -> Any:
    """March one ray and put samples whose weight exceeds `threshold` on the tape, from row `first` on.

    Args:
        line, jitter, stop, marks: as in `march.march_ray`.
        light: (5,) float32, see `settle`; written.

    Returns:
        number of kept samples.
    """
    half, fine, near = space.half, space.fine, space.near / space.half
    per_fine, unit = ONE / F(fine), space.voxel * F(4) / (TWO * space.extent)
    light[0], light[1], light[2], light[3], light[4] = ZERO, ONE, ZERO, ZERO, ZERO
    cells = np.empty(TILE, np.int32)
    kept, waiting = K.START, K.START
    strongest_cell = 0
    lx, ly, lz = -1, -1, -1
    slot = np.int64(-1)
    ray, step = start_ray(space, line, jitter)
    while light[1] >= stop and kept <= MOST - TILE:
        more, step = next_step(space, volume.bricks, ray, step)
        if not more:
            break
        if step.end <= near:
            continue
        length, span = fine_length(step, per_fine), step.end - step.begin
        for index in range(fine):
            where = (F(index) + HALF) * per_fine
            x, y, z = place_at(ray, step, where)
            i, j, k = int(x), int(y), int(z)
            tx, ty, tz = (i >> 3) - space.ox, (j >> 3) - space.oy, (k >> 3) - space.oz
            if tx != lx or ty != ly or tz != lz:
                lx, ly, lz = tx, ty, tz
                slot = block_slot(space, volume.table, tx, ty, tz)
            if slot < 0:
                continue
            if (volume.bits[slot, k & 7] >> np.uint64((j & 7) * 8 + (i & 7))) & np.uint64(1) == 0:
                continue
            cell = slot * 512 + ((k & 7) * 8 + (j & 7)) * 8 + (i & 7)
            cells[waiting] = cell
            at = first + kept + waiting
            corner_rows(volume.upper, cell, tape.rows, at)
            for corner in range(8):
                K.prefetch(volume.feature, np.int64(tape.rows[at, corner]))
            values = tape.values[at]
            values[K.X], values[K.Y], values[K.Z] = x - F(i), y - F(j), z - F(k)
            values[K.RAW] = raw_density(volume.density, volume.upper, cell, x - F(i), y - F(j), z - F(k))
            values[K.TAU] = length
            values[K.PLACE] = (F(step.index) + where) * unit
            values[K.ALONG] = (step.begin + span * where) * half
            values[BEGIN], values[SPAN] = (step.begin + span * F(index) * per_fine) * half, span * per_fine * half
            waiting += 1
            if waiting == TILE:
                more_kept, cell = settle(space, volume, net, tape, first + kept, waiting, stop, threshold, marks, cells, light)
                kept, waiting = kept + more_kept, K.START
                strongest_cell = cell if cell >= 0 else strongest_cell
                if light[1] < stop:
                    break
    if waiting > 0:
        more_kept, cell = settle(space, volume, net, tape, first + kept, waiting, stop, threshold, marks, cells, light)
        kept += more_kept
        strongest_cell = cell if cell >= 0 else strongest_cell
    if marks.shape[0] > 0 and light[1] < K.SOLID:
        mark_surface(marks, strongest_cell)
    hidden = len(net.density)
    for i in range(first, first + kept):
        encode_direction(ray.dx, ray.dy, ray.dz, tape.h2, i, hidden)
    return kept


@njit(**K.OPTIONS)
def render_pass(
    space: Any, volume: Any, net: Net, tape: Tape, background: Any, origins: Any, directions: Any, stop: Any, threshold: Any, out: Any
) -> None:
    """Origins, directions (B, 3) → out (B, 5) colour, distance, opacity. `tape` is this thread's own."""
    marks, light = np.empty(0, np.uint16), np.empty(5, np.float32)
    starts = np.empty(RAYS + 1, np.int64)
    number = 0
    while number < len(origins):
        begun, used, rays = number, K.START, K.START
        while number < len(origins) and rays < RAYS and used < BATCH:
            starts[rays] = used
            dx, dy, dz = directions[number, 0], directions[number, 1], directions[number, 2]
            line = origins[number, 0], origins[number, 1], origins[number, 2], dx, dy, dz
            used += march_ray(space, volume, net, tape, used, line, ZERO, stop, threshold, marks, light)
            out[number, 3] = light[2]
            rays += 1
            number += 1
        starts[rays] = used
        decode_colours(net, tape, used)
        for r in range(rays):
            own = out[begun + r]
            opacity, a, b, c = ZERO, ZERO, ZERO, ZERO
            for i in range(starts[r], starts[r + 1]):
                weight = tape.values[i, K.WEIGHT]
                opacity += weight
                a += weight * tape.colour[i, 0]
                b += weight * tape.colour[i, 1]
                c += weight * tape.colour[i, 2]
            own[0], own[1], own[2], own[4] = a, b, c, opacity
            for k in range(3):
                own[k] = min(max(own[k] + (ONE - opacity) * background[k], ZERO), ONE)
