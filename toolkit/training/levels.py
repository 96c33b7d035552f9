"""From coarse to fine: the first field, pruning by what training rays saw, and the step to a finer lattice."""

from __future__ import annotations

from dataclasses import replace

import torch

from fieldfuse.nerfusion.decoder import Deferred, PerSample
from fieldfuse.render.field import Field
from fieldfuse.volume.edit import dilate, erase_empty_blocks, resample, split, with_corner_blocks
from fieldfuse.volume.host import Host
from fieldfuse.volume.space import Space
from fieldfuse.volume.topology import BLOCK, VOXELS, Topology

Tensor = torch.Tensor
FEATURE_NOISE = 0.05
ENOUGH_VISITS = 4


def all_places(space: Space, resolution: int) -> Tensor:
    """(N, 3) lattice coordinates of every voxel that touches the space."""
    line = torch.arange(resolution)
    z, y, x = torch.meshgrid(line, line, line, indexing="ij")
    places = torch.stack([x.reshape(-1), y.reshape(-1), z.reshape(-1)], 1)
    if space.shell == 0:
        voxel = 2 * space.extent / resolution
        centre = (places + 0.5) * voxel - space.extent
        places = places[(centre.abs() <= torch.tensor(space.box) + 0.5 * voxel).all(1)]
    return places


