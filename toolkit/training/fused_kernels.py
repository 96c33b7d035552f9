"""One optimisation step on a batch of rays, compiled: march, decode, composite, loss, all gradients, and the lazy Adam that uses them.

The gradients are those of `step.Optimiser` (torch, the reference), written out per ray; the equations stand there.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from toolkit.render import kernels as K

F, ZERO, ONE, TWO = K.F, K.ZERO, K.ONE, K.TWO
COUNT, FIRST, SECOND = 0, 1, 2  # columns of a row's density record: steps, both moments
AHEAD = 8  # rows for which memory is asked before they are needed


class Pixels(NamedTuple):
    """The training pixels: see `rays.PixelPool`."""

    colour: Any  # (N, 3) uint8
    place: Any  # (N,) int32
    source: Any  # (N,) int32 which view
    camera: Any  # (V, 5) float32 fx, fy, cx, cy, width
    pose: Any  # (V, 4, 4) float32


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
    threshold: Any
    stop: Any


@njit(**K.OPTIONS)
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


@njit(**K.OPTIONS)
def _decoder_backward(space: Any, decoder: Any, h1: Any, h2: Any, g_logit: Any, g1: Any, g2: Any, g_given: Any) -> None:
    """Back through `kernels.decode`, from logits (3,) to hidden layers and to the features g_given[:C].

    The weights' own gradients are sums over rays of products of what lies on both sides of them: one matrix product a batch, later.
    """
    hidden = len(space.hidden)
    a, b, c = g_logit[0], g_logit[1], g_logit[2]
    for j in range(hidden):
        total = a * decoder.w3[0, j] + b * decoder.w3[1, j] + c * decoder.w3[2, j]
        g2[j] = total if h2[j] > ZERO else ZERO
    K.multiply(space.hidden, space.hidden, decoder.w2, g2, g1)
    for i in range(hidden):
        g1[i] = g1[i] if h1[i] > ZERO else ZERO
    K.multiply(space.width, space.hidden, decoder.w1, g1, g_given)
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
    count: Any,
    losses: Any,
    marks: Any,
    index: Any,
    thread: Any,
    gradients: Any,
    depths: Any,
) -> Any:
    """Forward and backward over the rays of pixels `picks`.

    Args:
        count: rays of the whole batch, of which these may be a part.
        marks: (M · 512,) uint16, this thread's own, or of length 0.
        index: (M · 512 + 1, threads + 1) int32; column 1 + `thread` is where a row's sums are in `gradients`, −1: not touched, as all are
            on entry.
        depths: (len(picks),) distance where half of the light was stopped, for those that ask; or of length 0.

    Returns:
        rows touched, sum of squared colour errors, samples looked up.
    """
    channels = len(space.width)
    most = 1024
    cells, values = np.empty(most, np.int32), np.empty((most, K.VALUES), np.float32)
    rows, weights = np.empty((most, 8), np.int32), np.empty((most, 8), np.float32)
    features = np.empty((most, channels), np.float32)
    g_weight = np.empty(most, np.float32)
    g_given = np.empty(channels, np.float32)
    colour, result, ray = np.empty(3, np.float32), np.empty(3, np.float32), np.empty(6, np.float32)
    touched, density_sums, feature_sums = gradients.touched, gradients.density, gradients.feature
    column = thread + 1
    zero_row = volume.density.shape[0] - 1
    per_value = TWO / (F(3) * F(count))
    spread = F(4) / (F(space.fine) * F(space.resolution))
    distortion, opacity_loss = losses.distortion / F(count), TWO * losses.opacity / F(count)
    used, looked = 0, 0
    error = 0.0
    for number in range(len(picks)):
        pick = picks[number]
        pixel_ray(pixels, pick, ray)
        kept = K.march_ray(
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
        if depths.shape[0] > 0:
            depths[number] = result[0]
        given, h1, h2 = gradients.given[number], gradients.h1[number], gradients.h2[number]
        g1, g2, g_logit = gradients.g1[number], gradients.g2[number], gradients.g_logit[number]
        # composite the features
        for c in range(channels):
            given[c] = ZERO
        opacity = ZERO
        for i in range(kept):
            K.gather_row(space.width, volume.feature, rows, values, weights, features, i)
            for corner in range(8):
                K.prefetch(index, np.int64(rows[i, corner]))
            weight = values[i, K.WEIGHT]
            opacity += weight
            for c in range(channels):
                given[c] += weight * features[i, c]
        scale = ONE / max(opacity, F(1e-6))
        for c in range(channels):
            given[c] *= scale
        K.encode_direction(ray[3], ray[4], ray[5], given[channels:])
        K.decode(space, decoder, given, h1, h2, colour)
        # loss: mean over rays and channels of the squared error
        g_opacity = -(ONE - opacity) * opacity_loss
        for k in range(3):
            residual = opacity * colour[k] + (ONE - opacity) * background[k] - F(pixels.colour[pick, k]) * F(1 / 255)
            error += residual * residual
            g_mixed = residual * per_value
            g_opacity += g_mixed * (colour[k] - background[k])
            g_logit[k] = g_mixed * opacity * colour[k] * (ONE - colour[k])
        _decoder_backward(space, decoder, h1, h2, g_logit, g1, g2, g_given)
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
        before, before_place = ZERO, ZERO
        for i in range(kept):
            g = constant
            for c in range(channels):
                g += features[i, c] * g_given[c]
            weight, place = values[i, K.WEIGHT], values[i, K.PLACE]
            after, after_place = total - before - weight, total_place - before_place - weight * place
            pull = place * (before - after) - (before_place - after_place)
            g_weight[i] = g + TWO * distortion * (pull + weight * spread * K._THIRD)
            before += weight
            before_place += weight * place
        # ∂L/∂τ_i = T_i e^{-τ_i} g_i - Σ_{j>i} w_j g_j, far to near; then to the lattice
        behind = ZERO
        for back in range(kept):
            i = kept - 1 - back
            weight, raw = values[i, K.WEIGHT], values[i, K.RAW]
            g_raw = (values[i, K.AFTER] * g_weight[i] - behind) * values[i, K.TAU]
            if raw >= K._RAW_MAX:
                g_raw = ZERO
            behind += weight * g_weight[i]
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
                share = weights[i, corner]
                density_sums[at] += share * g_raw
                share *= weight
                for c in range(channels):
                    feature_sums[at, c] += share * g_given[c]
    return used, error, looked


@njit(**K.OPTIONS)
def adam_pass(
    width: Any,
    volume: Any,
    index: Any,
    density_records: Any,
    feature_records: Any,
    touched: Any,
    density_sums: Any,
    feature_sums: Any,
    thread: Any,
    used: Any,
    records: Any,
    scales: Any,
    rates: Any,
    b1: Any,
    b2: Any,
    epsilon: Any,
) -> Any:
    """Lazy Adam on rows that thread `thread` touched. A row that several touched is moved by the first of them, with the sum in their
    order, so that the result depends on the number of threads alone.

    Args:
        index: (M · 512 + 1, threads + 1) int32; column 0 is a row's Adam record, −1: it has none yet.
        density_records: (K, 3) float32; feature_records: (K, 2 C) float32, first moments, then second.
        touched, density_sums, feature_sums: (threads, …) of all `Gradients`.
        records: how many this thread has given to rows so far; threads take turns in the order of records, so that none asks another.
        scales: (S,) float32 bias correction sqrt(1 - b2^n) / (1 - b1^n) for n steps; the last one beyond.
        rates: (2,) float32 of density and features.

    Returns:
        `records` after this pass.
    """
    channels = len(width)
    density, feature = volume.density, volume.feature
    c1, c2 = ONE - b1, ONE - b2
    threads = index.shape[1] - 1
    for at in range(used):
        if at + AHEAD < used:
            later = np.int64(touched[thread, at + AHEAD])
            record = np.int64(index[later, 0])
            K.prefetch(feature_records, record)
            K.prefetch_half(feature_records, record)
            K.prefetch(density_records, record)
            K.prefetch(feature, later)
        row = touched[thread, at]
        mine = True
        for other in range(threads):
            if other == thread:
                continue
            twin = index[row, other + 1]
            if twin >= 0:
                if other < thread:
                    mine = False
                    break
                density_sums[thread, at] += density_sums[other, twin]
                for c in range(channels):
                    feature_sums[thread, at, c] += feature_sums[other, twin, c]
        if not mine:
            continue
        place = np.int64(index[row, 0])
        if place < 0:
            place = records * threads + thread
            index[row, 0] = place
            records += 1
        steps = density_records[place, COUNT] + ONE
        scale = scales[min(int(steps), len(scales) - 1)]
        g = density_sums[thread, at]
        m = b1 * density_records[place, FIRST] + c1 * g
        v = b2 * density_records[place, SECOND] + c2 * g * g
        density_records[place, COUNT], density_records[place, FIRST], density_records[place, SECOND] = steps, m, v
        density[row] -= rates[0] * scale * m / (np.sqrt(v) + epsilon)
        step = rates[1] * scale
        for c in range(channels):
            g = feature_sums[thread, at, c]
            m = b1 * feature_records[place, c] + c1 * g
            v = b2 * feature_records[place, channels + c] + c2 * g * g
            feature_records[place, c], feature_records[place, channels + c] = m, v
            feature[row, c] -= step * m / (np.sqrt(v) + epsilon)
    return records


@njit(**K.OPTIONS)
def magnitude(values: Any) -> Any:
    """Sum of the absolute values of (N,) float32: NaN or infinite where one of them is, or where they are huge."""
    total = ZERO
    for at in range(len(values)):
        total += abs(values[at])
    return total


@njit(**K.OPTIONS)
def forget(index: Any, thread: Any, touched: Any) -> None:
    """Make `index` good for the next batch."""
    for at in range(len(touched)):
        index[touched[at], thread + 1] = -1


@njit(**K.OPTIONS)
def fade(marks: Any) -> None:
    """Halve weights and visits of all marks (threads, M · 512)."""
    for thread in range(marks.shape[0]):
        own = marks[thread]
        for row in range(len(own)):
            own[row] = (own[row] >> np.uint16(1)) & np.uint16(0xFFF7) & np.uint16(0x7FFF)


@njit(**K.OPTIONS)
def _spread_bits(value: Any) -> Any:
    """10 bits → every third bit."""
    v = np.uint32(value)
    v = (v | (v << np.uint32(16))) & np.uint32(0x030000FF)
    v = (v | (v << np.uint32(8))) & np.uint32(0x0300F00F)
    v = (v | (v << np.uint32(4))) & np.uint32(0x030C30C3)
    return (v | (v << np.uint32(2))) & np.uint32(0x09249249)


@njit(**K.OPTIONS)
def hit_codes(space: Any, pixels: Any, picks: Any, guess: Any, grid: Any, codes: Any, tiles: Any) -> None:
    """Morton codes of where rays are expected to hit: rays that look at the same place come one after the other, so that the memory
    which they share is still in the cache.

    Args:
        guess: (V · gh · gw,) float32 distances last seen from each view, in tiles of `cell` pixels; 0: unknown.
        grid: ints gh, gw, cell.
        codes: (B,) uint32 and tiles: (B,) int32, a pixel's place in `guess`: filled here.
    """
    ray = np.empty(6, np.float32)
    top = F(1023)
    high, wide, cell = np.int32(grid[0]), np.int32(grid[1]), np.int32(grid[2])
    for index in range(len(picks)):
        if index + AHEAD < len(picks):
            later = picks[index + AHEAD]
            K.prefetch(pixels.place, later)
            K.prefetch(pixels.source, later)
            K.prefetch(pixels.colour, later)
        pick = picks[index]
        pixel_ray(pixels, pick, ray)
        view, place = pixels.source[pick], pixels.place[pick]
        width = np.int32(pixels.camera[view, 4])
        row = place // width
        column = place - row * width
        tile = (view * high + row // cell) * wide + column // cell
        tiles[index] = tile
        t = guess[tile] / space.half
        x = (ray[0] - space.cx) / space.half + t * ray[3]
        y = (ray[1] - space.cy) / space.half + t * ray[4]
        z = (ray[2] - space.cz) / space.half + t * ray[5]
        n = max(max(abs(x), abs(y)), max(abs(z), ONE))
        q = (space.extent - space.shell / n) / n * (top / (TWO * space.extent))
        centre = top * K.HALF
        i = int(min(max(x * q + centre, ZERO), top))
        j = int(min(max(y * q + centre, ZERO), top))
        k = int(min(max(z * q + centre, ZERO), top))
        codes[index] = _spread_bits(i) | (_spread_bits(j) << np.uint32(1)) | (_spread_bits(k) << np.uint32(2))


@njit(**K.OPTIONS)
def remember_depths(tiles: Any, depths: Any, guess: Any) -> None:
    """Write the distances (B,) that a batch saw into `guess`, at its tiles (B,)."""
    for index in range(len(tiles)):
        if depths[index] > ZERO:
            guess[tiles[index]] = depths[index]


@njit(**K.OPTIONS)
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


@njit(**K.OPTIONS)
def adam_dense(values: Any, gradient: Any, first: Any, second: Any, rate: Any, b1: Any, b2: Any, epsilon: Any) -> None:
    """Adam on all of `values`, (N,) like the others; the bias correction is part of `rate`."""
    for i in range(len(values)):
        g = gradient[i]
        first[i] = b1 * first[i] + (ONE - b1) * g
        second[i] = b2 * second[i] + (ONE - b2) * g * g
        values[i] -= rate * first[i] / (np.sqrt(second[i]) + epsilon)
