"""Where the rows of a field live while it is fitted: in Open3D's `VoxelBlockGrid` (`grid.GridHost`) or in plain torch tensors.

Fitting works on rows of either, so it also runs on machines that carry torch alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import torch

from fieldfuse import memory
from fieldfuse.volume.topology import Topology

Tensor = torch.Tensor


def zero_rows(
    shape: tuple[int, ...], device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32, spill: bool = True
) -> Tensor:
    """Zeros; on the CPU those that are never written take no memory, and more than there is memory for are a file (`memory.pages`)."""
    device, count = torch.device(device), math.prod(shape)
    if device.type != "cpu" or count == 0:
        return torch.zeros(shape, dtype=dtype, device=device)
    return torch.frombuffer(memory.pages(count * dtype.itemsize, spill), dtype=dtype).view(shape)


@dataclass(frozen=True)
class Hosted:
    """Blocks and their zeroed rows; the last row of each array is the zero row of absent blocks."""

    topology: Topology
    density: Tensor  # (M · 512 + 1,)
    feature: Tensor  # (M · 512 + 1, C)


def plain_rows(topology: Topology, channels: int, spill: bool = False) -> Hosted:
    """Zeroed rows for blocks, as ordinary tensors on their device; while they are fitted they belong into memory (`memory.keep_only`)."""
    size, device = topology.zero_row + 1, topology.device
    return Hosted(topology, zero_rows((size,), device, spill=spill), zero_rows((size, channels), device, spill=spill))


class Host(Protocol):
    """Gives rows for blocks; what it gave before is void afterwards."""

    def allocate(self, keys: Tensor, channels: int, voxel_size: float) -> Hosted:
        """(M, 3) unique keys → rows. The topology may list the keys in another order."""
        ...

    def close(self) -> None:
        """Free the memory; rows given before are void."""
        ...


class TorchHost:
    """Rows as ordinary tensors on a device."""

    def __init__(self, device: torch.device | str = "cpu") -> None:
        self.device = torch.device(device)

    def allocate(self, keys: Tensor, channels: int, voxel_size: float) -> Hosted:
        return plain_rows(Topology(keys.to(self.device)), channels)

    def close(self) -> None:
        """Nothing to do: torch frees what is not referenced."""
