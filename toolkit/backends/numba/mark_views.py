"""How strongly views see voxels, compiled."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from fieldfuse.backends.numba import common as K
from fieldfuse.backends.numba.march import march_ray


@njit(**K.OPTIONS)
def mark_pass(space: Any, volume: Any, cameras: Any, poses: Any, first: Any, last: Any, stride: Any, stop: Any, marks: Any) -> None:
    """Mark what views `first` … `last` - 1 see, every `stride`-th pixel.

    Args:
        cameras: (N, 6) float32 fx, fy, cx, cy, width, height; poses: (N, 3, 4) float32; marks: (M · 512,) uint16, see `march.mark`.
    """
    cells, values = np.empty(0, np.int32), np.empty((0, K.VALUES), np.float32)
    rows, result = np.empty((0, 8), np.int32), np.empty(4, np.float32)
    for view in range(first, last):
        camera, pose = cameras[view], poses[view]
        width, height = int(camera[4]), int(camera[5])
        ox, oy, oz = pose[0, 3], pose[1, 3], pose[2, 3]
        for pixel in range(view % stride, width * height, stride):
            row = pixel // width
            x = (K.F(pixel - row * width) + K.HALF - camera[2]) / camera[0]
            y = (K.F(row) + K.HALF - camera[3]) / camera[1]
            dx = pose[0, 0] * x + pose[0, 1] * y + pose[0, 2]
            dy = pose[1, 0] * x + pose[1, 1] * y + pose[1, 2]
            dz = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2]
            scale = K.ONE / np.sqrt(dx * dx + dy * dy + dz * dz)
            dx, dy, dz = dx * scale, dy * scale, dz * scale
            march_ray(space, volume, ox, oy, oz, dx, dy, dz, K.ZERO, stop, K.TWO, marks, K.START, cells, rows, values, result)
