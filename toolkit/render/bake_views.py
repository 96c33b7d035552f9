"""Which voxels the training views see: what none of them saw was never fitted, and costs memory and time in a baked field."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numba import njit

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.progress import SILENT, Progress
from fieldfuse.render import kernels as K
from fieldfuse.render.compiled import make_space, make_volume
from fieldfuse.render.composite import STOP
from fieldfuse.render.field import Field
from fieldfuse.render.kernels_march import march_ray
from fieldfuse.threads import share
from fieldfuse.volume.compiled import dilated

SEEN = 0.01  # largest weight below which a voxel is left out …
FIRM = 0.3  # … but for those beside one with as much: where thin surfaces have holes, pictures from between the views see through them
MOST_RAYS = 3_000_000  # of all views together; of more pixels a regular part is looked at


@njit(**K.OPTIONS)
def mark_pass(space: Any, volume: Any, cameras: Any, poses: Any, first: Any, last: Any, stride: Any, stop: Any, marks: Any) -> None:
    """Mark what views `first` … `last` - 1 see, every `stride`-th pixel.

    Args:
        cameras: (N, 6) float32 fx, fy, cx, cy, width, height; poses: (N, 3, 4) float32; marks: (M · 512,) uint16, see `kernels.mark`.
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


def seen_voxels(
    field: Field,
    intrinsics: Sequence[Intrinsics],
    world_from_camera: Array,
    least: float = SEEN,
    threads: int = 1,
    progress: Progress = SILENT,
) -> torch.Tensor:
    """(M · 512,) bool: voxels that hold more than `least` of some pixel's light, over pinhole views (N, 4, 4), and those beside a voxel
    that holds more than `FIRM` of it.

    Raises:
        Interrupted: the user asked to stop.
    """
    space, volume = make_space(field), make_volume(field)
    cameras = np.array([(c.fx, c.fy, c.cx, c.cy, c.width, c.height) for c in intrinsics], np.float32).reshape(-1, 6)
    poses = np.ascontiguousarray(world_from_camera[:, :3], np.float32)
    pixels = sum(c.width * c.height for c in intrinsics)
    stride = -(-pixels // MOST_RAYS) or 1
    marks = np.zeros((threads, len(field.occupied)), np.uint16)

    def part(thread: int) -> None:
        for view in range(thread, len(cameras), threads):
            if progress.stopping():
                return
            if thread == 0:
                progress.update(view, len(cameras), "looking where training views look")
            mark_pass(space, volume, cameras, poses, view, view + 1, stride, np.float32(STOP), marks[thread])

    share(part, range(threads), threads)
    progress.check()
    weight = torch.from_numpy((marks.max(0) >> 4).astype(np.float32) / 4095)
    return (weight > least) | (dilated(field.topology, weight > max(FIRM, least)) & field.occupied)
