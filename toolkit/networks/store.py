"""The global volume while key frames stream in: like a `LatentVolume`, but changed in place, so that a step costs what it touches."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from toolkit import gpu
from toolkit.camera import Array
from toolkit.gpu import asks_freely, sent
from toolkit.networks.lattice import LatentVolume, Lattice
from toolkit.networks.refine import adopt, part
from toolkit.volume.topology import VOXELS, Topology

CODE = np.array([1, 2**21, 2**42], np.int64)  # keys of lattices are small
GROWTH = 1.5  # a buffer that must grow gets at least this much more room


class GlobalStore:
    """Latents and counts of a growing set of blocks. Rows beyond the last block are always zero."""

    def __init__(self, lattice: Lattice, channels: int, device: torch.device | str = "cpu") -> None:
        self.lattice = lattice
        self.topology = Topology(torch.zeros((0, 3), dtype=torch.int32, device=device), bounds=lattice.bounds(device))
        self._rows = torch.zeros((VOXELS + 1, channels), device=device)
        self._count = torch.zeros(VOXELS, device=device)
        self._known: dict[int, int] | None = None  # slots by code, on CUDA

    @property
    def bytes(self) -> int:
        """Memory held."""
        return self._rows.numel() * 4 + self._count.numel() * 4

    def volume(self) -> LatentVolume:
        """Everything, sharing memory with the store: valid until the next change."""
        return LatentVolume(self.lattice, self.topology, self._rows[: self.topology.zero_row + 1], self._count[: self.topology.zero_row])

    def part(self, topology: Topology, inherited: LatentVolume | None = None) -> LatentVolume:
        """A copy of some blocks; corners of which nothing is known here are as `inherited`, a volume that has at least these blocks."""
        if gpu.fits(self._rows):
            from toolkit.volume import blocks_gpu as blocks

            slots = sent(self._places(topology), self._rows.device)
            below = None if inherited is None else (inherited.rows, inherited.count, inherited.topology)
            return LatentVolume(self.lattice, topology, *blocks.take(self._rows, self._count, slots, topology, below))
        here = part(self.volume(), topology)
        return here if inherited is None else adopt(here, part(inherited, topology))

    def write(self, values: LatentVolume, changed: Tensor) -> None:
        """Take over the corners `changed` (M · 512,) of some blocks."""
        if gpu.fits(self._rows, values.rows):
            from toolkit.volume import blocks_gpu as blocks

            slots = sent(self._made(values.topology), self._rows.device)
            blocks.put(self._rows, self._count, slots, values.rows, values.count, changed)
            return
        slots = self._slots(values.topology)
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
        self._known = None

    def _codes(self, topology: Topology) -> list[int]:
        """One number for each block."""
        return (topology.host.astype(np.int64) @ CODE).tolist()

    def _places(self, topology: Topology) -> Array:
        """(M,) int32 slots of blocks, −1 where missing: found by the processor, which knows the keys, without asking the device."""
        if self._known is None:
            self._known = {code: slot for slot, code in enumerate(self._codes(self.topology))}
        find = self._known.get
        return np.array([find(code, -1) for code in self._codes(topology)], np.int32)

    def _made(self, topology: Topology) -> Array:
        """`_places`, made where missing."""
        slots = self._places(topology)
        missing = np.flatnonzero(slots < 0)
        if len(missing):
            assert self._known is not None
            before, fresh = self.topology.blocks, topology.host[missing]
            slots[missing] = before + np.arange(len(missing), dtype=np.int32)
            self._known.update(zip((fresh.astype(np.int64) @ CODE).tolist(), slots[missing].tolist(), strict=True))
            keys = np.concatenate([self.topology.host, fresh])
            self.topology = self.topology.alike(sent(keys, self._rows.device), keys)
            self._grow()
        return slots

    def _slots(self, topology: Topology) -> Tensor:
        """(M,) slots of blocks, made where missing."""
        slots = self.topology.slots_of(topology)
        missing = (slots < 0).nonzero().view(-1)
        if len(missing) == 0:
            return slots
        fresh, before = topology.keys[missing], self.topology.blocks
        self.topology = self.topology.alike(torch.cat([self.topology.keys, fresh.to(torch.int32)]))
        self._grow()
        return slots.index_copy(0, missing, before + torch.arange(len(missing), device=slots.device))

    def _grow(self) -> None:
        """Room for all blocks."""
        needed = self.topology.zero_row
        if needed > len(self._count):
            room = max(needed, int(GROWTH * len(self._count) / VOXELS) * VOXELS)
            rows, count = self._rows.new_zeros((room + 1, self._rows.shape[1])), self._count.new_zeros(room)
            rows[: len(self._rows)], count[: len(self._count)] = self._rows, self._count
            self._rows, self._count = rows, count
