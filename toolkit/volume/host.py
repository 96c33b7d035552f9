"""Where the rows of a field live while it is fitted: in Open3D's `VoxelBlockGrid` when it is there, else in plain torch tensors.

Fitting asks its host for rows and never knows which it got, so it also runs on machines that carry torch alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import torch

from toolkit.volume.topology import VOXELS, Topology

if TYPE_CHECKING:
    from toolkit.volume.grid import BlockGrid

Tensor = torch.Tensor


@dataclass(frozen=True)
class Hosted:
    """Blocks and their zeroed rows; the last row of each array is the zero row of absent blocks."""

    topology: Topology
    density: Tensor  # (M · 512 + 1,)
    feature: Tensor  # (M · 512 + 1, C)


class Host(Protocol):
    """Gives rows for blocks; what it gave before is void afterwards."""

    def allocate(self, keys: Tensor, channels: int, voxel_size: float) -> Hosted:
        """(M, 3) unique keys → rows. The topology may list the keys in another order."""
        ...

    def close(self) -> None:
        """Let go of the memory; rows given before are void."""
        ...


class TorchHost:
    """Rows as ordinary tensors on a device."""

    def __init__(self, device: torch.device | str = "cpu") -> None:
        self.device = torch.device(device)

    def allocate(self, keys: Tensor, channels: int, voxel_size: float) -> Hosted:
        topology = Topology(keys.to(self.device))
        size = topology.zero_row + 1
        return Hosted(topology, torch.zeros(size, device=self.device), torch.zeros(size, channels, device=self.device))

    def close(self) -> None:
        """Nothing to do: torch frees what nobody holds."""


class GridHost:
    """Rows inside Open3D's hash map, shared without a copy. One grid at a time: a finer level replaces the coarser one."""

    def __init__(self, device: torch.device | str = "cpu") -> None:
        self.device = torch.device(device)
        self.grid: BlockGrid | None = None

    def allocate(self, keys: Tensor, channels: int, voxel_size: float) -> Hosted:
        from toolkit.volume.grid import BlockGrid

        previous, blocks = self.grid, len(keys)
        # One spare block holds the zero row, so the table never grows and the views stay good.
        self.grid = BlockGrid(voxel_size, {"feature": channels, "density": 1}, capacity=blocks + 1, device=self.device)
        slots = self.grid.activate(keys)
        if previous is not None:
            previous.close()
        if int(slots.max()) != blocks - 1:  # a fresh table hands out its first slots; otherwise its order is not ours to use
            topology = self.grid.topology()
            return Hosted(topology, torch.zeros(blocks * VOXELS + 1), torch.zeros(blocks * VOXELS + 1, channels))
        ordered = torch.empty_like(keys)
        ordered[slots] = keys
        feature, density = self.grid.rows("feature"), self.grid.rows("density")
        rows = blocks * VOXELS + 1
        feature[rows - 1], density[rows - 1] = 0, 0
        return Hosted(Topology(ordered), density[:rows, 0], feature[:rows])

    def close(self) -> None:
        if self.grid is not None:
            self.grid.close()
            self.grid = None
