"""Small random fields for tests."""

from __future__ import annotations

from dataclasses import replace

import torch

from fieldfuse.evaluation.sphere import sphere_field
from fieldfuse.nerfusion.decoder import make_decoder
from fieldfuse.render.field import Field
from fieldfuse.training.levels import NewField, all_places
from fieldfuse.volume.host import TorchHost
from fieldfuse.volume.space import Space


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
