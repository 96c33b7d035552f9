"""Pictures of a baked field."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from fieldfuse.backends.numba.baked import TILE, render_tiles
from fieldfuse.backends.numba.decode import layers_of, rays_of
from fieldfuse.camera import Array, Intrinsics, pixel_grid, rays
from fieldfuse.errors import InputError
from fieldfuse.render.bake import BakedField
from fieldfuse.render.image import SOLID, Rendered
from fieldfuse.render.sky import on_sky
from fieldfuse.threads import share

STOP = 1e-2  # a ray ends where less than this part of the light is left, and what it saw stands for all of it
THRESHOLD = 5e-3  # samples of smaller weight lend no colour
PIECES = 8  # parts of a picture for each thread, so that none waits long for another


@dataclass(frozen=True)
class Work:
    """What a picture took: operations, not seconds."""

    rays: int
    looked_up: int  # samples in occupied voxels
    coloured: int  # of these, with features
    walked: int  # fine steps, occupied or not


class BakedRenderer:
    """Renders pictures of one baked field on the CPU."""

    def __init__(self, field: BakedField, threads: int | None = None, stop: float = STOP, threshold: float = THRESHOLD) -> None:
        self.field, self.space = field, field.kernel_space()
        self.threads = threads or torch.get_num_threads()
        self.limits = np.float32(stop), np.float32(threshold)
        self.layers = layers_of(field.decoder)

    def render(self, intrinsics: Intrinsics, world_from_camera: Array) -> Rendered:
        """The field as a pinhole camera at `world_from_camera` (4, 4), working frame, sees it."""
        return self.render_counted(intrinsics, world_from_camera)[0]

    def render_counted(self, intrinsics: Intrinsics, world_from_camera: Array) -> tuple[Rendered, Work]:
        """The same with the work it took. The same whatever the number of threads.

        Raises:
            InputError: the camera's lens bends light.
        """
        if intrinsics.distorted:
            raise InputError("a baked field is rendered by pinhole cameras only; undistort the camera first")
        width, height = intrinsics.width, intrinsics.height
        out = np.empty((height * width, 5), np.float32)
        camera = np.array([intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy], np.float32)
        pose = np.ascontiguousarray(world_from_camera[:3], np.float32)
        tiles = -(-width // TILE) * -(-height // TILE)
        pieces = min(PIECES * self.threads, tiles) if self.threads > 1 else 1
        cuts = [tiles * i // pieces for i in range(pieces + 1)]
        fixed = (self.space, self.field.arrays, self.layers, self.field.background, camera, pose, (width, height))

        def part(piece: int) -> Any:
            return render_tiles(*fixed, rays_of(self.layers), (cuts[piece], cuts[piece + 1]), self.limits, out)

        counts = share(part, range(pieces), self.threads)
        looked, coloured, walked = (sum(count[i] for count in counts) for i in range(3))
        if self.field.sky is not None:
            _, directions, _ = rays(intrinsics, world_from_camera, pixel_grid(width, height))
            behind, sky = torch.from_numpy(self.field.background), torch.from_numpy(self.field.sky)
            out[:, :3] = on_sky(torch.from_numpy(out[:, :3]), torch.from_numpy(out[:, 4]), directions, behind, sky).numpy()
        depth = np.where(out[:, 4] >= SOLID, out[:, 3], np.float32(0)).reshape(height, width)
        picture = Rendered(np.ascontiguousarray(out[:, :3]).reshape(height, width, 3), depth, out[:, 4].reshape(height, width).copy())
        return picture, Work(width * height, looked, coloured, walked)
