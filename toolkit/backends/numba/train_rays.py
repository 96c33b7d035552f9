"""A batch of rays of one optimisation step, compiled: march, composite, decode, losses, and all gradients, a few rays at a time.

The gradients are those of `torch_engine` (the reference), written out per ray; the equations stand there.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from fieldfuse.backends.numba import common as K
from fieldfuse.backends.numba.decode import RAYS, Rays, Tape, decode, decode_backward, encode_direction, forget_gradients
from fieldfuse.backends.numba.march import Samples, march_ray
from fieldfuse.backends.numba.render import mean_feature
from fieldfuse.backends.numba.rows import add_row, product_with, put_row
from fieldfuse.backends.numba.train_batch import AHEAD, add_ray_terms, near_scale, pixel_ray, prefetch_pixel

F, ZERO, ONE, TWO = K.F, K.ZERO, K.ONE, K.TWO
MOST = 1024  # samples of one ray that are kept, see `march`
ROOM = 2 * MOST  # samples of all rays of a block: one with fewer than `RAYS` rays where they are many
WALK_WORK = F(0.7)  # what a coarse step costs whose fine ones are tried, in samples that are looked up


class Block(NamedTuple):
    """Up to `RAYS` rays, and their samples: those of ray r are starts[r] … starts[r + 1]. One thread's own."""

    starts: Any  # (R + 1,) int64
    direction: Any  # (R, 3) float32
    opacity: Any  # (R,)
    g_opacity: Any  # (R,)
    samples: Samples
    weights: Any  # (S, 8) float32 trilinear
    features: Any  # (S, C)
    g_weight: Any  # (S,)
    g_mean: Any  # (C,) of the ray at hand
    result: Any  # (4,) of the ray at hand, see `march_ray`
    tape: Tape  # of the decoder


def make_block(tape: Tape, channels: int) -> Block:
    """Room for one thread."""
    samples = Samples(np.zeros(ROOM, np.int32), np.zeros((ROOM, 8), np.int32), np.zeros((ROOM, K.VALUES), np.float32))
    of_rays = (np.zeros(shape, np.float32) for shape in ((RAYS, 3), RAYS, RAYS))
    of_samples = (np.zeros(shape, np.float32) for shape in ((ROOM, 8), (ROOM, channels), ROOM, channels, 4))
    return Block._make([np.zeros(RAYS + 1, np.int64), *of_rays, samples, *of_samples, tape])


@njit(**K.OPTIONS)
def gradient_pass(
    space: Any, volume: Any, layers: Any, back: Any, background: Any, pixels: Any, part: Any, losses: Any, marks: Any, sums: Any, block: Any
) -> Any:
    """Forward and backward over the rays of a `Part`. A few of them are marched, decoded together, and their gradients go back to the
    lattice while all that was computed of their samples is still in the cache.

    Args:
        back: the decoder's weights, transposed (`decode.Turned`).
        marks: (M · 512,) uint16, this thread's own, or of length 0.
        sums: `Sums`, of which nothing is touched on entry.
        block: this thread's own; its tape's `total` has the sums of the gradients of the decoder's weights afterwards.

    Returns:
        rows touched, part of the mean over the batch of squared colour errors, samples looked up.
    """
    used, looked, number, error = K.START, K.START, K.START, 0.0
    tape = block.tape
    forget_gradients(tape.total)
    rays = Rays(tape.given, tape.h1, tape.h2, tape.colour)  # so that `decode` is compiled for these alone
    while number < len(part.picks):
        count, seen = _march(space, volume, pixels, part, number, losses, marks, block)
        _composite(space, volume, sums.index, block, count)
        decode(layers, rays, count)
        error += _compare(background, pixels, part, number, losses, block, count)
        decode_backward(layers, back, tape, count)
        used = _to_lattice(space, volume, pixels, part, number, losses, sums, block, count, used)
        looked += seen
        number += count
    return used, error, looked


@njit(**K.INLINE)
def _march(space: Any, volume: Any, pixels: Any, part: Any, number: Any, losses: Any, marks: Any, block: Any) -> Any:
    """Samples of as many rays from picks[number] on as there is room for → their number, and that of samples looked up."""
    starts, result, picks = block.starts, block.result, part.picks
    stop = max(losses.stop, losses.threshold)  # no sample behind weighs more than the light that is left
    count, filled, looked = K.START, K.START, K.START
    while count < RAYS and number + count < len(picks) and filled + MOST <= ROOM:
        at = number + count
        if at + AHEAD < len(picks):
            prefetch_pixel(pixels, picks[at + AHEAD])
        line = pixel_ray(pixels, picks[at])
        block.direction[count, 0], block.direction[count, 1], block.direction[count, 2] = line[3], line[4], line[5]
        starts[count] = filled
        filled = march_ray(space, volume, line, part.jitter[at], stop, losses.threshold, marks, filled, block.samples, result)
        looked += int(result[2])
        part.met[at, 0], part.met[at, 1] = result[0], result[2] + WALK_WORK * result[3]
        count += 1
    starts[count] = filled
    return count, looked


