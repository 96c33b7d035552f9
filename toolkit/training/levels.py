"""From coarse to fine: the first field, pruning by what training rays saw, and the step to a finer lattice."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from fieldfuse.backends.dispatch import is_cpu
from fieldfuse.nerfusion.decoder import Deferred, PerSample
from fieldfuse.render.field import Field
from fieldfuse.volume import compiled
from fieldfuse.volume.edit import corner_nodes, dilate, erase_empty_blocks, resample, split, with_corner_blocks
from fieldfuse.volume.host import Host, Hosted
from fieldfuse.volume.space import Space
from fieldfuse.volume.topology import BLOCK, VOXELS, Topology

Tensor = torch.Tensor
FEATURE_NOISE = 0.05
ENOUGH_VISITS = 4


def all_places(space: Space, resolution: int) -> Tensor:
    """(N, 3) lattice coordinates of every voxel that touches the space."""
    places = torch.cartesian_prod(*[torch.arange(resolution)] * 3).flip(1)
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


def _housed(field: Field, occupied: Tensor, resolution: int, host: Host) -> Field:
    """The field on a lattice of `resolution`, in rows of the host, whose order of blocks may differ."""
    hosted = host.allocate(field.topology.keys, field.feature_rows.shape[1], 2 * field.space.extent / resolution * field.space.half)
    slot = field.topology.find(hosted.topology.keys)
    for new, old in ((hosted.density, field.density_rows), (hosted.feature, field.feature_rows)):
        new[:-1].view(len(slot), -1).copy_(old[:-1].view(len(slot), -1)[slot])
    occupied = occupied.view(-1, VOXELS)[slot].reshape(-1)
    return in_rows(field, hosted, occupied, resolution)


def in_rows(field: Field, hosted: Hosted, occupied: Tensor, resolution: int) -> Field:
    """The field with other rows."""
    density, feature = hosted.density, hosted.feature
    return replace(
        field, resolution=resolution, topology=hosted.topology, occupied=occupied, density_rows=density, feature_rows=feature
    )


@dataclass(frozen=True)
class NewField:
    """What a field has before it has voxels; see `Field`."""

    space: Space
    resolution: int
    decoder: Deferred | PerSample
    background: Tensor
    near: float = 0.0
    fine: int = 4

    def on(self, places: Tensor, host: Host, raw_density: float = 0.0, generator: torch.Generator | None = None) -> Field:
        """The field with the voxels at `places` (N, 3): one density everywhere, grey but for a little noise that breaks the symmetry."""
        device = self.background.device
        topology, occupied = occupancy(places.to(device))
        size = topology.zero_row + 1
        density = torch.full((size,), raw_density, device=device)
        feature = (torch.randn(size, self.decoder.channels, generator=generator) * FEATURE_NOISE).to(device)
        values = (topology, occupied, density, feature, self.decoder, self.background, self.near, self.fine)
        return _housed(Field(self.space, self.resolution, *values), occupied, self.resolution, host)


def visible(field: Field, seen: Tensor, visits: Tensor, threshold: float) -> Tensor:
    """(M · 512,) bool: the occupied voxels that stay.

    A voxel stays within one voxel of one that training rays saw with a weight T·α above `threshold`, and as long as too few samples fell
    into it to judge: in captures with many pixels a few hundred steps do not look everywhere. When nothing was seen that strongly (a very
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
    return stays.logical_or_(dilate(field.topology, strong, 1, grow=False)[1]).logical_and_(field.occupied)


def looked_at(field: Field, seen: Tensor, visits: Tensor, threshold: float) -> Tensor:
    """(M · 512,) bool: the voxels that rays came to, and those beside a surface, which would have holes where a lattice has more voxels
    than rays came. The others are the first to go when memory is short. Arguments as in `visible`."""
    return (visits > 0) | dilate(field.topology, seen > threshold, 1, grow=False)[1]


def pruned(field: Field, keep: Tensor) -> Field:
    """The field with only the voxels `keep` (M · 512,) occupied; rows stay where they are, so optimiser state stays good."""
    return replace(field, occupied=field.occupied & keep)


def release_unused(field: Field) -> None:
    """On the CPU, give back the memory of rows that no voxel uses any more after pruning. They read as zero, so what the field was before
    is void; its rows must be in memory of this process alone."""
    if is_cpu(field.device):
        compiled.release_unused(corner_nodes(field.topology, field.occupied), field.density_rows, field.feature_rows)


def finer(field: Field, keep: Tensor, resolution: int, host: Host) -> Field:
    """The same function, where `keep` is true, on a lattice of `resolution` voxels a side; rows are new."""
    kept, ratio = field.occupied & keep, resolution / field.resolution
    if is_cpu(field.device):
        rows, voxel_size = (field.density_rows, field.feature_rows), 2 * field.space.extent / resolution * field.space.half
        return in_rows(field, *compiled.refined(field.topology, kept, rows, ratio, host, voxel_size), resolution)
    topology, occupied, values = erase_empty_blocks(field.topology, kept, [field.density_rows, field.feature_rows])
    if ratio == 2:
        topology, occupied, values = split(topology, occupied, values)
    else:
        new_topology, new_occupied = occupancy(_finer_places(topology, occupied, ratio))
        values = resample(topology, occupied, values, new_topology.keys, 1 / ratio)
        topology, occupied = new_topology, new_occupied
    made = replace(field, topology=topology, occupied=occupied, density_rows=values[0], feature_rows=values[1])
    return _housed(made, occupied, resolution, host)


def _finer_places(topology: Topology, occupied: Tensor, ratio: float) -> Tensor:
    """(N, 3) voxels of the finer lattice whose centres lie in occupied voxels: j with floor((j + ½) / ratio) = i."""
    row = occupied.nonzero().squeeze(1)
    slot, local = row.div(VOXELS, rounding_mode="floor"), row % VOXELS
    place = topology.keys[slot].long() * BLOCK + torch.stack([local & 7, (local >> 3) & 7, local >> 6], 1)
    low = torch.ceil(place.double() * ratio - 0.5).long()
    high = torch.ceil((place + 1).double() * ratio - 0.5).long()
    steps = torch.cartesian_prod(*[torch.arange(int(ratio) + 1, device=low.device)] * 3).flip(1)
    moved = [low + step for step in steps]
    return torch.cat([places[(places < high).all(1)] for places in moved])
