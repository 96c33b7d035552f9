"""The global volume while key frames stream in: like a `LatentVolume`, but changed in place, so that a step costs what it touches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from fieldfuse.backends import dispatch
from fieldfuse.camera import Array
from fieldfuse.nerfusion.extras.two_lattices import adopt
from fieldfuse.nerfusion.lattice import LatentVolume, Lattice, part, rows_of, with_blocks
from fieldfuse.volume.topology import VOXELS, Topology

CODE = np.array([1, 2**21, 2**42], np.int64)  # keys of lattices are small
NONE = np.iinfo(np.int64).min  # no block's code
GROWTH = 1.5  # a buffer that must grow gets at least this much more room


class BlockSlots:
    """Slots by block key, in the processor's memory, so that the device is not waited for."""

    def __init__(self, keys: Array) -> None:
        self._codes, self._slots = np.zeros(0, np.int64), np.zeros(0, np.int32)  # by code
        self.keys = np.zeros((0, 3), np.int32)
        self.find(keys)

    def find(self, keys: Array) -> Array:
        """(M, 3) keys → (M,) int32 slots; those that are missing get the next ones."""
        codes = keys.astype(np.int64) @ CODE
        place = np.searchsorted(self._codes, codes)
        slots = np.append(self._slots, -1)[place]
        missing = np.flatnonzero(np.append(self._codes, NONE)[place] != codes)
        if len(missing):
            slots[missing] = len(self.keys) + np.arange(len(missing), dtype=np.int32)
            order = missing[np.argsort(codes[missing])]
            place = np.searchsorted(self._codes, codes[order])
            self._codes, self._slots = np.insert(self._codes, place, codes[order]), np.insert(self._slots, place, slots[order])
            self.keys = np.concatenate([self.keys, keys[missing].astype(np.int32)])
        return slots


class GlobalStore:
    """Latents and counts of a growing set of blocks. Rows beyond the last block are always zero."""

    def __init__(self, lattice: Lattice, channels: int, device: torch.device | str = "cpu") -> None:
        self.lattice = lattice
        self._slots = BlockSlots(np.zeros((0, 3), np.int32))
        self._topology: Topology | None = None
        self._rows = torch.zeros((VOXELS + 1, channels), device=device)
        self._count = torch.zeros(VOXELS, device=device)
        self._last: tuple[Topology, Tensor] | None = None  # the blocks of the part that was last given out, and their slots

    @property
    def topology(self) -> Topology:
        """The blocks, brought to the device on demand."""
        if self._topology is None:
            keys, device = self._slots.keys, self._rows.device
            self._topology = Topology(dispatch.to_device_async(keys, device), bounds=self.lattice.bounds(device), host=keys)
        return self._topology

    @property
    def blocks(self) -> int:
        """How many there are."""
        return len(self._slots.keys)

    def volume(self) -> LatentVolume:
        """Everything, sharing memory with the store: valid until the next change."""
        zero_row = self.blocks * VOXELS
        return LatentVolume(self.lattice, self.topology, self._rows[: zero_row + 1], self._count[:zero_row])

    def part(self, topology: Topology, inherited: LatentVolume | None = None) -> LatentVolume:
        """A copy of some blocks, to be written next; corners of which nothing is known here are as `inherited`, a volume that has at least
        these blocks."""
        slots = self._places(topology)
        if dispatch.can_use_triton(self._rows):
            from fieldfuse.backends.triton import blocks

            below = None if inherited is None else (inherited.rows, inherited.count, inherited.topology)
            return LatentVolume(self.lattice, topology, *blocks.take(self._rows, self._count, slots, topology, below))
        place = rows_of(slots, 0)[:-1]
        rows = torch.cat([self._rows[place], self._rows.new_zeros((1, self._rows.shape[1]))])
        here = LatentVolume(self.lattice, topology, rows, self._count[place])
        return here if inherited is None else adopt(here, part(inherited, topology))

    def write(self, values: LatentVolume, changed: Tensor) -> None:
        """Take over the corners `changed` (M · 512,) of some blocks."""
        slots = self._places(values.topology)
        if dispatch.can_use_triton(self._rows, values.rows):
            from fieldfuse.backends.triton import blocks

            blocks.put(self._rows, self._count, slots, values.rows, values.count, changed)
            return
        which = changed.nonzero().view(-1)
        place = rows_of(slots, 0)[which]
        self._rows[place] = values.rows[which]
        self._count[place] = values.count[which]

    def keep(self, blocks: Tensor) -> None:
        """Forget all blocks but those of the mask (M,)."""
        place = rows_of(blocks.nonzero().view(-1), 0)[:-1]
        rows, count = self._rows[place], self._count[place]
        self._rows[: self.blocks * VOXELS] = 0
        self._count[: self.blocks * VOXELS] = 0
        self._rows[: len(rows)], self._count[: len(count)] = rows, count
        self._slots = BlockSlots(self._slots.keys[blocks.cpu().numpy()])
        self._topology = self._last = None

    def _places(self, topology: Topology) -> Tensor:
        """(M,) int32 slots of blocks, made where missing."""
        if self._last is None or self._last[0] is not topology:
            before = self.blocks
            slots = self._slots.find(topology.host)
            if self.blocks > before:
                self._topology = None
                self._grow()
            self._last = topology, dispatch.to_device_async(slots, self._rows.device)
        return self._last[1]

    def _grow(self) -> None:
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

