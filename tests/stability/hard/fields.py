"""Small volumes, fields and rays for tests: random, seeded, hard where numbers usually break."""

from __future__ import annotations

import torch
from torch import Tensor

from fieldfuse.nerfusion.decoder import make_decoder
from fieldfuse.render.field import Field
from fieldfuse.render.march import MarchGrid
from fieldfuse.volume.edit import with_corner_blocks
from fieldfuse.volume.space import Space
from fieldfuse.volume.topology import BLOCK, VOXELS, Topology


def lattice(topology: Topology) -> Tensor:
    """(M · 512, 3) int64 lattice coordinates (x, y, z) of every row."""
    row = torch.arange(topology.zero_row)
    local = torch.stack([row % 8, row // 8 % 8, row // 64 % 8], 1)
    return topology.keys.long()[row // VOXELS] * BLOCK + local


def scattered_blocks(count: int, seed: int, reach: int = 2) -> Topology:
    """Random blocks round the origin: some touch by faces, edges or corners, others stand alone."""
    generator = torch.Generator().manual_seed(seed)
    keys = torch.unique(torch.randint(-reach, reach + 1, (4 * count, 3), generator=generator), dim=0)
    return Topology(keys[torch.randperm(len(keys), generator=generator)[:count]])


CHANNELS = 16  # of a field, as by default: kernels are compiled for each number of them


def small_field(seed: int = 0, share: float = 0.3, resolution: int = 32, shell: float = 0.0, decoder: str = "deferred") -> Field:
    """A random field round the origin, dense enough to stop some of the light."""
    generator = torch.Generator().manual_seed(seed)
    torch.manual_seed(seed)
    side = resolution // 8
    line = torch.arange(side)
    topology = Topology(torch.stack(torch.meshgrid(line, line, line, indexing="ij"), -1).view(-1, 3))
    topology, occupied = with_corner_blocks(topology, torch.rand(topology.zero_row, generator=generator) < share)
    raw = torch.randn(topology.zero_row + 1, generator=generator) - 1
    features = torch.randn(topology.zero_row + 1, CHANNELS, generator=generator)
    raw[-1], features[-1] = 0, 0
    net = make_decoder(decoder, CHANNELS, 16)
    for parameter in net.parameters():
        parameter.data.add_(0.1 * torch.randn(parameter.shape, generator=generator))
    return Field(Space((0.1, -0.2, 0.3), 1.2, shell), resolution, topology, occupied, raw, features, net, torch.tensor([0.2, 0.5, 0.7]))


def aimed_rays(count: int, seed: int = 0, away: float = 4.0) -> tuple[Tensor, Tensor]:
    """(B, 3) origins on a sphere and unit directions to places near its centre."""
    generator = torch.Generator().manual_seed(seed)
    origins = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1) * away
    aims = torch.randn(count, 3, generator=generator) * 0.5
    return origins, torch.nn.functional.normalize(aims - origins, dim=1)


def lattice_grid(resolution: int, share: float, seed: int = 0, half: float = 1.0, shell: float = 0.0) -> MarchGrid:
    """A lattice round the origin with `share` of its voxels occupied."""
    generator = torch.Generator().manual_seed(seed)
    line = torch.arange(resolution // BLOCK)
    topology = Topology(torch.stack(torch.meshgrid(line, line, line, indexing="ij"), -1).view(-1, 3))
    occupied = torch.rand(topology.zero_row, generator=generator) < share
    return MarchGrid(Space((0.0, 0.0, 0.0), half, shell), resolution, topology, occupied)


def unit(directions: Tensor) -> Tensor:
    return torch.nn.functional.normalize(directions.double(), dim=1).float()


def random_rays(count: int, seed: int, away: float = 3.0, spread: float = 0.6) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    origins = unit(torch.randn(count, 3, generator=generator)) * away
    return origins, unit(torch.randn(count, 3, generator=generator) * spread - origins)
