"""What training rays see of a field's voxels, compiled: the sums that Gaussians begin with."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from fieldfuse.backends.numba import common as K
from fieldfuse.backends.numba.decode import encode_direction
from fieldfuse.backends.numba.march import Samples, march_ray

# Columns of a voxel's sums, of samples with the weight w of the ray's light at the place p in the voxel, seen from a direction with the
# harmonics b of degree 1 and less, in a pixel of colour c: Σ w, Σ w p, Σ w p pᵀ, light that enters, Σ w b bᵀ, Σ w b cᵀ.
WEIGHT, PLACE, SQUARE, ENTERS, BASES, COLOURS = 0, 1, 4, 10, 11, 21
SUMS = 33


@njit(**K.OPTIONS)
def gather_pass(
    space: Any, volume: Any, slots: Any, origins: Any, directions: Any, seen: Any, colours: Any, limits: Any, sums: Any
) -> None:
    """March rays (B, 3) and add to the sums of the voxels that have a slot.

    Args:
        slots: (M · 512,) int32 row of a voxel among sums (S, SUMS) float32; −1: none.
        limits: float32 stop and threshold, see `march_ray`.
        seen: (B, 3) the rays' directions in the frame of the harmonics; colours: (B, 3) of their pixels.
    """
    stop, threshold = limits
    samples = Samples(np.empty(K.MOST_KEPT, np.int32), np.empty((K.MOST_KEPT, 8), np.int32), np.empty((K.MOST_KEPT, K.VALUES), np.float32))
    cells, values = samples.cells, samples.values
    result, marks, basis = np.empty(4, np.float32), np.empty(0, np.uint16), np.empty((1, 16), np.float32)
    for ray in range(len(origins)):
        line = origins[ray, 0], origins[ray, 1], origins[ray, 2], directions[ray, 0], directions[ray, 1], directions[ray, 2]
        last = march_ray(space, volume, line, K.ZERO, stop, threshold, marks, K.START, samples, result)
        encode_direction(seen[ray, 0], seen[ray, 1], seen[ray, 2], basis, K.START, K.START)
        i = 0
        while i < last:
            cell, enters, weight = cells[i], values[i, K.AFTER] + values[i, K.WEIGHT], K.ZERO
            slot = slots[cell]
            while i < last and cells[i] == cell:
                w, x, y, z = values[i, K.WEIGHT], values[i, K.X], values[i, K.Y], values[i, K.Z]
                i += 1
                weight += w
                if slot >= 0:
                    sums[slot, PLACE] += w * x
                    sums[slot, PLACE + 1] += w * y
                    sums[slot, PLACE + 2] += w * z
                    sums[slot, SQUARE] += w * x * x
                    sums[slot, SQUARE + 1] += w * x * y
                    sums[slot, SQUARE + 2] += w * x * z
                    sums[slot, SQUARE + 3] += w * y * y
                    sums[slot, SQUARE + 4] += w * y * z
                    sums[slot, SQUARE + 5] += w * z * z
            if slot < 0:
                continue
            sums[slot, WEIGHT] += weight
            sums[slot, ENTERS] += enters
            at = BASES
            for row in range(4):
                for column in range(row, 4):
                    sums[slot, at] += weight * basis[0, row] * basis[0, column]
                    at += 1
                for channel in range(3):
                    sums[slot, COLOURS + 3 * row + channel] += weight * basis[0, row] * colours[ray, channel]
