"""What pictures ask of a field's colours, projected back, compiled; `recolour.project_back` is the reference."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from toolkit.render import kernels as K
from toolkit.render.compiled import MOST_KEPT
from toolkit.render.kernels_decode import decode, encode_direction
from toolkit.render.kernels_lookup import gather_row
from toolkit.render.kernels_march import march_ray


@njit(**K.OPTIONS)
def project_back_pass(
    space: Any,
    volume: Any,
    decoder: Any,
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
        steepest, most: see `recolour.STEEPEST` and `recolour.MOST`.
        marks: (M · 512,) uint16 for `kernels_march.mark`.
    """
    channels, hidden = len(space.width), len(space.hidden)
    cells, values = np.empty(MOST_KEPT, np.int32), np.empty((MOST_KEPT, K.VALUES), np.float32)
    rows, weights = np.empty((MOST_KEPT, 8), np.int32), np.empty((MOST_KEPT, 8), np.float32)
    features, given = np.empty((MOST_KEPT, channels), np.float32), np.zeros(channels + K.PADDED, np.float32)
    h1, h2, result = np.empty(hidden, np.float32), np.empty(hidden, np.float32), np.empty(4, np.float32)
    own, asked = np.empty(3, np.float32), np.empty(3, np.float32)
    for ray in range(len(origins)):
        ox, oy, oz = origins[ray, 0], origins[ray, 1], origins[ray, 2]
        dx, dy, dz = directions[ray, 0], directions[ray, 1], directions[ray, 2]
        kept = march_ray(space, volume, ox, oy, oz, dx, dy, dz, K.ZERO, stop, threshold, marks, 0, cells, rows, values, result)
        opacity = K.ZERO
        for i in range(kept):
            opacity += values[i, K.WEIGHT]
        if opacity < K.SOLID:
            continue
        for c in range(channels):
            given[c] = K.ZERO
        for i in range(kept):
            gather_row(space.width, volume.feature, rows, values, weights, features, i)
            weight = values[i, K.WEIGHT]
            for c in range(channels):
                given[c] += weight * features[i, c]
            for corner in range(8):
                K.prefetch(sums, np.int64(rows[i, corner]))
        for c in range(channels):
            given[c] /= opacity
        encode_direction(dx, dy, dz, given, channels)
        decode(space, decoder, given, h1, h2, own)
        for k in range(3):
            slope = max(own[k] * (K.ONE - own[k]), steepest)
            asked[k] = min(max((colours[ray, k] - own[k]) / slope, -most), most)
        for i in range(kept):
            for corner in range(8):
                row = rows[i, corner]
                part = values[i, K.WEIGHT] * weights[i, corner]
                sums[row, 0] += part * asked[0]
                sums[row, 1] += part * asked[1]
                sums[row, 2] += part * asked[2]
                sums[row, 3] += part
