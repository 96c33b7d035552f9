"""What speed is measured on: a thin sphere of voxels seen by cameras around it, the same on every machine and at every size."""

from __future__ import annotations

import math

import numpy as np
import torch

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.capture.types import Views
from fieldfuse.nerfusion.decoder import make_decoder
from fieldfuse.render.composite import UNITS
from fieldfuse.render.field import Field
from fieldfuse.render.paths import look_at
from fieldfuse.training.levels import NewField, all_places
from fieldfuse.training.pixels import PixelPool
from fieldfuse.volume.host import TorchHost
from fieldfuse.volume.space import Space

RADIUS = 0.7  # of the sphere, in half sizes of the region
THICK = 4  # voxels of the sphere's wall, on either side
CHANNELS, HIDDEN = 16, 96  # the defaults of a fit


def sphere_field(resolution: int, seed: int = 0) -> Field:
    """A field whose occupied voxels lie on a sphere, each with an optical thickness of about ½, and random features."""
    generator = torch.Generator().manual_seed(seed)
    state = torch.get_rng_state()
    torch.manual_seed(seed)
    decoder = make_decoder("deferred", CHANNELS, HIDDEN)
    torch.set_rng_state(state)
    space = Space((0.0, 0.0, 0.0), 1.0, 0.0)
    places = all_places(space, resolution)
    voxel = 2 / resolution
    distance = ((places.float() + 0.5) * voxel - 1).norm(dim=1)
    places = places[(distance - RADIUS).abs() < THICK * voxel]
    raw = math.log(0.5 / (UNITS * voxel))
    field = NewField(space, resolution, decoder, torch.zeros(3)).on(places, TorchHost(), raw, generator)
    field.feature_rows[:-1] += torch.randn(field.feature_rows[:-1].shape, generator=generator)
    return field


def around(count: int = 8, radius: float = 2.4) -> Array:
    """(count, 4, 4) cameras on a ring, looking at the middle."""
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    positions = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0.4 * radius * np.cos(2 * angle)], 1)
    return look_at(positions, np.zeros(3), np.array([0.0, 0.0, 1.0]))


def lens(width: int, height: int) -> Intrinsics:
    """A pinhole that sees the whole sphere."""
    return Intrinsics(width, height, 1.3 * height, 1.3 * height, width / 2, height / 2)


def sphere_pixels(side: int = 96, seed: int = 0, count: int = 8) -> PixelPool:
    """Pixels of random colour in `count` square images: what is fitted does not matter, only what it takes."""
    generator = np.random.default_rng(seed)
    poses = around(count)
    images = [generator.integers(0, 256, (side, side, 3), dtype=np.uint8) for _ in poses]
    names = [str(index) for index in range(len(poses))]
    return PixelPool(Views(names, images, [lens(side, side)] * len(poses), poses, np.zeros(len(poses), bool)))