def occupancy(places: Tensor) -> tuple[Topology, Tensor]:
    """(N, 3) lattice coordinates of voxels → blocks that hold them and their corners, and (M · 512,) bool."""
    block = places >> 3
    low = block.amin(0) if len(block) else torch.zeros(3, dtype=torch.int64)
    size = (block.amax(0) - low + 1) if len(block) else torch.ones(3, dtype=torch.int64)
    code = ((block[:, 2] - low[2]) * size[1] + (block[:, 1] - low[1])) * size[0] + (block[:, 0] - low[0])
    unique = torch.unique(code)
    keys = torch.stack([unique % size[0], (unique // size[0]) % size[1], unique // (size[0] * size[1])], 1) + low
    topology = Topology(keys.int())
    local = places & 7
    occupied = torch.zeros(topology.zero_row, dtype=torch.bool, device=places.device)
    occupied[topology.find(block) * VOXELS + (local[:, 2] * BLOCK + local[:, 1]) * BLOCK + local[:, 0]] = True
    return with_corner_blocks(topology, occupied)


def _housed(field: Field, topology: Topology, occupied: Tensor, density: Tensor, feature: Tensor, resolution: int, host: Host) -> Field:
    """The values in rows of the host, whose order of blocks may differ."""
    voxel_size = 2 * field.space.extent / resolution * field.space.half
    hosted = host.allocate(topology.keys, feature.shape[1], voxel_size)
    slot = topology.find(hosted.topology.keys)
    hosted.density[:-1].view(-1, VOXELS).copy_(density[:-1].view(-1, VOXELS)[slot])
    hosted.feature[:-1].view(len(slot), -1).copy_(feature[:-1].view(len(slot), -1)[slot])
    ordered = occupied.view(-1, VOXELS)[slot].reshape(-1)
    return replace(
        field, resolution=resolution, topology=hosted.topology, occupied=ordered, density_rows=hosted.density, feature_rows=hosted.feature
    )


def first_field(
    space: Space,
    resolution: int,
    places: Tensor,
    channels: int,
    raw_density: float,
    decoder: Deferred | PerSample,
    background: Tensor,
    near: float,
    fine: int,
    host: Host,
    generator: torch.Generator,
) -> Field:
    """A field with the voxels at `places` (N, 3): one density everywhere, grey but for a little noise that breaks the symmetry."""
    topology, occupied = occupancy(places.to(background.device))
    size = topology.zero_row + 1
    density = torch.full((size,), raw_density, device=background.device)
    feature = (torch.randn(size, channels, generator=generator) * FEATURE_NOISE).to(background.device)
    start = Field(space, resolution, topology, occupied, density, feature, decoder, background, near, fine)
    return _housed(start, topology, occupied, density, feature, resolution, host)


def visible(field: Field, seen: Tensor, visits: Tensor, threshold: float) -> Tensor:
    """(M · 512,) bool: the occupied voxels that stay.

    A voxel stays within one voxel of one that training rays saw with a weight T·α above `threshold`, and as long as too few samples fell
    into it to tell: in captures with many pixels a few hundred steps do not look everywhere. When nothing was seen that strongly (a very
    thin start), everything stays.

    Args:
        seen: (M · 512,) largest weight since the last pruning.
        visits: (M · 512,) samples since then.
    """
    strong = seen > threshold
    del seen  # at the finest level each of these is a number a corner
    if not bool(strong.any()):
        return field.occupied
    stays = visits < ENOUGH_VISITS
    del visits
    return stays.logical_or_(beside(field.topology, strong)).logical_and_(field.occupied)


def looked_at(field: Field, seen: Tensor, visits: Tensor, threshold: float) -> Tensor:
    """(M · 512,) bool: the voxels that rays came to, and those beside a surface, which would have holes where a lattice has more voxels
    than rays came. The others are the first to go when memory is short. Arguments as in `visible`."""
    return (visits > 0) | beside(field.topology, seen > threshold)


def beside(topology: Topology, strong: Tensor) -> Tensor:
    """(M · 512,) bool grown by one voxel."""
    if strong.device.type == "cpu":
        from fieldfuse.volume.compiled import dilated

        return dilated(topology, strong)
    return dilate(topology, strong, 1, grow=False)[1]


def pruned(field: Field, keep: Tensor) -> Field:
    """The field with only the voxels `keep` (M · 512,) occupied; rows stay where they are, so optimiser state stays good."""
    return replace(field, occupied=field.occupied & keep)


def let_go(field: Field) -> None:
    """On the CPU, give back the memory of rows that no voxel uses any more after pruning. They read as zero, so what the field was before
    is void; its rows must be in memory of this process alone."""
    if field.device.type == "cpu":
        from fieldfuse.volume import compiled

        compiled.let_go(compiled.corner_nodes(field.topology, field.occupied), field.density_rows, field.feature_rows)


def finer(field: Field, keep: Tensor, resolution: int, host: Host) -> Field:
    """The same function, where `keep` says, on a lattice of `resolution` voxels a side; rows are new."""
    values = [field.density_rows, field.feature_rows]
    if field.device.type == "cpu":
        from fieldfuse.volume.compiled import refined

        voxel_size = 2 * field.space.extent / resolution * field.space.half
        kept = field.occupied & keep
        ratio = resolution / field.resolution
        hosted, occupied = refined(field.topology, kept, field.density_rows, field.feature_rows, ratio, host, voxel_size)
        return replace(
            field,
            resolution=resolution,
            topology=hosted.topology,
            occupied=occupied,
            density_rows=hosted.density,
            feature_rows=hosted.feature,
        )
    topology, occupied, rows = erase_empty_blocks(field.topology, field.occupied & keep, values)
    if resolution == 2 * field.resolution:
        topology, occupied, rows = split(topology, occupied, rows)
    else:
        new_topology, new_occupied = occupancy(_finer_places(topology, occupied, resolution / field.resolution))
        rows = resample(topology, occupied, rows, new_topology.keys, field.resolution / resolution)
        topology, occupied = new_topology, new_occupied
    return _housed(field, topology, occupied, rows[0], rows[1], resolution, host)


def _finer_places(topology: Topology, occupied: Tensor, ratio: float) -> Tensor:
    """(N, 3) voxels of the finer lattice whose centres lie in occupied voxels: j with floor((j + ½) / ratio) = i."""
    row = occupied.nonzero().squeeze(1)
    slot, local = row.div(VOXELS, rounding_mode="floor"), row % VOXELS
    place = topology.keys[slot].long() * BLOCK + torch.stack([local & 7, (local >> 3) & 7, local >> 6], 1)
    low = torch.ceil(place.double() * ratio - 0.5).long()
    high = torch.ceil((place + 1).double() * ratio - 0.5).long()
    parts = []
    reach = range(int(ratio) + 1)
    for z in reach:
        for y in reach:
            for x in reach:
                moved = low + torch.tensor([x, y, z], device=low.device)
                parts.append(moved[(moved < high).all(1)])
    return torch.cat(parts)
