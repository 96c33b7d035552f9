"""A batch of rays of one optimisation step, compiled: march, decode, composite, loss, and all gradients.

The gradients are those of `step.Optimiser` (torch, the reference), written out per ray; the equations stand there.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from toolkit.render import kernels as K
from toolkit.render.kernels_decode import decode, encode_direction, multiply
from toolkit.render.kernels_lookup import gather_row
from toolkit.render.kernels_march import march_ray
from toolkit.training.depth import REACH as REACH_

F, ZERO, ONE, TWO = K.F, K.ZERO, K.ONE, K.TWO
REACH = F(REACH_)
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
    given: Any  # (B, I) float32, a row a ray: what went into the decoder, its hidden layers, and their gradients
    h1: Any  # (B, H)
    h2: Any
    g1: Any
    g2: Any
    g_logit: Any  # (B, 3)


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
def pixel_ray(pixels: Any, pick: Any, ray: Any) -> None:
    """Origin and unit direction of pixel `pick` into ray[0 … 5]."""
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
    ray[0], ray[1], ray[2] = pose[view, 0, 3], pose[view, 1, 3], pose[view, 2, 3]
    ray[3], ray[4], ray[5] = dx * scale, dy * scale, dz * scale


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


@njit(**K.LEAF)
def _decoder_backward(space: Any, decoder: Any, h1: Any, h2: Any, g_logit: Any, g1: Any, g2: Any, g_given: Any) -> None:
    """Back through `kernels.decode`, from logits (3,) to hidden layers and to the features g_given[:C].

    The weights' own gradients are sums over rays of products of what lies on both sides of them: one matrix product a batch, later.
    """
    hidden = len(space.hidden)
    a, b, c = g_logit[0], g_logit[1], g_logit[2]
    for j in range(hidden):
        total = a * decoder.w3[0, j] + b * decoder.w3[1, j] + c * decoder.w3[2, j]
        g2[j] = total if h2[j] > ZERO else ZERO
    multiply(space.hidden, space.hidden, decoder.w2, g2, g1)
    for i in range(hidden):
        g1[i] = g1[i] if h1[i] > ZERO else ZERO
    multiply(space.width, space.hidden, decoder.w1, g1, g_given)
    g_given[0] += a
    g_given[1] += b
    g_given[2] += c


@njit(**K.OPTIONS)
def gradient_pass(
    space: Any,
    volume: Any,
    decoder: Any,
    background: Any,
    pixels: Any,
    picks: Any,
    jitter: Any,
    shares: Any,
    losses: Any,
    marks: Any,
    index: Any,
    thread: Any,
    gradients: Any,
    met: Any,
) -> Any:
    """Forward and backward over the rays of pixels `picks`.

    Args:
        shares: (len(picks),) float32 what each ray counts in the means over the whole batch, of which these may be a part.
        marks: (M · 512,) uint16, this thread's own, or of length 0.
        index: (M · 512 + 1, threads + 1) int32; column 1 + `thread` is where a row's sums are in `gradients`, −1: not touched, as all are
            on entry.
        met: (len(picks), 3) distance where half of the light was stopped, work in samples, and squared colour error, for those that ask;
            or of length 0.

    Returns:
        rows touched, part of the mean over the batch of squared colour errors, samples looked up.
    """
    channels = len(space.width)
    most = 1024
    cells, values = np.empty(most, np.int32), np.empty((most, K.VALUES), np.float32)
    rows, weights = np.empty((most, 8), np.int32), np.empty((most, 8), np.float32)
    features = np.empty((most, channels), np.float32)
    g_weight = np.empty(most, np.float32)
    g_given = np.empty(channels, np.float32)
    colour, result, ray = np.empty(3, np.float32), np.empty(4, np.float32), np.empty(6, np.float32)
    # A row of an array is never taken as an array of its own inside the loops, nor an array out of its tuple: each is counted, by an atomic
    # operation. So a ray's own rows lie here, and are put where they belong at its end.
    inputs, hidden = len(space.inputs), len(space.hidden)
    given, g_logit = np.zeros(inputs, np.float32), np.empty(3, np.float32)
    h1, h2 = np.empty(hidden, np.float32), np.empty(hidden, np.float32)
    g1, g2 = np.empty(hidden, np.float32), np.empty(hidden, np.float32)
    all_given, all_h1, all_h2, all_g1, all_g2 = gradients.given, gradients.h1, gradients.h2, gradients.g1, gradients.g2
    all_g_logit, feature, truth, distances = gradients.g_logit, volume.feature, pixels.colour, pixels.distance
    touched, density_sums, feature_sums = gradients.touched, gradients.density, gradients.feature
    column = thread + 1
    zero_row = volume.density.shape[0] - 1
    spread = F(4) / (F(space.fine) * F(space.resolution))
    used, looked = 0, 0
    error = 0.0
    for number in range(len(picks)):
        pick = picks[number]
        pixel_ray(pixels, pick, ray)
        kept = march_ray(
            space,
            volume,
            ray[0],
            ray[1],
            ray[2],
            ray[3],
            ray[4],
            ray[5],
            jitter[number],
            losses.stop,
            losses.threshold,
            marks,
            cells,
            rows,
            values,
            result,
        )
        looked += int(result[2])
        if met.shape[0] > 0:
            met[number, 0], met[number, 1] = result[0], result[2] + WALK_WORK * result[3]
        # composite the features
        for c in range(channels):
            given[c] = ZERO
        opacity = ZERO
        for i in range(kept):
            gather_row(space.width, feature, rows, values, weights, features, i)
            for corner in range(8):
                K.prefetch(index, np.int64(rows[i, corner]))
            weight = values[i, K.WEIGHT]
            opacity += weight
            for c in range(channels):
                given[c] += weight * features[i, c]
        scale = ONE / max(opacity, F(1e-6))
        for c in range(channels):
            given[c] *= scale
        encode_direction(ray[3], ray[4], ray[5], given, channels)
        decode(space, decoder, given, h1, h2, colour)
        # loss: mean over rays and channels of the squared error
        share = shares[number]
        g_opacity = -(ONE - opacity) * (TWO * losses.opacity * share)
        own_error = ZERO
        for k in range(3):
            residual = opacity * colour[k] + (ONE - opacity) * background[k] - F(truth[pick, k]) * F(1 / 255)
            own_error += residual * residual * K.THIRD
            g_mixed = residual * (TWO * K.THIRD * share)
            g_opacity += g_mixed * (colour[k] - background[k])
            g_logit[k] = g_mixed * opacity * colour[k] * (ONE - colour[k])
        error += own_error * share
        if met.shape[0] > 0:
            met[number, 2] = own_error
        _decoder_backward(space, decoder, h1, h2, g_logit, g1, g2, g_given)
        for c in range(inputs):
            all_given[number, c] = given[c]
        for j in range(hidden):
            all_h1[number, j], all_h2[number, j], all_g1[number, j], all_g2[number, j] = h1[j], h2[j], g1[j], g2[j]
        for k in range(3):
            all_g_logit[number, k] = g_logit[k]
        if kept == 0:
            continue
        # ∂L/∂w: mean = Σ w f / A and A = Σ w
        dot = ZERO
        for c in range(channels):
            g_given[c] *= scale
            dot += g_given[c] * given[c]
        constant = g_opacity - dot
        total, total_place = ZERO, ZERO
        for i in range(kept):
            total += values[i, K.WEIGHT]
            total_place += values[i, K.WEIGHT] * values[i, K.PLACE]
        distortion, depth_loss = losses.distortion * share, losses.depth * share
        distance = distances[pick] if distances.shape[0] > 0 else ZERO
        before, before_place = ZERO, ZERO
        for i in range(kept):
            g = constant + depth_loss * depth_pull(values[i, K.ALONG], distance, losses.depth_noise)
            for c in range(channels):
                g += features[i, c] * g_given[c]
            weight, place = values[i, K.WEIGHT], values[i, K.PLACE]
            after, after_place = total - before - weight, total_place - before_place - weight * place
            pull = place * (before - after) - (before_place - after_place)
            g_weight[i] = g + TWO * distortion * (pull + weight * spread * K.THIRD)
            before += weight
            before_place += weight * place
        # ∂L/∂τ_i = T_i e^{-τ_i} g_i - Σ_{j>i} w_j g_j, far to near; then to the lattice
        behind = ZERO
        for back in range(kept):
            i = kept - 1 - back
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
                at = index[row, column]
                if at < 0:
                    at = used
                    index[row, column] = at
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
    return used, error, looked


@njit(**K.LEAF)
def add_products(columns: Any, inputs: Any, gradients: Any, weight: Any, bias: Any) -> None:
    """Gradients of a layer: inputs (B, I)ᵀ @ gradients (B, O) into weight (I, O), and the sums of `gradients` into bias (O,).

    Not left to BLAS, whose own threads would stand in the way of those that take parts of a batch. Four rays at a time, so that a row
    of `weight` is read and written once for all of them.
    """
    outputs = len(columns)
    weight[:] = ZERO
    bias[:] = ZERO
    whole = len(inputs) // 4 * 4
    for ray in range(0, whole, 4):
        for i in range(inputs.shape[1]):
            a, b, c, d = inputs[ray, i], inputs[ray + 1, i], inputs[ray + 2, i], inputs[ray + 3, i]
            if a == ZERO and b == ZERO and c == ZERO and d == ZERO:
                continue
            for j in range(outputs):
                pair = a * gradients[ray, j] + b * gradients[ray + 1, j]
                weight[i, j] += pair + (c * gradients[ray + 2, j] + d * gradients[ray + 3, j])
        for j in range(outputs):
            bias[j] += gradients[ray, j] + gradients[ray + 1, j] + (gradients[ray + 2, j] + gradients[ray + 3, j])
    for ray in range(whole, len(inputs)):
        for i in range(inputs.shape[1]):
            a = inputs[ray, i]
            for j in range(outputs):
                weight[i, j] += a * gradients[ray, j]
        for j in range(outputs):
            bias[j] += gradients[ray, j]
