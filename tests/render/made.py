"""Small random fields and splats for tests."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from fieldfuse.camera import Intrinsics
from fieldfuse.evaluation.sphere import sphere_field
from fieldfuse.nerfusion.decoder import make_decoder
from fieldfuse.render.field import Field
from fieldfuse.training.levels import NewField, all_places
from fieldfuse.volume.host import TorchHost
from fieldfuse.volume.space import Space

SPLAT_CAMERA = Intrinsics(45, 37, 40.0, 42.0, 21.0, 19.5)
SPLAT_POSE = np.array([[0.936, -0.275, 0.218, 0.1], [0.289, 0.956, -0.036, -0.2], [-0.199, 0.097, 0.975, 0.05], [0, 0, 0, 1]])


def random_field(
    background: float = 0.0,
    resolution: int = 32,
    decoder: str = "deferred",
    keep: float = 1.0,
    seed: int = 0,
    raw: float = -1.0,
    channels: int = 8,
) -> Field:
    """A field whose voxels are occupied with probability `keep`, with random densities, features and decoder."""
    generator = torch.Generator().manual_seed(seed)
    torch.manual_seed(seed)
    space = Space((0.2, -0.1, 0.05), 1.3, background)
    places = all_places(space, resolution)
    places = places[torch.rand(len(places), generator=generator) < keep]
    net = make_decoder(decoder, channels, 16)
    for parameter in net.parameters():
        parameter.data.add_(0.2 * torch.randn(parameter.shape, generator=generator))
    field = NewField(space, resolution, net, torch.tensor([0.2, 0.4, 0.6])).on(places, TorchHost(), raw, generator)
    field.density_rows[:-1] += torch.randn(len(field.density_rows) - 1, generator=generator)
    field.feature_rows[:-1] += torch.randn(field.feature_rows[:-1].shape, generator=generator)
    return field


def random_rays(count: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Origins around the region, directions towards it."""
    generator = torch.Generator().manual_seed(seed)
    origins = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1) * 3
    aims = torch.randn(count, 3, generator=generator) * 0.4
    return origins, torch.nn.functional.normalize(aims - origins, dim=1)


def coloured_field(shell: float = 0.0) -> Field:
    """A sphere of features that change over a few voxels, as fitted ones do, with a decoder that uses direction."""
    field = sphere_field(32)
    row = torch.arange(len(field.feature_rows) - 1)
    place = field.topology.keys[row // 512] * 8 + torch.stack([row & 7, (row >> 3) & 7, (row >> 6) & 7], 1)
    wave = torch.linspace(0.05, 0.4, 16)
    field.feature_rows[:-1] = 2 * torch.sin(place.float().sum(1, keepdim=True) * wave + torch.arange(16))
    generator = torch.Generator().manual_seed(1)
    for parameter in field.decoder.parameters():
        parameter.data.add_(0.1 * torch.randn(parameter.shape, generator=generator))
    return replace(field, space=replace(field.space, shell=shell), background=torch.tensor([0.9, 0.2, 0.4]))


def some_splats(count: int, degree: int, seed: int = 0) -> NDArray[np.float32]:
    """Gaussians before the camera, a few of them beside the image or behind it, some large, some nearly opaque."""
    rng, columns = np.random.default_rng(seed), 11 + 3 * (degree + 1) ** 2
    values = rng.normal(0, 0.3, (count, columns))
    depth = rng.uniform(1, 3, count)
    depth[: count // 10] *= -1
    at = np.stack([rng.uniform(-0.7, 0.7, count) * depth, rng.uniform(-0.6, 0.6, count) * depth, depth], 1)
    values[:, :3] = at @ SPLAT_POSE[:3, :3].T + SPLAT_POSE[:3, 3]
    values[:, 3:6] = rng.uniform(np.log(0.01), np.log(0.25), (count, 3))
    values[:, 6:10] = rng.normal(size=(count, 4))
    values[:, 10] = rng.uniform(-4, 5, count)
    return values.astype(np.float32)
