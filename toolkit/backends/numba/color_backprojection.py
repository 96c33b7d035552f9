"""What images ask of a field's colours, projected back, compiled; `color_backprojection.project_back` is the reference."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from fieldfuse.backends.numba import common as K
from fieldfuse.backends.numba.decode import RAYS, decode, encode_direction
from fieldfuse.backends.numba.lookup import gather_row
from fieldfuse.backends.numba.march import march_ray
from fieldfuse.backends.numba.rows import add_to

ROOM = 2 * K.MOST_KEPT  # samples of all rays that are decoded together


@njit(**K.OPTIONS)
def project_back_pass(
    space: Any,
    volume: Any,
    layers: Any,
    tape: Any,
    origins: Any,
    directions: Any,
    colours: Any,
    stop: Any,
    threshold: Any,
    steepest: Any,
    most: Any,
    marks: Any,
    sums: Any,
) -> None:
    """Add what the rays (B, 3) that end somewhere ask for to `sums` (M · 512 + 1, 4): Σ a (c − ĉ) / ĉ' and Σ a.

    Args:
        tape: this thread's own `decode.Rays`.
        steepest, most: see `color_backprojection.STEEPEST` and `color_backprojection.MOST`.
        marks: (M · 512,) uint16 for `march.mark`.
    """
    channels = len(space.width)
    cells, values = np.empty(ROOM, np.int32), np.empty((ROOM, K.VALUES), np.float32)
    rows, weights = np.empty((ROOM, 8), np.int32), np.empty((ROOM, 8), np.float32)
    features, mean = np.empty((ROOM, channels), np.float32), np.empty(channels, np.float32)
    result, asked, starts = np.empty(4, np.float32), np.empty(3, np.float32), np.zeros(RAYS + 1, np.int64)
    of_block = np.empty(RAYS, np.int64)
    feature, given, colour, ray = volume.feature, tape.given, tape.colour, 0
    while ray < len(origins):
        count = 0
        while ray < len(origins) and count < RAYS and starts[count] + K.MOST_KEPT <= ROOM:
            first = starts[count]
            ox, oy, oz = origins[ray, 0], origins[ray, 1], origins[ray, 2]
            dx, dy, dz = directions[ray, 0], directions[ray, 1], directions[ray, 2]
            last = march_ray(space, volume, ox, oy, oz, dx, dy, dz, K.ZERO, stop, threshold, marks, first, cells, rows, values, result)
            of_block[count] = ray
            ray += 1
            opacity = K.ZERO
            for i in range(first, last):
                opacity += values[i, K.WEIGHT]
            if opacity < K.SOLID:
                continue
            for c in range(channels):
                mean[c] = K.ZERO
            for i in range(first, last):
                gather_row(space.width, feature, rows, values, weights, features, i)
                add_to(space.width, mean, features, i, values[i, K.WEIGHT])
                for corner in range(8):
                    K.prefetch(sums, np.int64(rows[i, corner]))
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
                asked[k] = min(max((colours[of_block[one], k] - own) / slope, -most), most)
            for i in range(starts[one], starts[one + 1]):
                for corner in range(8):
                    row = rows[i, corner]
                    part = values[i, K.WEIGHT] * weights[i, corner]
                    sums[row, 0] += part * asked[0]
                    sums[row, 1] += part * asked[1]
                    sums[row, 2] += part * asked[2]
                    sums[row, 3] += part
