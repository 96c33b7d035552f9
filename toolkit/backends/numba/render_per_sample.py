"""Renders with the paper's decoder, compiled: a pass over rays."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from fieldfuse.backends.numba import common as K
from fieldfuse.backends.numba.decode_per_sample import BATCH, Net, Tape, decode_colours
from fieldfuse.backends.numba.march_per_sample import march_ray

RAYS = 64  # rays whose colours are decoded together, when they have few samples


@njit(**K.OPTIONS)
def render_pass(
    space: Any,
    volume: Any,
    net: Net,
    tape: Tape,
    background: Any,
    origins: Any,
    directions: Any,
    stop: Any,
    threshold: Any,
    out: Any,
) -> None:
    """Origins, directions (B, 3) → out (B, 5) colour, distance, opacity."""
    marks, ray, light = np.empty(0, np.uint16), np.empty(6, np.float32), np.empty(5, np.float32)
    starts = np.empty(RAYS + 1, np.int64)
    number = 0
    while number < len(origins):
        begun, used, rays = number, K.START, K.START
        while number < len(origins) and rays < RAYS and used < BATCH:
            for k in range(3):
                ray[k], ray[3 + k] = origins[number, k], directions[number, k]
            starts[rays] = used
            used += march_ray(space, volume, net, tape, used, ray, K.ZERO, stop, threshold, marks, light)
            out[number, 3] = light[2]
            rays += 1
            number += 1
        starts[rays] = used
        decode_colours(net, tape, used)
        for r in range(rays):
            own = out[begun + r]
            opacity, a, b, c = K.ZERO, K.ZERO, K.ZERO, K.ZERO
            for i in range(starts[r], starts[r + 1]):
                weight = tape.values[i, K.WEIGHT]
                opacity += weight
                a += weight * tape.colour[i, 0]
                b += weight * tape.colour[i, 1]
                c += weight * tape.colour[i, 2]
            own[0], own[1], own[2], own[4] = a, b, c, opacity
            for k in range(3):
                own[k] = min(max(own[k] + (K.ONE - opacity) * background[k], K.ZERO), K.ONE)
