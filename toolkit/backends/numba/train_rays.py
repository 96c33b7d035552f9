"""A batch of rays of one optimisation step, compiled: march, composite, decode, losses, and all gradients, a few rays at a time.

The gradients are those of `step.Optimiser` (torch, the reference), written out per ray; the equations stand there.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from fieldfuse.backends.numba import common as K
from fieldfuse.backends.numba.decode import RAYS, Rays, decode, encode_direction
from fieldfuse.backends.numba.lookup import gather_row
from fieldfuse.backends.numba.march import march_ray
from fieldfuse.backends.numba.rows import add_row, add_to, product_with, put_row
from fieldfuse.backends.numba.train_common import ask_for, depth_pull, pixel_ray, slow_near
from fieldfuse.backends.numba.train_decoder import Tape, decode_backward, forget_gradients

F, ZERO, ONE, TWO = K.F, K.ZERO, K.ONE, K.TWO
MOST = 1024  # samples of one ray that are kept, see `march`
ROOM = 2 * MOST  # samples of all rays of a block: one with fewer than `RAYS` rays where they are many
AHEAD = 8  # pixels for which memory is asked before they are needed
WALK_WORK = F(0.7)  # what a coarse step costs whose fine ones are tried, in samples that are looked up


class Block(NamedTuple):
    """Up to `RAYS` rays, and their samples: those of ray r are starts[r] … starts[r + 1]. One thread's own."""

    starts: Any  # (R + 1,) int64
    ray: Any  # (R, 6) float32 origin and direction
    opacity: Any  # (R,)
    g_opacity: Any  # (R,)
    cells: Any  # (S,) int32
    rows: Any  # (S, 8) int32 lattice corners
    weights: Any  # (S, 8) float32 trilinear
    values: Any  # (S, VALUES)
    features: Any  # (S, C)
    g_weight: Any  # (S,)
    g_mean: Any  # (C,) of the ray at hand
    result: Any  # (4,) of the ray at hand, see `march_ray`
    tape: Tape  # of the decoder


def make_block(tape: Tape, channels: int) -> Block:
    """Room for one thread."""
    of_rays = (np.zeros(RAYS + 1, np.int64), *(np.zeros(shape, np.float32) for shape in ((RAYS, 6), RAYS, RAYS)))
    floats = (np.zeros((ROOM, width), np.float32) for width in (8, K.VALUES, channels))
    of_samples = (np.zeros(ROOM, np.int32), np.zeros((ROOM, 8), np.int32), *floats, np.zeros(ROOM, np.float32))
    return Block._make([*of_rays, *of_samples, np.zeros(channels, np.float32), np.zeros(4, np.float32), tape])


@njit(**K.OPTIONS)
def gradient_pass(
    space: Any,
    volume: Any,
    layers: Any,
    back: Any,
    background: Any,
    pixels: Any,
    picks: Any,
    jitter: Any,
    shares: Any,
    losses: Any,
    marks: Any,
    index: Any,
    bases: Any,
    thread: Any,
    gradients: Any,
    block: Any,
    met: Any,
) -> Any:
    """Forward and backward over the rays of pixels `picks`. A few of them are marched, decoded together, and their gradients go back to the
    lattice while all that is known of their samples is still in the cache.

    Args:
        back: the decoder's weights, transposed (`train_decoder.Turned`).
        shares: (len(picks),) float32 what each ray counts in the means over the whole batch, of which these may be a part.
        marks: (M · 512,) uint16, this thread's own, or of length 0.
        index: (M · 512 + 1, threads + 1) int32; column 1 + `thread`, less bases[thread], is where a row's sums are in `gradients`;
            negative: not touched, as all are on entry.
        bases: (threads,) int64, which a batch moves past what the ones before wrote, so that nothing has to be wiped.
        block: this thread's own; its tape's `total` has the sums of the gradients of the decoder's weights afterwards.
        met: (len(picks), 3) distance where half of the light was stopped, work in samples, and squared colour error, for those that ask;
            or of length 0.

    Returns:
        rows touched, part of the mean over the batch of squared colour errors, samples looked up.
    """
    used, looked, number, error = K.START, K.START, K.START, 0.0
    forget_gradients(block.tape.total)
    rays = Rays(block.tape.given, block.tape.h1, block.tape.h2, block.tape.colour)  # so that `decode` is compiled for these alone
    while number < len(picks):
        count, seen = _march(space, volume, pixels, picks, number, jitter, losses, marks, block, met)
        _composite(space, volume, index, block, block.tape, count)
        decode(layers, rays, count)
        error += _compare(background, pixels, picks, shares, number, losses, block, block.tape, count, met)
        decode_backward(layers, back, block.tape, count)
        where = index, thread + 1, bases[thread]
        used = _to_lattice(space, volume, pixels, picks, shares, number, losses, *where, gradients, block, block.tape, count, used)
        looked += seen
        number += count
    return used, error, looked


