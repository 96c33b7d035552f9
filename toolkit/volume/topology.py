"""Which blocks there are and which rows lie beside which: find, halos, neighbours. Torch only, CPU and CUDA.

A block is 8×8×8 voxels. Block `keys[s]` = (bx, by, bz) owns rows s·512 … s·512 + 511 of every value array; inside a block rows are
z-major, row = ((s·8 + z)·8 + y)·8 + x, and the voxel sits at the lattice corner (key·8 + (x, y, z)) · voxel_size of the caller's frame.
Value arrays that are read through `lookup_rows` or `halo_rows` carry one more row at the end, the zero row, at index blocks·512.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property, lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from fieldfuse.backends import dispatch
from fieldfuse.backends.constants import BLOCK as BLOCK
from fieldfuse.backends.constants import LOOKUP as LOOKUP
from fieldfuse.backends.constants import VOXELS as VOXELS
from fieldfuse.backends.dispatch import is_cpu

HALO = (BLOCK + 2) ** 3
MAX_TABLE_CELLS = 2**26
MAX_BLOCKS = 2**31 // VOXELS - 2
Bounds = tuple[tuple[int, int, int], tuple[int, int, int]]


class Topology:
    """An immutable set of blocks.

    Args:
        keys: (M, 3) integer block keys (bx, by, bz), each within int32, none twice.
        bounds: lowest and highest key that there can be, each (x, y, z). Keys are then believed to lie within and to differ, the table
            covers all of these (where it is small enough), and nothing is read from the device that holds the keys.
        host: the same keys in the processor's memory, where they came from there.

    Attributes:
        keys: (M, 3) int32.
        table: (Sz, Sy, Sx) int32 slot or −1; cell (z, y, x) is block key table_origin + (x, y, z).
        table_origin: (x, y, z) of the table's first cell, Python integers. The outermost layer of cells is always empty.
        table_size: (Sx, Sy, Sz), Python integers.
        own_cells: (M,) int64 cell of each block in the flat table.

    Raises:
        ValueError: wrong shape, a key twice, blocks so far apart that their table has more than `MAX_TABLE_CELLS` cells, or too many blocks
            for int32 rows.
    """

    def __init__(self, keys: Tensor, bounds: Bounds | None = None, host: NDArray[np.int32] | None = None) -> None:
        if keys.ndim != 2 or keys.shape[1] != 3 or keys.is_floating_point():
            raise ValueError(f"block keys must be an integer (M, 3) tensor, not {keys.dtype} {tuple(keys.shape)}")
        if len(keys) > MAX_BLOCKS:
            raise ValueError(f"{len(keys)} blocks are more than int32 rows can number ({MAX_BLOCKS})")
        if bounds is not None and _cells_between(*bounds) > MAX_TABLE_CELLS:
            bounds = None
        self.bounds, self._host = bounds, host
        self._among: tuple[Topology, Tensor, Tensor] | None = None  # where `around` is found, see `some`
        wide = keys.to(torch.int64)
        low, high = bounds or ((wide.amin(0).tolist(), wide.amax(0).tolist()) if len(keys) else ([0, 0, 0], [0, 0, 0]))
        if min(low) < -(2**31) or max(high) >= 2**31:
            raise ValueError("block keys must fit into int32")
        if (cells := _cells_between(low, high)) > MAX_TABLE_CELLS:
            raise ValueError(f"blocks that lie so far apart would need a table of {cells:,} cells")
        self.keys = keys.to(torch.int32).contiguous()
        self.table_origin = (low[0] - 1, low[1] - 1, low[2] - 1)
        self.table_size = (high[0] - low[0] + 3, high[1] - low[1] + 3, high[2] - low[2] + 3)
        if bounds is not None and dispatch.can_use_triton(keys, dtypes=None):
            return  # the table is made when it is first needed
        sx, sy, sz = self.table_size
        slots = torch.arange(len(keys), dtype=torch.int32, device=keys.device)
        flat = torch.full((sx * sy * sz,), -1, dtype=torch.int32, device=keys.device)
        own = self._cells(wide)
        flat[own] = slots
        if bounds is None and not bool((flat[own] == slots).all()):
            raise ValueError("block keys must be unique")
        self._placed = flat.view(sz, sy, sx), own

    @cached_property
    def _placed(self) -> tuple[Tensor, Tensor]:
        """The table and the cells of its own blocks; elsewhere than on CUDA already known."""
        from fieldfuse.backends.triton import blocks

        return blocks.table(self.keys, self.table_origin, self.table_size)

    @property
    def table(self) -> Tensor:
        """See the class."""
        return self._placed[0]

    @property
    def own_cells(self) -> Tensor:
        """See the class."""
        return self._placed[1]

    @property
    def host(self) -> NDArray[np.int32]:
        """(M, 3) the keys in the processor's memory; copied from the device where they did not come from there."""
        if self._host is None:
            self._host = self.keys.cpu().numpy()
        return self._host

    @property
    def blocks(self) -> int:
        """M, the number of blocks."""
        return self.keys.shape[0]

    @property
    def zero_row(self) -> int:
        """The row that stands for every absent voxel: blocks · 512, one past the blocks' own rows."""
        return self.blocks * VOXELS

    @property
    def device(self) -> torch.device:
        return self.keys.device

    def alike(self, keys: Tensor, host: NDArray[np.int32] | None = None) -> Topology:
        """Other blocks of the same lattice, as much believed as these."""
        return Topology(keys, self.bounds, host)

    def some(self, keys: Tensor, host: NDArray[np.int32], chosen: Tensor, slots: Tensor) -> Topology:
        """Some of these blocks, on CUDA, whose surroundings are found in the table of all.

        Args:
            keys, host: theirs, on either side.
            chosen: (M',) int32 slots of them here.
            slots: (M,) int32 of each block here among them, −1 where it is not one.
        """
        out = self.alike(keys, host)
        out._among = self, chosen, slots
        return out

    def to(self, device: torch.device | str) -> Topology:
        """The same blocks in the same order on another device (self when already there)."""
        keys = self.keys.to(device)
        return self if keys.device == self.device else Topology(keys, self.bounds)

    def _cells(self, wide: Tensor) -> Tensor:
        """(..., 3) int64 keys inside the table's box → (...) flat cell."""
        (ox, oy, oz), (sx, sy, _) = self.table_origin, self.table_size
        if not is_cpu(wide.device):  # fewer launches
            return (wide * constant((1, sx, sx * sy), wide.device)).sum(-1).sub_((oz * sy + oy) * sx + ox)
        return ((wide[..., 2] - oz) * sy + (wide[..., 1] - oy)) * sx + (wide[..., 0] - ox)

    def find(self, query: Tensor) -> Tensor:
        """(..., 3) integer block keys → (...) int64 slots, −1 where there is no such block."""
        wide = query.to(torch.int64)
        ends = tuple(first + size - 1 for first, size in zip(self.table_origin, self.table_size, strict=True))
        low, high = constant(self.table_origin, wide.device), constant(ends, wide.device)
        # Far keys are moved to the table's empty margin, so no mask is needed afterwards.
        return self.table.view(-1)[self._cells(torch.minimum(torch.maximum(wide, low), high))].to(torch.int64)

    def slots_of(self, other: Topology) -> Tensor:
        """(M',) int64 slots here of the other's blocks, −1 where there is no such block."""
        if self.bounds is not None and self.bounds == other.bounds:
            return self.table.view(-1)[other.own_cells].to(torch.int64)
        return self.find(other.keys)

    @cached_property
    def around(self) -> Tensor:
        """(M, 27) int64 slots of the 3×3×3 blocks around each, −1 absent; column (dz+1)·9 + (dy+1)·3 + (dx+1), itself in column 13."""
        if self.bounds is not None and dispatch.can_use_triton(self.keys, dtypes=None):
            from fieldfuse.backends.triton import blocks

            if self._among is None:
                return blocks.around(*self._placed)
            whole, chosen, slots = self._among
            return blocks.around(*whole._placed, chosen, slots)
        line = range(-1, 2)
        shifts = [(dx, dy, dz) for dz in line for dy in line for dx in line]
        sx, sy, _ = self.table_size
        # The margin keeps every step inside the table.
        steps = constant(tuple((dz * sy + dy) * sx + dx for dx, dy, dz in shifts), self.device)
        return self.table.view(-1)[self.own_cells[:, None] + steps].to(torch.int64)

    def _rows(self, start: int, stop: int, first: int, size: int) -> Tensor:
        """(stop − start, size³) int32 rows of the lattice corners first … first + size − 1 along each axis of blocks start … stop."""
        which, inner = _pattern(first, size, self.device)
        around = self.around[start:stop]
        base = torch.where(around < 0, self.zero_row, around * VOXELS).to(torch.int32)
        # Absent blocks start at the zero row; whatever is added to that is clamped back to it.
        return base.index_select(1, which).add_(inner).clamp_max_(self.zero_row)

    def lookup_chunk(self, start: int, stop: int) -> Tensor:
        """`lookup_rows` of blocks start … stop − 1 only, not cached."""
        return self._rows(start, min(stop, self.blocks), 0, BLOCK + 1)

    def halo_chunk(self, start: int, stop: int) -> Tensor:
        """`halo_rows` of blocks start … stop − 1 only, not cached."""
        return self._rows(start, min(stop, self.blocks), -1, BLOCK + 2)

    @cached_property
    def lookup_rows(self) -> Tensor:
        """(M, 729) int32 rows of each block's 9×9×9 lattice corners, column (z·9 + y)·9 + x; absent ones point at `zero_row`."""
        return self.lookup_chunk(0, self.blocks)

    @cached_property
    def halo_rows(self) -> Tensor:
        """(M, 1000) int32 rows of the corners −1 … 8 along each axis, column ((z+1)·10 + y+1)·10 + x+1; absent ones point at `zero_row`."""
        return self.halo_chunk(0, self.blocks)


def _cells_between(low: Sequence[int], high: Sequence[int]) -> int:
    """Cells of the table of blocks whose keys lie between these (x, y, z), with its margin."""
    return math.prod(last - first + 3 for first, last in zip(low, high, strict=True))


@lru_cache(maxsize=256)
def constant(values: tuple[int, ...], device: torch.device) -> Tensor:
    """(N,) int64 on a device, sent there once."""
    return torch.tensor(values, dtype=torch.int64).to(device)


@lru_cache(maxsize=16)
def _pattern(first: int, size: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """(size³,) int64 which of the 3×3×3 blocks the corners first … first + size − 1 along each axis lie in, and int32 their rows there."""
    line = torch.arange(first, first + size)
    side, local = (line // BLOCK + 1), line % BLOCK
    which = ((side[:, None, None] * 3 + side[:, None]) * 3 + side).view(-1)
    inner = ((local[:, None, None] * BLOCK + local[:, None]) * BLOCK + local).view(-1).to(torch.int32)
    return which.to(device), inner.to(device)
