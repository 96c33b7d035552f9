"""Rows of a field inside Open3D's hash map, for fitting."""

from __future__ import annotations

import torch

from toolkit.volume.grid import BlockGrid
from toolkit.volume.host import Hosted
from toolkit.volume.topology import VOXELS, Topology

Tensor = torch.Tensor


class GridHost:
    """Rows inside Open3D's hash map, shared without a copy. One grid at a time: a finer level replaces the coarser one."""

    def __init__(self, device: torch.device | str = "cpu") -> None:
        self.device = torch.device(device)
        self.grid: BlockGrid | None = None

    def allocate(self, keys: Tensor, channels: int, voxel_size: float) -> Hosted:
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
