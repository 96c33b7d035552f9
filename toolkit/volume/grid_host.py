"""Rows of a field inside Open3D's hash map, for fitting."""

from __future__ import annotations

import numpy as np
import open3d as o3d
import torch

from fieldfuse.memory import keep_only
from fieldfuse.volume.grid import BlockGrid
from fieldfuse.volume.host import Host, Hosted, TorchHost
from fieldfuse.volume.rows import zero_rows
from fieldfuse.volume.topology import VOXELS, Topology

Tensor = torch.Tensor
LINE = 64  # bytes of a cache line


def host_for(device: torch.device | str) -> Host:
    """Open3D's hash map where this Open3D can use the device. The packages for the CPU cannot use CUDA: there rows are plain tensors."""
    device = torch.device(device)
    return GridHost(device) if device.type == "cpu" or o3d.core.cuda.is_available() else TorchHost(device)


class GridHost:
    """Rows inside Open3D's hash map, shared without a copy. One grid at a time: a finer level replaces the coarser one."""

    def __init__(self, device: torch.device | str = "cpu") -> None:
        self.device = torch.device(device)
        self.grid: BlockGrid | None = None

    def allocate(self, keys: Tensor, channels: int, voxel_size: float) -> Hosted:
        blocks = len(keys)
        self.close()
        # One spare block holds the zero row, so the table never grows and the views stay good. It gives `_aligned` room, too.
        self.grid = BlockGrid(voxel_size, {"feature": channels, "density": 1}, capacity=blocks + 1, device=self.device)
        slots = self.grid.activate(keys)
        if blocks and int(slots.max()) != blocks - 1:  # a fresh table hands out its first slots; otherwise its order is not ours to use
            topology = self.grid.topology()
            size = topology.zero_row + 1
            return Hosted(topology, zero_rows((size,), self.device), zero_rows((size, channels), self.device))
        ordered = torch.empty_like(keys)
        ordered[slots] = keys
        feature, density = (_aligned(self.grid.rows(name), blocks * VOXELS) for name in ("feature", "density"))
        return Hosted(Topology(ordered), density[:, 0], feature)

    def close(self) -> None:
        if self.grid is None:
            return
        for name in self.grid.attributes if self.device.type == "cpu" else ():
            rows = self.grid.rows(name).numpy()
            keep_only(rows, np.zeros(len(rows), np.bool_))  # at once, though somebody may still hold the void rows: they read as zero
        self.grid.close()
        self.grid = None


def _aligned(buffer: Tensor, rows: int) -> Tensor:
    """(R, C) rows of Open3D's → (rows + 1, C) of the same memory from its first cache line on, and the zero row.

    Open3D's memory begins 16 bytes after such a line, so each row of 16 features would lie in two of them, which costs a step of a fit 6 to
    10%. Open3D is asked for blocks here and looks at no values, so it does not matter that its own rows begin elsewhere.
    """
    buffer[rows : rows + LINE] = 0  # what rows reach of the spare block
    skip = -buffer.data_ptr() % LINE // buffer.element_size()
    channels = buffer.shape[1]
    return buffer.view(-1)[skip : skip + (rows + 1) * channels].view(rows + 1, channels)