@njit(**K.INLINE)
def _composite(space: Any, volume: Any, index: Any, block: Any, count: Any) -> None:
    """Mean features of rays, and their directions, into the decoder's inputs; opacities."""
    channels, given, mean, starts = len(space.width), block.tape.given, block.g_mean, block.starts
    for one in range(count):
        first, last = starts[one], starts[one + 1]
        opacity = mean_feature(space, volume, block.samples, first, last, block.weights, block.features, mean, index)
        block.opacity[one] = opacity
        scale = ONE / max(opacity, F(1e-6))
        for c in range(channels):
            given[one, c] = mean[c] * scale
        encode_direction(block.direction[one, 0], block.direction[one, 1], block.direction[one, 2], given, one, channels)


@njit(**K.INLINE)
def _compare(background: Any, pixels: Any, part: Any, number: Any, losses: Any, block: Any, count: Any) -> Any:
    """Gradients at the rays' colours and opacities → part of the mean over rays and channels of the squared error."""
    error, tape = 0.0, block.tape
    for one in range(count):
        pick, share, opacity = part.picks[number + one], part.shares[number + one], block.opacity[one]
        g_opacity = -(ONE - opacity) * (TWO * losses.opacity * share)
        own_error = ZERO
        for k in range(3):
            shown = tape.colour[one, k]
            residual = opacity * shown + (ONE - opacity) * background[k] - F(pixels.colour[pick, k]) * F(1 / 255)
            own_error += residual * residual * K.THIRD
            g_mixed = residual * (TWO * K.THIRD * share)
            g_opacity += g_mixed * (shown - background[k])
            tape.g_logit[one, k] = g_mixed * opacity * shown * (ONE - shown)
        block.g_opacity[one] = g_opacity
        error += own_error * share
        part.met[number + one, 2] = own_error
    return error


@njit(**K.INLINE)
def _to_lattice(
    space: Any, volume: Any, pixels: Any, part: Any, number: Any, losses: Any, sums: Any, block: Any, count: Any, used: Any
) -> Any:
    """From the rays' mean features and opacities to the samples' weights, and on to the lattice corners → rows touched so far."""
    channels, tape = len(space.width), block.tape
    rows, values, features, g_weight, g_mean = block.samples.rows, block.samples.values, block.features, block.g_weight, block.g_mean
    weights, starts = block.weights, block.starts
    touched, density_sums, feature_sums, index, column, base = sums
    known = pixels.distance.shape[0] > 0
    zero_row = volume.density.shape[0] - 1
    for one in range(count):
        first, last = starts[one], starts[one + 1]
        if first == last:
            continue
        # ∂L/∂w: mean = Σ w f / A and A = Σ w
        scale = ONE / max(block.opacity[one], F(1e-6))
        dot = ZERO
        for c in range(channels):
            g_mean[c] = tape.g_given[one, c] * scale
            dot += g_mean[c] * tape.given[one, c]
        constant = block.g_opacity[one] - dot
        total, total_place = ZERO, ZERO
        for i in range(first, last):
            g_weight[i] = constant + product_with(space.width, features, i, g_mean)
            total += values[i, K.WEIGHT]
            total_place += values[i, K.WEIGHT] * values[i, K.PLACE]
        distance = pixels.distance[part.picks[number + one]] if known else ZERO
        add_ray_terms(space, values, first, last, (total, total_place), part.shares[number + one], distance, losses, g_weight)
        # ∂L/∂τ_i = T_i e^{-τ_i} g_i - Σ_{j>i} w_j g_j, far to near; then to the lattice
        behind = ZERO
        for i in range(last - 1, first - 1, -1):
            weight = values[i, K.WEIGHT]
            g_raw = (values[i, K.AFTER] * g_weight[i] - behind) * values[i, K.TAU] if values[i, K.RAW] < K.RAW_MAX else ZERO
            behind += weight * g_weight[i]
            if block.samples.cells[i] < 0:  # of the outer field, which stays as it is
                continue
            slow = near_scale(values[i, K.ALONG], losses.slow_within)
            g_raw *= slow
            weight *= slow
            for corner in range(8):
                row = rows[i, corner]
                if row == zero_row:
                    continue
                share = weights[i, corner]
                at = np.int64(index[row, column]) - base
                if at >= 0:
                    density_sums[at] += share * g_raw
                    add_row(space.width, feature_sums, at, g_mean, share * weight)
                    continue
                index[row, column] = base + used
                touched[used] = row
                density_sums[used] = share * g_raw
                put_row(space.width, feature_sums, used, g_mean, share * weight)
                used += 1
    return used
