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
        """Places of lattice corners.

        Args:
            keys: (M, 3) block keys.
            rows: (N,) int64 rows of those blocks.

        Returns:
            (N, 3) float32 in the contracted space.
        """
        slot = rows.div(VOXELS, rounding_mode="floor")
        local = rows - slot * VOXELS
        inner = torch.stack([local & 7, (local >> 3) & 7, local >> 6], 1)
        return (keys[slot].long() * BLOCK + inner).float() * self.voxel - self.space.extent

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
    """Latent features at lattice corners.

    Attributes:
        lattice: where the corners are.
        topology: blocks.
        rows: (M · 512 + 1, C) features in (−1, 1), zero where `count` is zero and in the last row.
        count: (M · 512,) float32: weights of the key frames (a global volume) or number of views (a local one) that told of the corner;
            0: nothing is known.
    """

    lattice: Lattice
    topology: Topology
    rows: Tensor
    count: Tensor

    @property
    def known(self) -> Tensor:
        """(M · 512,) bool."""
        return self.count > 0

    def detached(self) -> LatentVolume:
        """The same volume, cut off from the graph that made it (truncated back-propagation)."""
        return replace(self, rows=self.rows.detach())


@dataclass(frozen=True)
class LocalVolume(LatentVolume):
    """What a few neighbouring views tell: `rows` = tanh(`raw`), `count` = views that see the corner.

    Attributes:
        weight: (M · 512,) in (0, 1] where the corner is known: how much the key frame can say of it.
        busy: blocks about surfaces. The networks work on these alone; the others hold what the known terms say.
        among: (M',) int64 slots of the busy blocks.
    """

    raw: Tensor  # (M · 512 + 1, C)
    weight: Tensor
    busy: Topology
    among: Tensor

    @cached_property
    def place(self) -> Tensor:
        """(M' · 512 + 1,) rows of the busy blocks, the zero row last (the same way back)."""
        return rows_of(self.among, self.topology.zero_row)

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
        from fieldfuse.volume import blocks_gpu as blocks

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
