"""The global volume while key frames stream in: like a `LatentVolume`, but changed in place, so that a step costs what it touches."""

from __future__ import annotations

import torch
from torch import Tensor

from toolkit import gpu
from toolkit.gpu import asks_freely
from toolkit.networks.lattice import LatentVolume, Lattice
from toolkit.networks.refine import part
from toolkit.volume.topology import VOXELS, Topology

GROWTH = 1.5  # a buffer that must grow gets at least this much more room


class GlobalStore:
    """Latents and counts of a growing set of blocks. Rows beyond the last block are always zero."""

    def __init__(self, lattice: Lattice, channels: int, device: torch.device | str = "cpu") -> None:
        self.lattice = lattice
        self.topology = Topology(torch.zeros((0, 3), dtype=torch.int32, device=device), bounds=lattice.bounds(device))
        self._rows = torch.zeros((VOXELS + 1, channels), device=device)
        self._count = torch.zeros(VOXELS, device=device)

    @property
    def bytes(self) -> int:
        """Memory held."""
        return self._rows.numel() * 4 + self._count.numel() * 4

    def volume(self) -> LatentVolume:
        """Everything, sharing memory with the store: valid until the next change."""
        return LatentVolume(self.lattice, self.topology, self._rows[: self.topology.zero_row + 1], self._count[: self.topology.zero_row])

    def part(self, topology: Topology) -> LatentVolume:
        """A copy of some blocks; where a block is not here, nothing is known."""
        return part(self.volume(), topology)

    def write(self, values: LatentVolume, changed: Tensor) -> None:
        """Take over the corners `changed` (M · 512,) of some blocks."""
        slots = self._slots(values.topology)
        if gpu.fits(self._rows, values.rows):
            from toolkit.volume import blocks_gpu as blocks

            blocks.put(self._rows, self._count, slots, values.rows, values.count, changed)
            return
        place = (slots[:, None] * VOXELS + torch.arange(VOXELS, device=slots.device)).view(-1)
        if asks_freely(place.device):
            which = changed.nonzero().view(-1)
            place = place[which]
            self._rows[place] = values.rows[which]
            self._count[place] = values.count[which]
        else:  # what has not changed is written as it is: to choose the others would be to wait for the device
            self._rows[place] = torch.where(changed[:, None], values.rows[:-1], self._rows[place])
            self._count[place] = torch.where(changed, values.count, self._count[place])

    def keep(self, blocks: Tensor) -> None:
        """Forget all blocks but those of the mask (M,)."""
        kept = blocks.nonzero().view(-1)
        place = (kept[:, None] * VOXELS + torch.arange(VOXELS, device=kept.device)).view(-1)
        rows, count = self._rows[place], self._count[place]
        self._rows[: self.topology.zero_row] = 0
        self._count[: self.topology.zero_row] = 0
        self._rows[: len(rows)], self._count[: len(count)] = rows, count
        self.topology = self.topology.alike(self.topology.keys[kept])

    def _slots(self, topology: Topology) -> Tensor:
        """(M,) slots of blocks, made where missing."""
        slots = self.topology.slots_of(topology)
        missing = (slots < 0).nonzero().view(-1)
        if len(missing) == 0:
            return slots
        fresh, before = topology.keys[missing], self.topology.blocks
        self.topology = self.topology.alike(torch.cat([self.topology.keys, fresh.to(torch.int32)]))
        needed = self.topology.zero_row
        if needed > len(self._count):
            room = max(needed, int(GROWTH * len(self._count) / VOXELS) * VOXELS)
            rows, count = self._rows.new_zeros((room + 1, self._rows.shape[1])), self._count.new_zeros(room)
            rows[: len(self._rows)], count[: len(self._count)] = self._rows, self._count
            self._rows, self._count = rows, count
        return slots.index_copy(0, missing, before + torch.arange(len(missing), device=slots.device))