@njit(**K.INLINE)
def _march(
    space: Any, volume: Any, pixels: Any, picks: Any, number: Any, jitter: Any, losses: Any, marks: Any, block: Any, met: Any
) -> Any:
    """Samples of as many rays from picks[number] on as there is room for → their number, and that of samples looked up."""
    ray, starts, result = block.ray, block.starts, block.result
    stop = max(losses.stop, losses.threshold)  # no sample behind weighs more than the light that is left
    count, filled, looked = K.START, K.START, K.START
    while count < RAYS and number + count < len(picks) and filled + MOST <= ROOM:
        at = number + count
        if at + AHEAD < len(picks):
            ask_for(pixels, picks[at + AHEAD])
        pixel_ray(pixels, picks[at], ray, count)
        ox, oy, oz = ray[count, 0], ray[count, 1], ray[count, 2]
        dx, dy, dz = ray[count, 3], ray[count, 4], ray[count, 5]
        limits = stop, losses.threshold
        samples = block.cells, block.rows, block.values
        starts[count] = filled
        filled = march_ray(space, volume, ox, oy, oz, dx, dy, dz, jitter[at], *limits, marks, filled, *samples, result)
        looked += int(result[2])
        if met.shape[0] > 0:
            met[at, 0], met[at, 1] = result[0], result[2] + WALK_WORK * result[3]
        count += 1
    starts[count] = filled
    return count, looked


@njit(**K.INLINE)
def _composite(space: Any, volume: Any, index: Any, block: Any, tape: Any, count: Any) -> None:
    """Mean features of rays, and their directions, into the decoder's inputs; opacities."""
    channels = len(space.width)
    starts, rows, values, features, mean = block.starts, block.rows, block.values, block.features, block.g_mean
    for one in range(count):
        for c in range(channels):
            mean[c] = ZERO
        opacity = ZERO
        for i in range(starts[one], starts[one + 1]):
            gather_row(space.width, volume.feature, rows, values, block.weights, features, i)
            for corner in range(8):
                K.prefetch(index, np.int64(rows[i, corner]))
            weight = values[i, K.WEIGHT]
            opacity += weight
            add_to(space.width, mean, features, i, weight)
        block.opacity[one] = opacity
        scale = ONE / max(opacity, F(1e-6))
        for c in range(channels):
            tape.given[one, c] = mean[c] * scale
        encode_direction(block.ray[one, 3], block.ray[one, 4], block.ray[one, 5], tape.given, one, channels)


@njit(**K.INLINE)
def _compare(
    background: Any,
    pixels: Any,
    picks: Any,
    shares: Any,
    number: Any,
    losses: Any,
    block: Any,
    tape: Any,
    count: Any,
    met: Any,
) -> Any:
    """Gradients at the rays' colours and opacities → part of the mean over rays and channels of the squared error."""
    error = 0.0
    for one in range(count):
        pick, share, opacity = picks[number + one], shares[number + one], block.opacity[one]
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
        if met.shape[0] > 0:
            met[number + one, 2] = own_error
    return error


@njit(**K.INLINE)
def _to_lattice(
    space: Any,
    volume: Any,
    pixels: Any,
    picks: Any,
    shares: Any,
    number: Any,
    losses: Any,
    index: Any,
    column: Any,
    base: Any,
    gradients: Any,
    block: Any,
    tape: Any,
    count: Any,
    used: Any,
) -> Any:
    """From the rays' mean features and opacities to the samples' weights, and on to the lattice corners → rows touched so far."""
    channels = len(space.width)
    values, features, g_weight, g_mean = block.values, block.features, block.g_weight, block.g_mean
    rows, weights, starts = block.rows, block.weights, block.starts
    touched, density_sums, feature_sums = gradients.touched, gradients.density, gradients.feature
    spread = F(4) / (F(space.fine) * F(space.resolution))
    knows = pixels.distance.shape[0] > 0
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
            total += values[i, K.WEIGHT]
            total_place += values[i, K.WEIGHT] * values[i, K.PLACE]
        share = shares[number + one]
        distortion, depth_loss = losses.distortion * share, losses.depth * share
        distance = pixels.distance[picks[number + one]] if knows else ZERO
        before, before_place = ZERO, ZERO
        for i in range(first, last):
            g = constant + depth_loss * depth_pull(values[i, K.ALONG], distance, losses.depth_noise)
            g += product_with(space.width, features, i, g_mean)
            weight, place = values[i, K.WEIGHT], values[i, K.PLACE]
            after, after_place = total - before - weight, total_place - before_place - weight * place
            pull = place * (before - after) - (before_place - after_place)
            g_weight[i] = g + TWO * distortion * (pull + weight * spread * K.THIRD)
            before += weight
            before_place += weight * place
        # ∂L/∂τ_i = T_i e^{-τ_i} g_i - Σ_{j>i} w_j g_j, far to near; then to the lattice
        behind = ZERO
        for i in range(last - 1, first - 1, -1):
            weight, raw = values[i, K.WEIGHT], values[i, K.RAW]
            g_raw = (values[i, K.AFTER] * g_weight[i] - behind) * values[i, K.TAU]
            if raw >= K.RAW_MAX:
                g_raw = ZERO
            behind += weight * g_weight[i]
            slow = slow_near(values[i, K.ALONG], losses.slow_within)
            g_raw *= slow
            weight *= slow
            for corner in range(8):
                row = rows[i, corner]
                if row == zero_row:
                    continue
                part = weights[i, corner]
                at = np.int64(index[row, column]) - base
                if at >= 0:
                    density_sums[at] += part * g_raw
                    add_row(space.width, feature_sums, at, g_mean, part * weight)
                    continue
                index[row, column] = base + used
                touched[used] = row
                density_sums[used] = part * g_raw
                put_row(space.width, feature_sums, used, g_mean, part * weight)
                used += 1
    return used
