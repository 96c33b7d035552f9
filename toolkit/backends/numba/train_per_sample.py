"""Gradients of one batch of rays for the paper's decoder, compiled: the twin of `train_rays.gradient_pass`.

Rays are worked on a few at a time, so that all that was computed of their samples is still in the cache when the gradients come back.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from fieldfuse.backends.constants import FREQUENCIES
from fieldfuse.backends.numba import common as K
from fieldfuse.backends.numba.matrix import add_outer, product
from fieldfuse.backends.numba.per_sample import BATCH, RAYS, SAMPLES, Net, Tape, decode_colours, make_tape, march_ray
from fieldfuse.backends.numba.rows import add_row, put_row
from fieldfuse.backends.numba.train_batch import add_ray_terms, near_scale, pixel_ray

F, ZERO, ONE, TWO = K.F, K.ZERO, K.ONE, K.TWO


class Scratch(NamedTuple):
    """Where a thread works; and its sums over the batch of the gradients of the decoder's weights, `total`."""

    tape: Tape
    g_given: Any  # (S, I)
    g1: Any  # (S, H)
    g2: Any  # (S, H)
    g3: Any  # (S, H)
    g_logit: Any  # (S, 3)
    g_raw: Any  # (S,)
    total: Net  # the transposed ones are not used


def make_scratch(net: Net) -> Scratch:
    """Room for one thread."""
    inputs, hidden = net.w1.shape
    given, g1, g2, g3, logit = (K.aligned((SAMPLES, width), np.float32, zeroed=True) for width in (inputs, hidden, hidden, hidden, 3))
    total = Net(*(K.aligned(weight.shape, np.float32, zeroed=True) for weight in net))
    return Scratch(make_tape(net), given, g1, g2, g3, logit, np.zeros(SAMPLES, np.float32), total)


@njit(**K.OPTIONS)
def _add_rows(values: Any, count: Any, out: Any) -> None:
    """out (J,) += Σ values[:count, :J]."""
    for i in range(count):
        own = values[i]
        for j in range(len(out)):
            out[j] += own[j]


@njit(**K.OPTIONS)
def _encode_backward(width: Any, given: Any, g: Any) -> None:
    """g[:C] from the gradients g[:11 C] of what `per_sample.encode` wrote: d sin(a v) = a cos(a v), d cos(a v) = -a sin(a v)."""
    c_count = len(width)
    cosines = c_count * FREQUENCIES
    angle = F(np.pi)
    for k in range(FREQUENCIES):
        first = c_count * (k + 1)
        for c in range(c_count):
            at = first + c
            g[c] += angle * (g[at] * given[at + cosines] - g[at + cosines] * given[at])
        angle *= TWO


@njit(**K.OPTIONS)
def decoder_backward(width: Any, net: Net, scratch: Scratch, count: Any) -> None:
    """From gradients of logits and raw densities of `count` samples to those of their features, g_given[:count, :C], and of the weights,
    added to `total`."""
    tape, total = scratch.tape, scratch.total
    hidden = len(net.b1)
    for i in range(count):
        a, b, c = scratch.g_logit[i, 0], scratch.g_logit[i, 1], scratch.g_logit[i, 2]
        total.b4[0] += a
        total.b4[1] += b
        total.b4[2] += c
        own, g = tape.h3[i], scratch.g3[i]
        for j in range(hidden):
            total.w4[0, j] += a * own[j]
            total.w4[1, j] += b * own[j]
            total.w4[2, j] += c * own[j]
            value = a * net.w4[0, j] + b * net.w4[1, j] + c * net.w4[2, j]
            g[j] = value if own[j] > ZERO else ZERO
    add_outer(tape.h2, scratch.g3, count, total.w3)
    _add_rows(scratch.g3, count, total.b3)
    product(scratch.g3, K.START, count, net.w3_back, scratch.g2)
    for i in range(count):
        own, g, g_raw = tape.h2[i], scratch.g2[i], scratch.g_raw[i]
        total.density_bias[0] += g_raw
        for j in range(hidden):
            total.density[j] += g_raw * own[j]
            value = g[j] + g_raw * net.density[j]
            g[j] = value if own[j] > ZERO else ZERO
    add_outer(tape.h1, scratch.g2, count, total.w2)
    _add_rows(scratch.g2, count, total.b2)
    product(scratch.g2, K.START, count, net.w2_back, scratch.g1)
    for i in range(count):
        own, g = tape.h1[i], scratch.g1[i]
        for j in range(hidden):
            g[j] = g[j] if own[j] > ZERO else ZERO
    add_outer(tape.given, scratch.g1, count, total.w1)
    _add_rows(scratch.g1, count, total.b1)
    product(scratch.g1, K.START, count, net.w1_back, scratch.g_given)
    for i in range(count):
        _encode_backward(width, tape.given[i], scratch.g_given[i])
        for k in range(3):
            scratch.g_given[i, k] += scratch.g_logit[i, k]


