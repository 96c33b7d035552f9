"""A batch of rays of one optimisation step, compiled: march, decode, composite, loss, and all gradients.

The gradients are those of `step.Optimiser` (torch, the reference), written out per ray; the equations stand there.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from toolkit.render import kernels as K
from toolkit.render.kernels_decode import RAYS, decode, encode_direction
from toolkit.render.kernels_lookup import gather_row
from toolkit.render.kernels_march import march_ray
from toolkit.training.depth import REACH as REACH_
from toolkit.training.fused_decoder import decode_backward, forget_gradients

F, ZERO, ONE, TWO = K.F, K.ZERO, K.ONE, K.TWO
REACH = F(REACH_)
MOST = 1024  # samples of one ray that are kept, see `kernels_march`
AHEAD = 8  # pixels for which memory is asked before they are needed
ROOM = 2 * MOST  # samples of all rays of a block: one with fewer than `RAYS` rays where they are many
WALK_WORK = F(0.7)  # what a coarse step costs whose fine ones are tried, in samples that are looked up


class Pixels(NamedTuple):
    """The training pixels: see `rays.PixelPool`."""

    colour: Any  # (N, 3) uint8
    place: Any  # (N,) int32
    source: Any  # (N,) int32 which view
    camera: Any  # (V, 5) float32 fx, fy, cx, cy, width
    pose: Any  # (V, 4, 4) float32
    distance: Any  # (N,) float32 to the surface along the ray, 0: unknown; or of length 0


class Gradients(NamedTuple):
    """What one thread gathers of a batch."""

    touched: Any  # (T,) int32 rows
    density: Any  # (T,) float32 sums over the rays, in the order of `touched`
    feature: Any  # (T, C) float32


class Losses(NamedTuple):
    """Weights of a step's losses, float32."""

    distortion: Any
    opacity: Any
    depth: Any
    depth_noise: Any
    threshold: Any
    stop: Any
    slow_within: Any  # working units; samples nearer than this move slowly (`near`), 0: none


@njit(**K.LEAF)
def pixel_ray(pixels: Any, pick: Any, rays: Any, at: Any) -> None:
    """Origin and unit direction of pixel `pick` into rays[at, 0 … 5]."""
    view = np.int64(pixels.source[pick])
    camera, pose = pixels.camera, pixels.pose
    width, place = np.int32(camera[view, 4]), pixels.place[pick]
    row = place // width
    x = (F(place - row * width) + K.HALF - camera[view, 2]) / camera[view, 0]
    y = (F(row) + K.HALF - camera[view, 3]) / camera[view, 1]
    dx = pose[view, 0, 0] * x + pose[view, 0, 1] * y + pose[view, 0, 2]
    dy = pose[view, 1, 0] * x + pose[view, 1, 1] * y + pose[view, 1, 2]
    dz = pose[view, 2, 0] * x + pose[view, 2, 1] * y + pose[view, 2, 2]
    scale = ONE / np.sqrt(dx * dx + dy * dy + dz * dz)
    rays[at, 0], rays[at, 1], rays[at, 2] = pose[view, 0, 3], pose[view, 1, 3], pose[view, 2, 3]
    rays[at, 3], rays[at, 4], rays[at, 5] = dx * scale, dy * scale, dz * scale


@njit(**K.LEAF)
def depth_pull(along: Any, distance: Any, noise: Any) -> Any:
    """`depth.depth_gradient` of one sample."""
    if distance <= ZERO:
        return ZERO
    return min(max(abs(along - distance) / distance - noise, ZERO) / REACH, ONE) - ONE


@njit(**K.LEAF)
def slow_near(along: Any, within: Any) -> Any:
    """`near.slowness` of one sample."""
    share = max(along, ZERO) / within if along < within and within > ZERO else ONE  # a sample may lie behind its camera
    return share * share


