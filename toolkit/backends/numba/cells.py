"""Which blocks and which cells rays see, compiled (`training/cells`)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from fieldfuse.backends.numba import common as K
from fieldfuse.backends.numba.march import Samples, march_ray


@njit(**K.OPTIONS)
def light_held(space: Any, volume: Any, lines: Any, stop: Any, threshold: Any, owner: Any, least: Any, rays: Any, out: Any) -> None:
    """Which groups of blocks hold at least the share `least` of the light that each ray loses.

    Args:
        lines: (B, 6) float32 origins and unit directions; stop, threshold: see `march_ray`.
        owner: (M,) int32 group of each block.
        rays: (G,) int64, to which each ray adds one for every such group.
        out: (B, G) bool, filled; or (0, 0).
    """
    sums = np.zeros(len(rays), np.float32)
    samples = Samples(np.empty(K.MOST_KEPT, np.int32), np.empty((K.MOST_KEPT, 8), np.int32), np.empty((K.MOST_KEPT, K.VALUES), np.float32))
    result, marks = np.empty(4, np.float32), np.empty(0, np.uint16)
    for ray in range(len(lines)):
        line = lines[ray, 0], lines[ray, 1], lines[ray, 2], lines[ray, 3], lines[ray, 4], lines[ray, 5]
        kept = march_ray(space, volume, line, K.ZERO, stop, threshold, marks, K.START, samples, result)
        total = K.ZERO
        for i in range(kept):
            sums[owner[samples.cells[i] >> 9]] += samples.values[i, K.WEIGHT]
            total += samples.values[i, K.WEIGHT]
        for i in range(kept):
            group = owner[samples.cells[i] >> 9]
            if sums[group] >= least * total and sums[group] > K.ZERO:
                rays[group] += 1
                if out.shape[0] > 0:
                    out[ray, group] = True
            sums[group] = K.ZERO
