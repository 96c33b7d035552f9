"""Where the networks' voxels are: the lattice of the field that they will become, and volumes of latent features on it.

A network's voxel is a lattice corner of the field (its values are interpolated between corners when a ray passes), so what the networks
produce is a field at once and can be refined as one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from fieldfuse.backends import dispatch
from fieldfuse.backends.dispatch import is_cpu
from fieldfuse.volume.space import Space
from fieldfuse.volume.topology import BLOCK, VOXELS, Bounds, Topology

CHUNK = 1024  # blocks at a time


@dataclass(frozen=True)
class Lattice:
    """`resolution` voxels along the side of the cube of `space`; corner (0, 0, 0) is its lowest corner, block keys count from there."""

    space: Space
    resolution: int

    @property
    def voxel(self) -> float:
        """Side of a voxel in normalised (contracted) units."""
        return 2 * self.space.extent / self.resolution

    @property
    def voxel_size(self) -> float:
        """Side of a voxel inside the region of interest, working units."""
        return self.voxel * self.space.half

    def bounds(self, device: torch.device | str) -> Bounds | None:
        """Keys that blocks of the lattice can have, with one more on each side for corners of its outermost cells. On the CPU None: there
        it costs nothing to look at keys, and tables are as small as they can be."""
        if is_cpu(torch.device(device)):
            return None
        most = self.resolution // BLOCK + 1
        return (-1, -1, -1), (most, most, most)

    def finer(self) -> Lattice:
        """The lattice of half the voxel size."""
        return replace(self, resolution=2 * self.resolution)

    def contracted(self, keys: Tensor, rows: Tensor) -> Tensor:
        """(M, 3) block keys and (N,) int64 rows of these blocks → (N, 3) float32, the corners in the contracted space."""
        slot = rows.div(VOXELS, rounding_mode="floor")
        local = rows - slot * VOXELS
        inner = torch.stack([local & 7, (local >> 3) & 7, local >> 6], 1)
        return (keys[slot].long() * BLOCK + inner).float() * self.voxel - self.space.extent

    def inside(self, contracted: Tensor) -> Tensor:
        """(N, 3) contracted places → (N,) bool, in the box of the space or less than about a voxel beside it; with a shell all."""
        if self.space.shell > 0:
            return torch.ones_like(contracted[:, 0], dtype=torch.bool)
        x, y, z = contracted.abs().unbind(1)
        across, along, up = (side + 1.01 * self.voxel for side in self.space.box)
        return (x <= across) & (y <= along) & (z <= up)

    def working(self, contracted: Tensor) -> tuple[Tensor, Tensor]:
        """Contracted places (N, 3) → working frame (N, 3), and the length (N,) of a voxel there across the direction from the centre."""
        space = self.space
        size = torch.full_like(contracted[:, 0], self.voxel_size)
        if space.shell > 0:
            norm = contracted.abs().amax(1).clamp_min(1.0)
            outside = space.shell / (space.extent - norm).clamp_min(1e-4)  # |expanded|, as in `Space.expand`
            size = torch.where(norm > 1, size * outside / norm, size)
        return space.to_working(contracted), size


@dataclass(frozen=True)
class LatentVolume:
    """Latent features at lattice corners of M blocks."""

    lattice: Lattice
    topology: Topology
    rows: Tensor  # (M · 512 + 1, C) in (−1, 1), zero where `count` is zero and in the last row
    count: Tensor  # (M · 512,) weights of key frames (a global volume) or number of views (a local one) that saw the corner; 0: not known

    @property
    def known(self) -> Tensor:
        """(M · 512,) bool."""
        return self.count > 0

    def detached(self) -> LatentVolume:
        """The same volume, cut off from the graph that made it (truncated back-propagation)."""
        return replace(self, rows=self.rows.detach())


@dataclass(frozen=True)
class LocalVolume(LatentVolume):
    """The volume of a key frame and its neighbours: `rows` = tanh(`raw`), `count` = views that see the corner."""

    raw: Tensor  # (M · 512 + 1, C)
    weight: Tensor  # (M · 512,) in (0, 1] where the corner is known: how much the key frame counts there
    near_surface: Topology  # blocks about surfaces: the networks work on these alone, the others hold the known terms
    slots: Tensor  # (M',) int64 of these blocks

    @cached_property
    def place(self) -> Tensor:
        """(M' · 512 + 1,) rows of the blocks near surfaces, the zero row last (the same way back)."""
        return rows_of(self.slots, self.topology.zero_row)

    def detached(self) -> LocalVolume:
        return replace(self, rows=self.rows.detach(), raw=self.raw.detach())


def rows_of(blocks: Tensor, zero_row: int) -> Tensor:
    """(M,) slots → (M · 512 + 1,) int64 rows of these blocks, the zero row last."""
    rows = (blocks[:, None] * VOXELS + torch.arange(VOXELS, device=blocks.device)).view(-1)
    return torch.cat([rows, rows.new_full((1,), zero_row)])


def empty_volume(lattice: Lattice, channels: int, device: torch.device | str = "cpu") -> LatentVolume:
    """A volume of which nothing is known yet."""
    topology = Topology(torch.zeros((0, 3), dtype=torch.int32, device=device), bounds=lattice.bounds(device))
    return LatentVolume(lattice, topology, torch.zeros((1, channels), device=device), torch.zeros(0, device=device))


def cells(topology: Topology, corners: Tensor, every: bool) -> Tensor:
    """Voxels (cells) from a mask of lattice corners.

    Args:
        corners: (M · 512,) bool.
        every: all eight corners of a cell must be set, else one is enough.

    Returns:
        (M · 512,) bool: cells whose lowest corner is that row. Corners of absent blocks count as not set.
    """
    if dispatch.can_use_triton(corners, dtypes=None):
        from fieldfuse.backends.triton import blocks

        return blocks.pooled(topology, corners, 0, 2, every)
    padded = torch.cat([corners, corners.new_zeros(1)])
    out = torch.empty_like(corners)
    for start in range(0, topology.blocks, CHUNK):
        stop = min(start + CHUNK, topology.blocks)
        mask = padded[topology.lookup_chunk(start, stop).view(-1)].view(-1, BLOCK + 1, BLOCK + 1, BLOCK + 1)
        for axis in (1, 2, 3):
            low, high = mask.narrow(axis, 0, BLOCK), mask.narrow(axis, 1, BLOCK)
            mask = low & high if every else low | high
        out[start * VOXELS : stop * VOXELS] = mask.reshape(-1)
    return out


def part(volume: LatentVolume, topology: Topology) -> LatentVolume:
    """A copy of some blocks of a volume; where it has no such block, nothing is known."""
    slots = volume.topology.slots_of(topology)
    here = (slots >= 0).repeat_interleave(VOXELS)
    place = torch.where(here, rows_of(slots, 0)[:-1], volume.topology.zero_row)
    rows, count = volume.rows[place], torch.cat([volume.count, volume.count.new_zeros(1)])[place]
    return LatentVolume(volume.lattice, topology, torch.cat([rows, rows.new_zeros((1, rows.shape[1]))]), count)


def merged(before: LatentVolume, after: LatentVolume, changed: Tensor) -> LatentVolume:
    """`after` where `changed` (M · 512,), else `before`; both have the same blocks."""
    if dispatch.can_use_triton(before.rows, after.rows):
        from fieldfuse.backends.triton import volumes

        rows, count = volumes.merge(before.rows, before.count, after.rows, after.count, changed)
        return replace(before, rows=rows, count=count)
    rows = torch.where(corner_mask(changed), after.rows, before.rows)
    return replace(before, rows=rows, count=torch.where(changed, after.count, before.count))


def corner_mask(corners: Tensor) -> Tensor:
    """(M · 512,) bool → (M · 512 + 1, 1), false in the zero row."""
    return torch.cat([corners, corners.new_zeros(1)])[:, None]


def with_blocks(state: LatentVolume, keys: Tensor) -> tuple[LatentVolume, Tensor]:
    """The volume with at least these blocks — its own keep their slots, new ones follow, of which nothing is known — and their slots."""
    slots = state.topology.find(keys)
    fresh = (slots < 0).nonzero().view(-1)
    if len(fresh) == 0:
        return state, slots
    slots[fresh] = state.topology.blocks + torch.arange(len(fresh), device=keys.device)
    new = len(fresh) * VOXELS
    rows, count = state.rows, state.count
    return (
        replace(
            state,
            topology=state.topology.alike(torch.cat([state.topology.keys, keys[fresh].to(torch.int32)])),
            rows=torch.cat([rows[:-1], rows.new_zeros((new + 1, rows.shape[1]))]),
            count=torch.cat([count, count.new_zeros(new)]),
        ),
        slots,
    )


def some_blocks(topology: Topology, kept: Tensor) -> tuple[Topology, Tensor, Tensor]:
    """The blocks of the mask (M,) alone, their slots, and their rows, the zero row last (the same way back)."""
    blocks = kept.nonzero().view(-1)
    return topology.alike(topology.keys[blocks]), blocks, rows_of(blocks, topology.zero_row)


def without_empty_blocks(topology: Topology, rows: Tensor) -> tuple[Topology, Tensor]:
    """The blocks that own at least one of the rows, in their order, and the same rows in them."""
    slot = rows.div(VOXELS, rounding_mode="floor")
    filled = torch.zeros(topology.blocks, dtype=torch.bool, device=rows.device).index_fill(0, slot, True)
    kept = filled.nonzero().view(-1)
    if len(kept) == topology.blocks:
        return topology, rows
    return topology.alike(topology.keys[kept]), rows + ((torch.cumsum(filled, 0) - 1)[slot] - slot) * VOXELS