@njit(**K.OPTIONS)
def ray_backward(
    space: Any, scratch: Scratch, first: Any, last: Any, background: Any, target: Any, surface: Any, share: Any, losses: Any
) -> Any:
    """Loss of one ray whose samples are first … last − 1 of the tape, and its gradients for logits and raw densities there.

    Args:
        target: (3,) uint8 colour; surface: distance where the ray ends, 0: unknown; share: what the ray counts in the batch's means.

    Returns:
        mean of squared colour errors.
    """
    values, colour, g_logit, g_raw = scratch.tape.values, scratch.tape.colour, scratch.g_logit, scratch.g_raw
    total, total_place, red, green, blue = ZERO, ZERO, ZERO, ZERO, ZERO
    for i in range(first, last):
        weight = values[i, K.WEIGHT]
        total += weight
        total_place += weight * values[i, K.PLACE]
        red += weight * colour[i, 0]
        green += weight * colour[i, 1]
        blue += weight * colour[i, 2]
    left = ONE - total
    red += left * background[0] - F(target[0]) * F(1 / 255)
    green += left * background[1] - F(target[1]) * F(1 / 255)
    blue += left * background[2] - F(target[2]) * F(1 / 255)
    per_value = TWO * K.THIRD * share
    g_red, g_green, g_blue = red * per_value, green * per_value, blue * per_value
    constant = -(g_red * background[0] + g_green * background[1] + g_blue * background[2]) - left * (TWO * losses.opacity * share)
    for i in range(first, last):
        weight, a, b, c = values[i, K.WEIGHT], colour[i, 0], colour[i, 1], colour[i, 2]
        g_logit[i, 0] = weight * g_red * a * (ONE - a)
        g_logit[i, 1] = weight * g_green * b * (ONE - b)
        g_logit[i, 2] = weight * g_blue * c * (ONE - c)
        g_raw[i] = g_red * a + g_green * b + g_blue * c + constant
    add_ray_terms(space, values, first, last, (total, total_place), share, surface, losses, g_raw)
    # so far ∂L/∂w; ∂L/∂τ_i = T_i e^{-τ_i} g_i - Σ_{j>i} w_j g_j, far to near
    behind = ZERO
    for i in range(last - 1, first - 1, -1):
        g = g_raw[i]
        slow = near_scale(values[i, K.ALONG], losses.slow_within)
        g_raw[i] = slow * (values[i, K.AFTER] * g - behind) * values[i, K.TAU] if values[i, K.RAW] < K.RAW_MAX else ZERO
        behind += values[i, K.WEIGHT] * g
        for k in range(3):
            g_logit[i, k] *= slow
    return (red * red + green * green + blue * blue) * K.THIRD


@njit(**K.OPTIONS)
def _scatter(width: Any, scratch: Scratch, count: Any, zero_row: Any, sums: Any, used: Any) -> Any:
    """Add gradients of samples to the sums of the lattice corners that they were looked up from → rows touched so far."""
    touched, density_sums, feature_sums, index, column, base = sums
    tape = scratch.tape
    # How a row begins stands in `train_rays`, too: as one function, even where the compiler puts it in, it costs 6% of that pass.
    for i in range(count):
        g_raw, g_given = scratch.g_raw[i], scratch.g_given[i]
        for corner in range(8):
            row = tape.rows[i, corner]
            if row == zero_row:
                continue
            share = tape.corners[i, corner]
            at = np.int64(index[row, column]) - base
            if at >= 0:
                density_sums[at] += share * g_raw
                add_row(width, feature_sums, at, g_given, share)
                continue
            index[row, column] = base + used
            touched[used] = row
            density_sums[used] = share * g_raw
            put_row(width, feature_sums, used, g_given, share)
            used += 1
    return used


@njit(**K.OPTIONS)
def gradient_pass(
    space: Any, volume: Any, net: Net, background: Any, pixels: Any, part: Any, losses: Any, marks: Any, sums: Any, scratch: Scratch
) -> Any:
    """As `train_rays.gradient_pass`; the sums of the weights' gradients are in the scratch's `total` afterwards."""
    tape, total, picks = scratch.tape, scratch.total, part.picks
    for array in (total.w1, total.w2, total.w3, total.w4):
        array[:] = ZERO
    for array in (total.b1, total.b2, total.b3, total.b4, total.density, total.density_bias):
        array[:] = ZERO
    zero_row = volume.density.shape[0] - 1
    light, starts = np.empty(5, np.float32), np.empty(RAYS + 1, np.int64)
    used, looked, number, error = K.START, K.START, K.START, 0.0
    while number < len(picks):
        begun, samples, rays = number, K.START, K.START
        while number < len(picks) and rays < RAYS and samples < BATCH:
            line = pixel_ray(pixels, picks[number])
            starts[rays] = samples
            jitter = part.jitter[number]
            kept = march_ray(space, volume, net, tape, samples, line, jitter, losses.stop, losses.threshold, marks, light)
            for i in range(samples, samples + kept):
                for corner in range(8):
                    K.prefetch(sums.index, np.int64(tape.rows[i, corner]))
            samples += kept
            looked += int(light[3])
            part.met[number, 0], part.met[number, 1] = light[2], light[3]
            rays += 1
            number += 1
        starts[rays] = samples
        decode_colours(net, tape, samples)
        for r in range(rays):
            pick, share = picks[begun + r], part.shares[begun + r]
            surface = pixels.distance[pick] if pixels.distance.shape[0] > 0 else ZERO
            own_error = ray_backward(space, scratch, starts[r], starts[r + 1], background, pixels.colour[pick], surface, share, losses)
            error += own_error * share
            part.met[begun + r, 2] = own_error
        decoder_backward(space.width, net, scratch, samples)
        used = _scatter(space.width, scratch, samples, zero_row, sums, used)
    return used, error, looked
