"""A field on a coarser lattice: what a page shows of a large scene until its details are loaded."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import torch

from fieldfuse.backends.constants import BRICK
from fieldfuse.render.composite import UNITS
from fieldfuse.render.field import Field, density
from fieldfuse.training.levels import occupancy
from fieldfuse.volume.topology import BLOCK, VOXELS, Topology

Tensor = torch.Tensor
OPAQUE = 2.0  # optical thickness of a fine voxel above which more of it counts no more: solid surfaces would grow thick
LEAST = 1e-6  # weight of a corner whose density is none: its features count where nothing else does
CHUNK = 1024  # blocks at a time


def coarsened(field: Field, ratio: int) -> Field:
    """The field on a lattice of voxels that are `ratio` times as large: occupied where any of theirs is, as dense as these are in the
    mean, so that rays lose about as much light; features are means by density. `ratio` ≥ 2. The field lies on the CPU.

    The lattice's cube is that of the field, or larger by less than a brick, where its voxels do not fill it.
    """
    topology, occupied = occupancy(_places(field.topology, field.occupied.nonzero().view(-1)).div(ratio, rounding_mode="floor"))
    mass, mean = torch.zeros(topology.zero_row + 1), torch.zeros(topology.zero_row + 1, field.feature_rows.shape[1])
    share, most = _shares(field.topology, field.occupied), OPAQUE / (2 * field.space.extent / field.resolution)
    for start in range(0, len(share) - 1, CHUNK * VOXELS):
        row = start + share[start : min(start + CHUNK * VOXELS, len(share) - 1)].nonzero().view(-1)
        place = _places(field.topology, row)
        low, inside = place.div(ratio, rounding_mode="floor"), (place % ratio) / ratio
        weight = share[row] * (density(field.density_rows.detach()[row]).clamp_max(most) + LEAST)
        for shift in product((0, 1), repeat=3):
            step = torch.tensor(shift)
            part = weight * torch.where(step == 1, inside, 1 - inside).prod(1)
            some = part.nonzero().view(-1)
            to = _rows(topology, low[some] + step)
            mass.index_add_(0, to, part[some])
            mean.index_add_(0, to, part[some, None] * field.feature_rows.detach()[row[some]])
    mean /= mass[:, None].clamp_min(1e-30)
    mass /= ratio**3 * _shares(topology, occupied).clamp_min(1e-30)
    raw = torch.log(mass.clamp_min(1e-30) / UNITS)
    mean[-1], raw[-1] = 0, 0
    resolution = -(-field.resolution // (BRICK * ratio)) * BRICK
    return replace(field, resolution=resolution, topology=topology, occupied=occupied, density_rows=raw, feature_rows=mean)


def _places(topology: Topology, row: Tensor) -> Tensor:
    """(N,) rows → (N, 3) int64 x, y, z on the lattice."""
    local = row % VOXELS
    return topology.keys[row // VOXELS].long() * BLOCK + torch.stack([local & 7, (local >> 3) & 7, local >> 6], 1)


def _rows(topology: Topology, place: Tensor) -> Tensor:
    """(N, 3) x, y, z on the lattice → (N,) rows."""
    x, y, z = (place & 7).unbind(1)
    return topology.find(place >> 3) * VOXELS + (z * BLOCK + y) * BLOCK + x


def _shares(topology: Topology, occupied: Tensor) -> Tensor:
    """(M · 512 + 1,) of every lattice corner: the share of the eight voxels about it that are occupied."""
    out = torch.zeros(topology.zero_row + 1)
    for start in range(0, topology.blocks, CHUNK):
        rows = topology.lookup_chunk(start, start + CHUNK)
        cube = occupied[start * VOXELS : (start + len(rows)) * VOXELS].view(-1, BLOCK, BLOCK, BLOCK).float() / 8
        around = torch.zeros(len(rows), BLOCK + 1, BLOCK + 1, BLOCK + 1)
        for z, y, x in product((0, 1), repeat=3):
            around[:, z : z + BLOCK, y : y + BLOCK, x : x + BLOCK] += cube
        out.index_add_(0, rows.view(-1).long(), around.view(-1))
    out[-1] = 0
    return out
