"""The global volume while key frames stream in: like a `LatentVolume`, but changed in place, so that a step costs what it touches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from fieldfuse.backends import dispatch
from fieldfuse.backends.dispatch import is_cpu, to_device_async
from fieldfuse.camera import Array
from fieldfuse.nerfusion.extras.two_lattices import adopt
from fieldfuse.nerfusion.lattice import LatentVolume, Lattice, part, rows_of, with_blocks
from fieldfuse.volume.topology import VOXELS, Topology

CODE = np.array([1, 2**21, 2**42], np.int64)  # keys of lattices are small
NONE = np.iinfo(np.int64).min  # no block's code
GROWTH = 1.5  # a buffer that must grow gets at least this much more room


class _Slots:
    """Slots by the code of a block's key, in the processor's memory."""

    def __init__(self) -> None:
        self._codes, self._slots = np.zeros(0, np.int64), np.zeros(0, np.int32)  # by code

    def find(self, codes: Array) -> tuple[Array, Array]:
        """(M,) int64 → (M,) int32 slots, −1 where missing, and the places of those that are."""
        place = np.searchsorted(self._codes, codes)
        here = np.append(self._codes, NONE)[place] == codes
        return np.where(here, np.append(self._slots, -1)[place], np.int32(-1)), np.flatnonzero(~here)

    def add(self, codes: Array, slots: Array) -> None:
        """Some that are missing."""
        order = np.argsort(codes)
        place = np.searchsorted(self._codes, codes[order])
        self._codes, self._slots = np.insert(self._codes, place, codes[order]), np.insert(self._slots, place, slots[order])


class GlobalStore:
    """Latents and counts of a growing set of blocks. Rows beyond the last block are always zero."""

    def __init__(self, lattice: Lattice, channels: int, device: torch.device | str = "cpu") -> None:
        self.lattice = lattice
        self._topology: Topology | None = Topology(torch.zeros((0, 3), dtype=torch.int32, device=device), bounds=lattice.bounds(device))
        self._keys = np.zeros((0, 3), np.int32)  # of the next topology, where there is none
        self._rows = torch.zeros((VOXELS + 1, channels), device=device)
        self._count = torch.zeros(VOXELS, device=device)
        self._known = _Slots()  # on CUDA …
        self._asked: tuple[Topology, Tensor] | None = None  # … where these are those of the blocks that were last asked for

    @property
    def topology(self) -> Topology:
        """The blocks; on CUDA brought there when they are asked for."""
        if self._topology is None:
            bounds, device = self.lattice.bounds(self._rows.device), self._rows.device
            self._topology = Topology(to_device_async(self._keys, device), bounds=bounds, host=self._keys)
        return self._topology

    @property
    def blocks(self) -> int:
        """How many there are."""
        return len(self._keys) if self._topology is None else self._topology.blocks

    @property
    def bytes(self) -> int:
        """Memory held."""
        return self._rows.numel() * 4 + self._count.numel() * 4

    def volume(self) -> LatentVolume:
        """Everything, sharing memory with the store: valid until the next change."""
        return LatentVolume(self.lattice, self.topology, self._rows[: self.topology.zero_row + 1], self._count[: self.topology.zero_row])

    def part(self, topology: Topology, inherited: LatentVolume | None = None) -> LatentVolume:
        """A copy of some blocks, to be written next; corners of which nothing is known here are as `inherited`, a volume that has at least
        these blocks."""
        if dispatch.can_use_triton(self._rows):
            from fieldfuse.backends.triton import blocks as blocks

            slots = self._places(topology)  # may grow
            below = None if inherited is None else (inherited.rows, inherited.count, inherited.topology)
            return LatentVolume(self.lattice, topology, *blocks.take(self._rows, self._count, slots, topology, below))
        here = part(self.volume(), topology)
        return here if inherited is None else adopt(here, part(inherited, topology))

    def write(self, values: LatentVolume, changed: Tensor) -> None:
        """Take over the corners `changed` (M · 512,) of some blocks."""
        if dispatch.can_use_triton(self._rows, values.rows):
            from fieldfuse.backends.triton import blocks as blocks

            slots = self._places(values.topology)
            blocks.put(self._rows, self._count, slots, values.rows, values.count, changed)
            return
        slots = self._slots(values.topology)
        place = (slots[:, None] * VOXELS + torch.arange(VOXELS, device=slots.device)).view(-1)
        if is_cpu(place.device):
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
        self._topology = self.topology.alike(self.topology.keys[kept])
        self._asked = None
        if dispatch.can_use_triton(self._rows):
            self._keys, self._known = self._topology.host, _Slots()
            self._known.add(self._keys.astype(np.int64) @ CODE, np.arange(len(self._keys), dtype=np.int32))

    def _places(self, topology: Topology) -> Tensor:
        """(M,) int32 slots of blocks on CUDA, made where missing: the processor knows the keys, and does not ask the device."""
        if self._asked is None or self._asked[0] is not topology:
            codes = topology.host.astype(np.int64) @ CODE
            slots, missing = self._known.find(codes)
            if len(missing):
                slots[missing] = self.blocks + np.arange(len(missing), dtype=np.int32)
                self._known.add(codes[missing], slots[missing])
                self._keys, self._topology = np.concatenate([self._keys, topology.host[missing]]), None
                self._grow()
            self._asked = topology, to_device_async(slots, self._rows.device)
        return self._asked[1]

    def _slots(self, topology: Topology) -> Tensor:
        """(M,) slots of blocks, made where missing."""
        slots = self.topology.slots_of(topology)
        missing = (slots < 0).nonzero().view(-1)
        if len(missing) == 0:
            return slots
        fresh, before = topology.keys[missing], self.topology.blocks
        self._topology = self.topology.alike(torch.cat([self.topology.keys, fresh.to(torch.int32)]))
        self._grow()
        return slots.index_copy(0, missing, before + torch.arange(len(missing), device=slots.device))

    def _grow(self) -> None:
        """Room for all blocks."""
        needed = self.blocks * VOXELS
        if needed > len(self._count):
            room = max(needed, int(GROWTH * len(self._count) / VOXELS) * VOXELS)
            rows, count = self._rows.new_zeros((room + 1, self._rows.shape[1])), self._count.new_zeros(room)
            rows[: len(self._rows)], count[: len(self._count)] = self._rows, self._count
            self._rows, self._count = rows, count


class ValueStore:
    """A `GlobalStore` of ordinary values, for training: gradients flow through it, and volumes given out never change."""

    def __init__(self, volume: LatentVolume) -> None:
        self._volume = volume
        self._rows = torch.zeros(0, dtype=torch.int64)  # of the part that was last given out

    @property
    def lattice(self) -> Lattice:
        return self._volume.lattice

    def volume(self) -> LatentVolume:
        """Everything."""
        return self._volume

    def part(self, topology: Topology, inherited: LatentVolume | None = None) -> LatentVolume:
        """See `GlobalStore.part`; all of `inherited` is taken over where nothing is known. Blocks keep their slots, new ones follow."""
        state = self._volume if inherited is None else adopt(self._volume, inherited)
        state, slots = with_blocks(state, topology.keys)
        self._volume = state
        self._rows = rows_of(slots, 0)[:-1]
        zero = state.rows.new_zeros((1, state.rows.shape[1]))
        return replace(state, topology=topology, rows=torch.cat([state.rows[self._rows], zero]), count=state.count[self._rows])

    def write(self, values: LatentVolume, changed: Tensor) -> None:
        """Take over the corners `changed` (M · 512,) of the part that was last given out; all others keep every bit."""
        state, chosen = self._volume, changed.nonzero().view(-1)
        place = self._rows[chosen]
        rows = state.rows.index_copy(0, place, values.rows[chosen].to(state.rows.dtype))
        self._volume = replace(state, rows=rows, count=state.count.index_copy(0, place, values.count[chosen]))

