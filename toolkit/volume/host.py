"""Where the rows of a field live while it is fitted: in Open3D's `VoxelBlockGrid` (`grid_host.GridHost`) or in plain torch tensors.

Fitting asks its host for rows and never knows which it got, so it also runs on machines that carry torch alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch

from fieldfuse.volume.rows import zero_rows
from fieldfuse.volume.topology import Topology

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
        return Hosted(topology, zero_rows((size,), self.device), zero_rows((size, channels), self.device))

    def close(self) -> None:
        """Nothing to do: torch frees what nobody holds."""
