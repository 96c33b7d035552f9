"""Which voxels the training views see: what none of them saw was never fitted, and costs memory and time in a baked field."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from fieldfuse.backends.numba.march import mark_pass
from fieldfuse.camera import Array, Intrinsics
from fieldfuse.progress import SILENT, Progress
from fieldfuse.render.composite import STOP
from fieldfuse.render.field import Field
from fieldfuse.render.numba_renderer import make_space, make_volume
from fieldfuse.threads import share
from fieldfuse.volume.edit import dilate

SEEN = 0.01  # largest weight below which a voxel is left out …
FIRM = 0.3  # … but for those beside one with as much: where thin surfaces have holes, pictures from between the views see through them
MOST_RAYS = 3_000_000  # of all views together; of more pixels a regular part is looked at


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
    return (weight > least) | (dilate(field.topology, weight > max(FIRM, least), 1, grow=False)[1] & field.occupied)
