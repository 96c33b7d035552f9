"""Prune, split, resample: the same field before and after, on any unit of length, and what is left when nothing is left."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from fieldfuse.errors import InputError
from fieldfuse.evaluation.selftest.case import Measure, absolute, by_size, case, not_finite, refused
from fieldfuse.evaluation.selftest.lookup import lattice, scattered_blocks
from fieldfuse.nerfusion.decoder import make_decoder
from fieldfuse.render.field import Field, density
from fieldfuse.render.rays import render_rays
from fieldfuse.volume.edit import corner_nodes, erase_empty_blocks, prune, resample, split, trilinear_density, with_corner_blocks
from fieldfuse.volume.lookup import corners, gather
from fieldfuse.volume.space import Space
from fieldfuse.volume.topology import VOXELS, Topology

GROUP = "prune and split"
CHANNELS = 16  # of a field, as by default: kernels are compiled for each number of them


def sparse_volume(seed: int, blocks: int = 6, share: float = 0.1) -> tuple[Topology, Tensor, Tensor]:
    """Blocks with `share` of their voxels occupied, corners included, and (M · 512 + 1, 2) values at corners."""
    generator = torch.Generator().manual_seed(seed)
    topology = scattered_blocks(blocks, seed)
    topology, occupied = with_corner_blocks(topology, torch.rand(topology.zero_row, generator=generator) < share)
    values = torch.randn(topology.zero_row + 1, 2, generator=generator)
    values[:-1][~corner_nodes(topology, occupied)] = 0
    values[-1] = 0
    return topology, occupied, values


def read(topology: Topology, occupied: Tensor, values: Tensor, place: Tensor) -> tuple[Tensor, Tensor]:
    """Values at (N, 3) lattice places (float64) and whether an occupied voxel holds them."""
    cell = place.floor().long()
    local = cell & 7
    slot = topology.find(cell >> 3)
    row = slot.clamp_min(0) * VOXELS + (local[:, 2] * 8 + local[:, 1]) * 8 + local[:, 0]
    held = (slot >= 0) & occupied[row]
    return gather(values, *corners(topology, row, (place - cell).float())), held


def split_errors(seed: int, mode: str) -> dict[str, float]:
    """A split volume against the one before, at random places of it."""
    topology, occupied, values = sparse_volume(seed)
    finer, finer_occupied, (finer_values,) = split(topology, occupied, [values], mode)
    cells = occupied.nonzero().squeeze(1)
    pick = cells[torch.randint(len(cells), (3000,), generator=torch.Generator().manual_seed(seed))]
    place = lattice(topology)[pick].double() + torch.rand(3000, 3, dtype=torch.float64) * 0.998 + 0.001
    before, _ = read(topology, occupied, values, place)
    after, held = read(finer, finer_occupied, finer_values, 2 * place)
    return {
        "value in occupied voxels": by_size(after, before) if mode == "trilinear" else 0.0,
        "occupied places lost": float((~held).sum()),
        "voxels that are not eight times as many": abs(float(finer_occupied.sum()) - 8 * float(occupied.sum())),
        "values that are not finite": not_finite(finer_values),
    }


@case(GROUP, "a trilinear split leaves the field as it was")
def trilinear_split(folder: Path) -> list[Measure]:
    errors = split_errors(3, "trilinear")
    return [Measure(name, error, 1e-6 if name.startswith("value in") else 0.0) for name, error in errors.items()]


@case(GROUP, "a nearest split copies, eight to one")
def nearest_split(folder: Path) -> list[Measure]:
    topology, occupied, values = sparse_volume(5)
    finer, finer_occupied, (finer_values,) = split(topology, occupied, [values], "nearest")
    used = corner_nodes(finer, finer_occupied).nonzero().squeeze(1)
    known = {tuple(value) for value in values.tolist()}
    foreign = sum(tuple(value) not in known for value in finer_values[used].tolist())
    even = used[(lattice(finer)[used] % 2 == 0).all(1)]
    parent = lattice(finer)[even] // 2
    slot, local = topology.find(parent >> 3), parent & 7
    row = slot * VOXELS + (local[:, 2] * 8 + local[:, 1]) * 8 + local[:, 0]
    return [
        Measure("values that no parent has", float(foreign), 0.0),
        Measure("values on the parents' lattice", absolute(finer_values[even], values[row]), 0.0),
        *[Measure(name, error, 0.0) for name, error in split_errors(5, "nearest").items()],
    ]


@case(GROUP, "resampling to another voxel size and back to the same one")
def resampled(folder: Path) -> list[Measure]:
    topology, occupied, values = sparse_volume(7, share=1.0)
    (same,) = resample(topology, occupied, [values], topology.keys, 1.0)
    nodes = corner_nodes(topology, occupied)
    constant = torch.ones_like(values)
    out = [Measure("same voxel size", absolute(same[:-1][nodes], values[:-1][nodes]), 0.0)]
    for scale in (0.37, 0.5, 0.9, 1.7):
        keys = torch.unique((topology.keys.double() / scale).floor().long(), dim=0)
        (other,) = resample(topology, occupied, [constant], keys, scale)
        away = torch.minimum((other - 1).abs(), other.abs())  # a constant stays the constant, or zero where nothing is near
        out.append(Measure(f"a constant at {scale} of the voxel size", float(away.max()), 1e-6))
        out.append(Measure(f"not finite at {scale}", not_finite(other), 0.0))
    return out


@case(GROUP, "pruning does not depend on the unit of length")
def prune_scale(folder: Path) -> list[Measure]:
    topology, occupied, values = sparse_volume(9, share=0.5)
    sigma = values[:, 0].exp() * 4
    sigma[-1] = 0
    kept = prune(occupied, trilinear_density(topology, sigma), 0.1)
    out = [Measure("pruned nothing or everything", float(int(kept.sum()) in (0, int(occupied.sum()))), 0.0)]
    for factor in (1e-6, 1e-3, 1e3, 1e6):
        other = prune(occupied, trilinear_density(topology, sigma / factor), 0.1 * factor)
        out.append(Measure(f"voxels that differ at ×{factor:g}", float((kept != other).sum()), 2.0))
    thick = prune(occupied, trilinear_density(topology, torch.full_like(sigma, 1e30)), 0.1)
    thin = prune(occupied, trilinear_density(topology, torch.zeros_like(sigma)), 0.1)
    out.append(Measure("opaque voxels dropped", float((thick != occupied).sum()), 0.0))
    out.append(Measure("empty voxels kept", float(thin.sum()), 0.0))
    return out


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


@case(GROUP, "pictures before and after a split and a clean-up")
def pictures_agree(folder: Path) -> list[Measure]:
    """With twice as many samples a brick before the split as after it, both march through the same places, but in a ray's last step."""
    field = replace(small_field(2), fine=16)
    origins, directions = aimed_rays(300, 3)
    before = render_rays(field, origins, directions)
    settled = render_rays(field.settled(), origins, directions)
    topology, occupied, (raw, features) = split(field.topology, field.occupied, [field.density_rows, field.feature_rows])
    finer = Field(field.space, 64, topology, occupied, raw, features, field.decoder, field.background, field.near, field.fine // 2)
    after = render_rays(finer, origins, directions)
    return [
        Measure("colour after dropping empty blocks", absolute(settled.colour, before.colour), 1e-6),
        Measure("colour after a split, mean", float((after.colour - before.colour).abs().mean()), 1e-3),
        Measure("opacity after a split, mean", float((after.opacity - before.opacity).abs().mean()), 1e-3),
        Measure("values that are not finite", not_finite(after.colour, after.distance, after.opacity), 0.0),
    ]


@case(GROUP, "nothing left: pruned to the last voxel, split, saved, read, rendered")
def nothing_left(folder: Path) -> list[Measure]:
    field = small_field(1)
    none = torch.zeros_like(field.occupied)
    topology, occupied, rows = erase_empty_blocks(field.topology, none, [field.density_rows, field.feature_rows])
    finer, _, finer_rows = split(topology, occupied, rows)
    empty = Field(field.space, 32, topology, occupied, rows[0], rows[1], field.decoder, field.background)
    origins, directions = aimed_rays(10)
    seen = render_rays(empty, origins, directions)
    path = folder / "field.safetensors"
    empty.save(path)
    again = render_rays(Field.load(path), origins, directions)
    return [
        Measure("blocks left", float(topology.blocks + finer.blocks), 0.0),
        Measure("rows left besides the zero row", float(sum(len(values) - 1 for values in (*rows, *finer_rows))), 0.0),
        Measure("colour that is not the background", absolute(seen.colour, field.background.expand(10, 3)), 0.0),
        Measure("colour after saving and reading", absolute(again.colour, seen.colour), 1e-6),
        Measure("opacity", float(seen.opacity.abs().max() + again.opacity.abs().max()), 0.0),
        Measure("a damaged file is taken", refused(lambda: _damaged(path), InputError), 0.0),
    ]


def _damaged(path: Path) -> Field:
    path.write_bytes(path.read_bytes()[:-8])
    return Field.load(path)


@case(GROUP, "densities at the clamp through a file and back")
def extreme_file(folder: Path) -> list[Measure]:
    field = small_field(4)
    field.density_rows[:-1] = torch.where(torch.rand(len(field.density_rows) - 1) < 0.5, 80.0, -80.0)
    field.feature_rows[:-1] *= 1e5  # float16 ends at 65504
    field.save(folder / "field.safetensors")
    again = Field.load(folder / "field.safetensors")
    origins, directions = aimed_rays(200, 1)
    before, after = render_rays(field, origins, directions), render_rays(again, origins, directions)
    return [
        Measure("opacity", absolute(after.opacity, before.opacity), 1e-6),
        Measure("colour", absolute(after.colour, before.colour), 5e-3),
        Measure("values that are not finite", not_finite(before.colour, after.colour, density(again.density_rows)), 0.0),
    ]
