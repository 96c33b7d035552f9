"""From coarse to fine: the first field, pruning by what training rays saw, and the step to a finer lattice."""

from __future__ import annotations

import torch

from toolkit.networks.decoder import Deferred, PerSample
from toolkit.render.field import Field
from toolkit.volume.lookup import corners
from toolkit.volume.space import Space
from toolkit.volume.topology import BLOCK, VOXELS, Topology

Tensor = torch.Tensor


def cell_places(topology: Topology, rows: Tensor) -> Tensor:
    """(N,) voxel rows → (N, 3) int64 lattice coordinates (x, y, z)."""
    slot, local = rows.div(VOXELS, rounding_mode="floor"), rows % VOXELS
    inner = torch.stack([local & 7, (local >> 3) & 7, local >> 6], 1)
    return topology.keys[slot].long() * BLOCK + inner


def rows_of(topology: Topology, places: Tensor) -> Tensor:
    """(N, 3) lattice coordinates → (N,) rows, -1 where there is no block."""
    slot = topology.find(places >> 3)
    local = places & 7
    return torch.where(slot >= 0, slot * VOXELS + (local[:, 2] * BLOCK + local[:, 1]) * BLOCK + local[:, 0], -1)


def blocks_for(places: Tensor) -> Tensor:
    """Sorted block keys that hold the corners of voxels at (N, 3) lattice coordinates."""
    corner = torch.tensor([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], device=places.device)
    shift = 2**20
    keys = torch.cat([torch.unique(_pack((places + offset) >> 3, shift)) for offset in corner])
    packed = torch.unique(keys)
    return torch.stack([(packed % (2 * shift)) - shift, (packed // (2 * shift)) % (2 * shift) - shift, packed // (4 * shift * shift) - shift], 1)


def _pack(keys: Tensor, shift: int) -> Tensor:
    return ((keys[:, 2] + shift) * 2 * shift + keys[:, 1] + shift) * 2 * shift + keys[:, 0] + shift


def dense_cells(space: Space, resolution: int) -> Tensor:
    """(N, 3) every voxel of the lattice that touches the space's box."""
    line = torch.arange(resolution)
    z, y, x = torch.meshgrid(line, line, line, indexing="ij")
    places = torch.stack([x.reshape(-1), y.reshape(-1), z.reshape(-1)], 1)
    if space.shell == 0:
        voxel = 2 * space.extent / resolution
        centre = (places + 0.5) * voxel - space.extent
        places = places[(centre.abs() <= torch.tensor(space.box) + voxel).all(1)]
    return places


def new_field(
    space: Space,
    resolution: int,
    places: Tensor,
    channels: int,
    raw_density: float,
    decoder: Deferred | PerSample,
    background: Tensor,
    near: float,
    fine: int,
    generator: torch.Generator,
) -> Field:
    """A field with the voxels at `places` (N, 3), all of one density and grey but for a little noise that breaks the symmetry."""
    topology = Topology(blocks_for(places))
    size = topology.zero_row + 1
    occupied = torch.zeros(size - 1, dtype=torch.bool)
    occupied[rows_of(topology, places)] = True
    rows = torch.full((size,), raw_density)
    features = torch.randn(size, channels, generator=generator) * 0.05
    rows[-1] = 0
    features[-1] = 0
    return Field(space, resolution, topology, occupied, rows, features, decoder, background, near, fine)


def regrid(field: Field, places: Tensor, resolution: int) -> Field:
    """The same function on the voxels at `places` (N, 3) of a lattice with `resolution` voxels a side.

    Trilinear, normalised by the weight of the corners that belong to occupied voxels, so that borders do not fade into what was never fitted.
    """
    ratio = field.resolution / resolution
    topology = Topology(blocks_for(places))
    size = topology.zero_row + 1
    occupied = torch.zeros(size - 1, dtype=torch.bool, device=places.device)
    occupied[rows_of(topology, places)] = True
    old_rows, _ = corners(field.topology, field.occupied.nonzero().squeeze(1), torch.zeros(int(field.occupied.sum()), 3))
    trained = torch.zeros(len(field.density_rows))
    trained[old_rows.reshape(-1)] = 1
    trained[-1] = 0
    values = torch.cat([field.density_rows[:, None], field.feature_rows, torch.ones(len(trained), 1)], 1) * trained[:, None]
    out = torch.zeros(size, values.shape[1])
    step = 512
    for start in range(0, topology.blocks, step):  # in pieces, so that memory stays bounded
        rows = torch.arange(start * VOXELS, min(start + step, topology.blocks) * VOXELS)
        place = cell_places(topology, rows).float() * ratio
        whole = place.floor().clamp(0, field.resolution - 1)
        base = rows_of(field.topology, whole.long())
        known = (base >= 0).nonzero().squeeze(1)
        corner_rows, corner_weights = corners(field.topology, base[known], (place - whole)[known])
        out[rows[known]] = torch.nn.functional.embedding_bag(corner_rows, values, mode="sum", per_sample_weights=corner_weights)
    weight = out[:, -1:]
    out = torch.where(weight > 1e-6, out / weight.clamp_min(1e-6), out)
    return Field(field.space, resolution, topology, occupied, out[:, 0].contiguous(), out[:, 1:-1].contiguous(), field.decoder, field.background, field.near, field.fine)


def dilate(topology: Topology, mask: Tensor) -> Tensor:
    """(M · 512,) voxels grown by one in the 26-neighbourhood, within the blocks that there are."""
    padded = torch.cat([mask, mask.new_zeros(1)])
    out = torch.empty_like(mask)
    step = 2048
    for start in range(0, topology.blocks, step):
        halo = padded[topology.halo_chunk(start, start + step).long()].view(-1, 1, 10, 10, 10).to(torch.uint8).float()
        grown = torch.nn.functional.max_pool3d(halo, 3, 1) > 0
        out[start * VOXELS : start * VOXELS + grown.numel()] = grown.view(-1)
    return out


def visible(field: Field, seen: Tensor, threshold: float) -> Tensor:
    """(M · 512,) bool: occupied voxels within one voxel of one that a training ray saw with weight T·α above `threshold`."""
    return dilate(field.topology, seen > threshold) & field.occupied


def finer_places(field: Field, keep: Tensor, resolution: int) -> Tensor:
    """(N, 3) voxels of the finer lattice whose centres lie in the voxels `keep` (M · 512,) of the field's lattice."""
    ratio = resolution / field.resolution
    places = cell_places(field.topology, keep.nonzero().squeeze(1))
    if ratio == 2:
        child = torch.tensor([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)])
        return (places[:, None] * 2 + child).view(-1, 3)
    # centre of new voxel j lies in old voxel floor((j + ½) / ratio)
    low = torch.ceil(places * ratio - 0.5).long()
    high = torch.ceil((places + 1) * ratio - 0.5).long()
    parts = []
    for z in range(int(ratio) + 1):
        for y in range(int(ratio) + 1):
            for x in range(int(ratio) + 1):
                place = low + torch.tensor([x, y, z])
                parts.append(place[(place < high).all(1)])
    return torch.cat(parts)
