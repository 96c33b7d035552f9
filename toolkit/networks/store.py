"""The global volume while key frames stream in: like a `LatentVolume`, but changed in place, so that a step costs what it touches."""

from __future__ import annotations

import torch
from torch import Tensor

from toolkit.networks.lattice import LatentVolume, Lattice
from toolkit.volume.topology import VOXELS, Topology

GROWTH = 1.5  # a buffer that must grow gets at least this much more room


class GlobalStore:
    """Latents and counts of a growing set of blocks. Rows beyond the last block are always zero."""

    def __init__(self, lattice: Lattice, channels: int, device: torch.device | str = "cpu") -> None:
        self.lattice = lattice
        self.topology = Topology(torch.zeros((0, 3), dtype=torch.int32, device=device))
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
        place, here = self._place(self.topology.find(topology.keys))
        rows = self._rows[place] * here[:, None]
        return LatentVolume(self.lattice, topology, torch.cat([rows, rows.new_zeros((1, rows.shape[1]))]), self._count[place] * here)

    def write(self, part: LatentVolume, changed: Tensor) -> None:
        """Take over the corners `changed` (M · 512,) of a part."""
        slots = self._slots(part.topology.keys)
        which = changed.nonzero().view(-1)
        place = self._place(slots)[0][which]
        self._rows[place] = part.rows[which]
        self._count[place] = part.count[which]

    def keep(self, blocks: Tensor) -> None:
        """Forget all blocks but those of the mask (M,)."""
        kept = blocks.nonzero().view(-1)
        place = (kept[:, None] * VOXELS + torch.arange(VOXELS, device=kept.device)).view(-1)
        rows, count = self._rows[place], self._count[place]
        self._rows[: self.topology.zero_row] = 0
        self._count[: self.topology.zero_row] = 0
        self._rows[: len(rows)], self._count[: len(count)] = rows, count
        self.topology = Topology(self.topology.keys[kept])

    def _place(self, slots: Tensor) -> tuple[Tensor, Tensor]:
        """(M,) slots → (M · 512,) rows, and which of them are here (others point at row 0)."""
        inner = torch.arange(VOXELS, device=slots.device)
        return (slots.clamp_min(0)[:, None] * VOXELS + inner).view(-1), (slots >= 0).repeat_interleave(VOXELS)

    def _slots(self, keys: Tensor) -> Tensor:
        """(M,) slots of blocks, made where missing."""
        slots = self.topology.find(keys)
        fresh = keys[slots < 0]
        if len(fresh) == 0:
            return slots
        self.topology = Topology(torch.cat([self.topology.keys, fresh.to(torch.int32)]))
        needed = self.topology.zero_row
        if needed > len(self._count):
            room = max(needed, int(GROWTH * len(self._count) / VOXELS) * VOXELS)
            rows, count = self._rows.new_zeros((room + 1, self._rows.shape[1])), self._count.new_zeros(room)
            rows[: len(self._rows)], count[: len(self._count)] = self._rows, self._count
            self._rows, self._count = rows, count
        return self.topology.find(keys)
