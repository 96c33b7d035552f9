"""Rays through a field whose rays are decoded once, compiled: renders, and images projected back to its colours.

`render/recolour.py` is the reference of `project_back_pass`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from fieldfuse.backends.numba import common as K
from fieldfuse.backends.numba.decode import RAYS, decode, encode_direction
from fieldfuse.backends.numba.lookup import gather_row
from fieldfuse.backends.numba.march import Samples, march_ray
from fieldfuse.backends.numba.rows import add_to

ROOM = 2 * K.MOST_KEPT  # samples of all rays that are decoded together


@njit(**K.INLINE)
def mean_feature(
    space: Any, volume: Any, samples: Any, first: Any, last: Any, weights: Any, features: Any, mean: Any, ahead: Any
) -> Any:
    """Features of samples first … last - 1 of a ray, their weighted sum in `mean` (C,) → opacity.

    Args:
        weights: (S, 8), features: (S, C): trilinear weights and features of the samples, written.
        ahead: an array whose rows at the samples' corners are prefetched; or of length 0.
    """
    rows, values = samples.rows, samples.values
    for c in range(len(space.width)):
        mean[c] = K.ZERO
    opacity = K.ZERO
    for i in range(first, last):
        if samples.cells[i] < 0:
            gather_row(space.width, volume.outer.feature, rows, values, weights, features, i)
        else:
            gather_row(space.width, volume.feature, rows, values, weights, features, i)
        if ahead.shape[0] > 0 and samples.cells[i] >= 0:
            for corner in range(8):
                K.prefetch(ahead, np.int64(rows[i, corner]))
        weight = values[i, K.WEIGHT]
        opacity += weight
        add_to(space.width, mean, features, i, weight)
    return opacity


@njit(**K.OPTIONS)
def render_pass(
    space: Any, volume: Any, layers: Any, tape: Any, background: Any, origins: Any, directions: Any, stop: Any, threshold: Any, out: Any
) -> None:
    """Deferred rendering: origins, directions (B, 3) → out (B, 5) colour, distance, opacity. `tape` is this thread's own."""
    channels = len(space.width)
    samples = Samples(np.empty(K.MOST_KEPT, np.int32), np.empty((K.MOST_KEPT, 8), np.int32), np.empty((K.MOST_KEPT, K.VALUES), np.float32))
    weights, ahead = np.empty((K.MOST_KEPT, 8), np.float32), np.empty((0, 1), np.float32)
    features, mean, result = np.empty((K.MOST_KEPT, channels), np.float32), np.empty(channels, np.float32), np.empty(4, np.float32)
    marks, given, colour = np.empty(0, np.uint16), tape.given, tape.colour
    for begin in range(0, len(origins), RAYS):
        count = min(RAYS, len(origins) - begin)
        for one in range(count):
            ray = begin + one
            dx, dy, dz = directions[ray, 0], directions[ray, 1], directions[ray, 2]
            line = origins[ray, 0], origins[ray, 1], origins[ray, 2], dx, dy, dz
            kept = march_ray(space, volume, line, K.ZERO, stop, threshold, marks, K.START, samples, result)
            opacity = mean_feature(space, volume, samples, K.START, kept, weights, features, mean, ahead)
            share = K.ONE / max(opacity, K.F(1e-6))
            for c in range(channels):
                given[one, c] = mean[c] * share
            encode_direction(dx, dy, dz, given, one, channels)
            out[ray, 3], out[ray, 4] = result[0], opacity
        decode(layers, tape, count)
        for one in range(count):
            opacity = out[begin + one, 4]
            for k in range(3):
                out[begin + one, k] = min(max(colour[one, k] * opacity + (K.ONE - opacity) * background[k], K.ZERO), K.ONE)


@njit(**K.OPTIONS)
def project_back_pass(
    space: Any, volume: Any, layers: Any, tape: Any, origins: Any, directions: Any, colours: Any, limits: Any, marks: Any, sums: Any
) -> None:
    """Add what the rays (B, 3) that end somewhere are short of to `sums` (M · 512 + 1, 4): Σ a (c − ĉ) / ĉ' and Σ a.

    Args:
        tape: this thread's own `decode.Rays`.
        limits: float32 stop and threshold of the march, and `STEEPEST` and `MOST` of `render.color_backprojection`.
        marks: (M · 512,) uint16 for `march.mark`.
    """
    channels = len(space.width)
    stop, threshold, steepest, most = limits
    samples = Samples(np.empty(ROOM, np.int32), np.empty((ROOM, 8), np.int32), np.empty((ROOM, K.VALUES), np.float32))
    rows, values, weights = samples.rows, samples.values, np.empty((ROOM, 8), np.float32)
    features, mean = np.empty((ROOM, channels), np.float32), np.empty(channels, np.float32)
    result, wanted, starts = np.empty(4, np.float32), np.empty(3, np.float32), np.zeros(RAYS + 1, np.int64)
    of_block = np.empty(RAYS, np.int64)
    given, colour, ray = tape.given, tape.colour, 0
    while ray < len(origins):
        count = 0
        while ray < len(origins) and count < RAYS and starts[count] + K.MOST_KEPT <= ROOM:
            first = starts[count]
            ox, oy, oz = origins[ray, 0], origins[ray, 1], origins[ray, 2]
            dx, dy, dz = directions[ray, 0], directions[ray, 1], directions[ray, 2]
            last = march_ray(space, volume, (ox, oy, oz, dx, dy, dz), K.ZERO, stop, threshold, marks, first, samples, result)
            of_block[count] = ray
            ray += 1
            opacity = K.ZERO
            for i in range(first, last):
                opacity += values[i, K.WEIGHT]
            if opacity < K.SOLID:
                continue
            mean_feature(space, volume, samples, first, last, weights, features, mean, sums)
            for c in range(channels):
                given[count, c] = mean[c] / opacity
            encode_direction(dx, dy, dz, given, count, channels)
            count += 1
            starts[count] = last
        decode(layers, tape, count)
        for one in range(count):
            for k in range(3):
                own = colour[one, k]
                slope = max(own * (K.ONE - own), steepest)
                wanted[k] = min(max((colours[of_block[one], k] - own) / slope, -most), most)
            for i in range(starts[one], starts[one + 1]):
                for corner in range(8):
                    row = rows[i, corner]
                    part = values[i, K.WEIGHT] * weights[i, corner]
                    sums[row, 0] += part * wanted[0]
                    sums[row, 1] += part * wanted[1]
                    sums[row, 2] += part * wanted[2]
                    sums[row, 3] += part
