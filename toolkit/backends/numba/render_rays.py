"""Renders with the deferred decoder, compiled: a pass over rays, and the distances by which they skip empty space."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from fieldfuse.backends.numba import common as K
from fieldfuse.backends.numba.decode import RAYS, decode, encode_direction
from fieldfuse.backends.numba.lookup import gather_row
from fieldfuse.backends.numba.march import march_ray
from fieldfuse.backends.numba.rows import add_to


@njit(**K.OPTIONS)
def chessboard_distance(bricks: Any, most: Any) -> None:
    """In place: 0 where something is, else `most` → distance along the longest axis, capped; two sweeps are exact for it.

    Each sweep takes rows from four rows that it has been to, many bricks at a time, and then goes along the row.
    """
    a, b, c = bricks.shape
    far, one = np.uint8(most), np.uint8(1)
    near = np.empty(c + 2, np.uint8)  # the nearest of the four rows, with a margin
    for sweep in range(2):
        way = 1 if sweep == 0 else -1
        for i0 in range(a):
            i = i0 if sweep == 0 else a - 1 - i0
            for j0 in range(b):
                j = j0 if sweep == 0 else b - 1 - j0
                row = bricks[i, j]
                near[:] = far
                for side in range(4):
                    p, q = (i, j - way) if side == 3 else (i - way, j + side - 1)
                    if 0 <= p < a and 0 <= q < b:
                        other = bricks[p, q]
                        for k in range(c):
                            here, there = near[k + 1], other[k]
                            near[k + 1] = there if there < here else here
                for k in range(c):
                    left, here, right = near[k], near[k + 1], near[k + 2]
                    here = left if left < here else here
                    here = np.uint8((right if right < here else here) + one)
                    row[k] = here if here < row[k] else row[k]
                last = far
                for k0 in range(c):
                    k = k0 if sweep == 0 else c - 1 - k0
                    step, here = np.uint8(last + one), row[k]
                    last = step if step < here else here
                    row[k] = last


@njit(**K.OPTIONS)
def render_pass(
    space: Any, volume: Any, layers: Any, tape: Any, background: Any, origins: Any, directions: Any, stop: Any, threshold: Any, out: Any
) -> None:
    """Deferred rendering: origins, directions (B, 3) → out (B, 5) colour, distance, opacity. `tape` is this thread's own."""
    channels = len(space.width)
    cells, values = np.empty(K.MOST_KEPT, np.int32), np.empty((K.MOST_KEPT, K.VALUES), np.float32)
    rows, weights = np.empty((K.MOST_KEPT, 8), np.int32), np.empty((K.MOST_KEPT, 8), np.float32)
    features, mean, result = np.empty((K.MOST_KEPT, channels), np.float32), np.empty(channels, np.float32), np.empty(4, np.float32)
    marks, feature, given, colour = np.empty(0, np.uint16), volume.feature, tape.given, tape.colour
    for begin in range(0, len(origins), RAYS):
        count = min(RAYS, len(origins) - begin)
        for one in range(count):
            ray = begin + one
            ox, oy, oz = origins[ray, 0], origins[ray, 1], origins[ray, 2]
            dx, dy, dz = directions[ray, 0], directions[ray, 1], directions[ray, 2]
            kept = march_ray(space, volume, ox, oy, oz, dx, dy, dz, K.ZERO, stop, threshold, marks, K.START, cells, rows, values, result)
            for c in range(channels):
                mean[c] = K.ZERO
            opacity = K.ZERO
            for i in range(kept):
                gather_row(space.width, feature, rows, values, weights, features, i)
                weight = values[i, K.WEIGHT]
                opacity += weight
                add_to(space.width, mean, features, i, weight)
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