@njit(**K.OPTIONS)
def gradient_pass(
    space: Any,
    volume: Any,
    layers: Any,
    back_layers: Any,
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
    tape: Any,
    met: Any,
) -> Any:
    """Forward and backward over the rays of pixels `picks`, a few at a time: they are marched, decoded together, and their gradients go
    back to the lattice while all that is known of their samples is still in the cache.

    Args:
        shares: (len(picks),) float32 what each ray counts in the means over the whole batch, of which these may be a part.
        marks: (M · 512,) uint16, this thread's own, or of length 0.
        index: (M · 512 + 1, threads + 1) int32; column 1 + `thread`, less bases[thread], is where a row's sums are in `gradients`;
            negative: not touched, as all are on entry.
        bases: (threads,) int64, which a batch moves past what the ones before wrote, so that nothing has to be wiped.
        tape: this thread's own; its `total` has the sums of the gradients of the decoder's weights afterwards.
        met: (len(picks), 3) distance where half of the light was stopped, work in samples, and squared colour error, for those that ask;
            or of length 0.

    Returns:
        rows touched, part of the mean over the batch of squared colour errors, samples looked up.
    """
    channels = len(space.width)
    # Samples of the rays of a block; one ray's alone are at most MOST.
    cells, values = np.empty(ROOM, np.int32), np.empty((ROOM, K.VALUES), np.float32)
    rows, weights = np.empty((ROOM, 8), np.int32), np.empty((ROOM, 8), np.float32)
    features = np.empty((ROOM, channels), np.float32)
    g_weight = np.empty(ROOM, np.float32)
    result, ray = np.empty(4, np.float32), np.empty((RAYS, 6), np.float32)
    g_given, mean = np.empty(channels, np.float32), np.empty(channels, np.float32)
    starts, opacities, g_opacities = np.zeros(RAYS + 1, np.int64), np.empty(RAYS, np.float32), np.empty(RAYS, np.float32)
    # A row of an array is never taken as an array of its own inside the loops, nor an array out of its tuple: each is counted, by an atomic
    # operation.
    feature, truth, distances, places, sources = volume.feature, pixels.colour, pixels.distance, pixels.place, pixels.source
    knows = distances.shape[0] > 0
    touched, density_sums, feature_sums = gradients.touched, gradients.density, gradients.feature
    given, flat, colour, g_logit, g_mean = tape.given, tape.given.reshape(-1), tape.colour, tape.g_logit, tape.g_given
    inputs = given.shape[1]
    stop = max(losses.stop, losses.threshold)  # no sample behind weighs more than the light that is left
    column, base = thread + 1, bases[thread]
    zero_row = volume.density.shape[0] - 1
    spread = F(4) / (F(space.fine) * F(space.resolution))
    used, looked = 0, 0
    error = 0.0
    forget_gradients(tape.total)
    number = 0
    while number < len(picks):
        # march
        count, filled = 0, 0
        while count < RAYS and number + count < len(picks) and filled + MOST <= ROOM:
            at = number + count
            if at + AHEAD < len(picks):
                later = picks[at + AHEAD]
                K.prefetch(places, later)
                K.prefetch(sources, later)
                K.prefetch(truth, later)
                if knows:
                    K.prefetch(distances, later)
            pixel_ray(pixels, picks[at], ray, count)
            starts[count] = filled
            filled = march_ray(
                space,
                volume,
                ray[count, 0],
                ray[count, 1],
                ray[count, 2],
                ray[count, 3],
                ray[count, 4],
                ray[count, 5],
                jitter[at],
                stop,
                losses.threshold,
                marks,
                filled,
                cells,
                rows,
                values,
                result,
            )
            looked += int(result[2])
            if met.shape[0] > 0:
                met[at, 0], met[at, 1] = result[0], result[2] + WALK_WORK * result[3]
            count += 1
        starts[count] = filled
        # composite the features
        for one in range(count):
            for c in range(channels):
                mean[c] = ZERO
            opacity = ZERO
            for i in range(starts[one], starts[one + 1]):
                gather_row(space.width, feature, rows, values, weights, features, i)
                for corner in range(8):
                    K.prefetch(index, np.int64(rows[i, corner]))
                weight = values[i, K.WEIGHT]
                opacity += weight
                for c in range(channels):
                    mean[c] += weight * features[i, c]
            opacities[one] = opacity
            scale = ONE / max(opacity, F(1e-6))
            for c in range(channels):
                given[one, c] = mean[c] * scale
            encode_direction(ray[one, 3], ray[one, 4], ray[one, 5], flat, one * inputs + channels)
        decode(layers, tape, count)
        # loss: mean over rays and channels of the squared error
        for one in range(count):
            pick, share, opacity = picks[number + one], shares[number + one], opacities[one]
            g_opacity = -(ONE - opacity) * (TWO * losses.opacity * share)
            own_error = ZERO
            for k in range(3):
                shown = colour[one, k]
                residual = opacity * shown + (ONE - opacity) * background[k] - F(truth[pick, k]) * F(1 / 255)
                own_error += residual * residual * K.THIRD
                g_mixed = residual * (TWO * K.THIRD * share)
                g_opacity += g_mixed * (shown - background[k])
                g_logit[one, k] = g_mixed * opacity * shown * (ONE - shown)
            g_opacities[one] = g_opacity
            error += own_error * share
            if met.shape[0] > 0:
                met[number + one, 2] = own_error
        decode_backward(layers, back_layers, tape, count)
        for one in range(count):
            first, last = starts[one], starts[one + 1]
            if first == last:
                continue
            # ∂L/∂w: mean = Σ w f / A and A = Σ w
            scale = ONE / max(opacities[one], F(1e-6))
            dot = ZERO
            for c in range(channels):
                g_given[c] = g_mean[one, c] * scale
                dot += g_given[c] * given[one, c]
            constant = g_opacities[one] - dot
            total, total_place = ZERO, ZERO
            for i in range(first, last):
                total += values[i, K.WEIGHT]
                total_place += values[i, K.WEIGHT] * values[i, K.PLACE]
            share = shares[number + one]
            distortion, depth_loss = losses.distortion * share, losses.depth * share
            distance = distances[picks[number + one]] if knows else ZERO
            before, before_place = ZERO, ZERO
            for i in range(first, last):
                g = constant + depth_loss * depth_pull(values[i, K.ALONG], distance, losses.depth_noise)
                for c in range(channels):
                    g += features[i, c] * g_given[c]
                weight, place = values[i, K.WEIGHT], values[i, K.PLACE]
                after, after_place = total - before - weight, total_place - before_place - weight * place
                pull = place * (before - after) - (before_place - after_place)
                g_weight[i - first] = g + TWO * distortion * (pull + weight * spread * K.THIRD)
                before += weight
                before_place += weight * place
            # ∂L/∂τ_i = T_i e^{-τ_i} g_i - Σ_{j>i} w_j g_j, far to near; then to the lattice
            behind = ZERO
            for back in range(last - first):
                i = last - 1 - back
                weight, raw = values[i, K.WEIGHT], values[i, K.RAW]
                g_raw = (values[i, K.AFTER] * g_weight[i - first] - behind) * values[i, K.TAU]
                if raw >= K.RAW_MAX:
                    g_raw = ZERO
                behind += weight * g_weight[i - first]
                slow = slow_near(values[i, K.ALONG], losses.slow_within)
                g_raw *= slow
                weight *= slow
                for corner in range(8):
                    row = rows[i, corner]
                    if row == zero_row:
                        continue
                    at = np.int64(index[row, column]) - base
                    if at < 0:
                        at = used
                        index[row, column] = base + at
                        touched[at] = row
                        density_sums[at] = ZERO
                        for c in range(channels):
                            feature_sums[at, c] = ZERO
                        used += 1
                    part = weights[i, corner]
                    density_sums[at] += part * g_raw
                    part *= weight
                    for c in range(channels):
                        feature_sums[at, c] += part * g_given[c]
        number += count
    return used, error, looked
