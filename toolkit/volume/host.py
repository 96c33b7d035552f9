"""Where the rows of a field live while it is fitted: in Open3D's `VoxelBlockGrid` (`grid_host.GridHost`) or in plain torch tensors.

Fitting asks its host for rows and never knows which it got, so it also runs on machines that carry torch alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch

from toolkit.volume.topology import Topology

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


def _zeros(shape: tuple[int, ...], device: torch.device) -> Tensor:
    """float32. NumPy's zeros take no memory before they are written, torch's do."""
    return torch.from_numpy(np.zeros(shape, np.float32)) if device.type == "cpu" else torch.zeros(shape, device=device)


class TorchHost:
    """Rows as ordinary tensors on a device."""

    def __init__(self, device: torch.device | str = "cpu") -> None:
        self.device = torch.device(device)

    def allocate(self, keys: Tensor, channels: int, voxel_size: float) -> Hosted:
        topology = Topology(keys.to(self.device))
        size = topology.zero_row + 1
        return Hosted(topology, _zeros((size,), self.device), _zeros((size, channels), self.device))

    def close(self) -> None:
        """Nothing to do: torch frees what nobody holds."""
