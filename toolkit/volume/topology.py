"""Which blocks there are and which rows lie beside which: find, halos, neighbours. Torch only, CPU and CUDA.

A block is 8×8×8 voxels. Block `keys[s]` = (bx, by, bz) owns rows s·512 … s·512 + 511 of every value array; inside a block rows are
z-major, row = ((s·8 + z)·8 + y)·8 + x, and the voxel sits at the lattice corner (key·8 + (x, y, z)) · voxel_size of the caller's frame.
Value arrays that are read through `lookup_rows` or `halo_rows` carry one more row at the end, the zero row, at index blocks·512.
"""

from __future__ import annotations

import math
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
KEY_LOW, KEY_HIGH = -(2**31), 2**31 - 1
Bounds = tuple[tuple[int, int, int], tuple[int, int, int]]
SELF = 13  # the block itself among the 27 of `around`


class Topology:
    """An immutable set of blocks.

    Args:
        keys: (M, 3) integer block keys (bx, by, bz), each within int32, none twice.
        max_table_cells: the dense block table is built when the keys' bounding box (with a margin of one block) has at most
            this many cells; otherwise `find` searches sorted codes and `table` is None.
        bounds: lowest and highest key that there can be, each (x, y, z). Keys are then believed to lie within and to differ, the table
            covers all of these (where it is small enough), and nothing is asked of the device that holds the keys.
        host: the same keys in the processor's memory, where they came from there.

    Attributes:
        keys: (M, 3) int32.
        table: (Sz, Sy, Sx) int32 slot or −1, or None; cell (z, y, x) is block key table_origin + (x, y, z).
        table_origin: (x, y, z) of the table's first cell, Python integers. The outermost layer of cells is always empty.
        table_size: (Sx, Sy, Sz), Python integers.
        own_cells: (M,) int64 cell of each block in the flat table; only where there is a table.

    Raises:
        ValueError: wrong shape, keys beyond int32, a key twice, or too many blocks for int32 rows.
    """

    def __init__(
        self,
        keys: Tensor,
        max_table_cells: int = MAX_TABLE_CELLS,
        bounds: Bounds | None = None,
        host: NDArray[np.int32] | None = None,
    ) -> None:
        if keys.ndim != 2 or keys.shape[1] != 3 or keys.is_floating_point():
            raise ValueError(f"block keys must be an integer (M, 3) tensor, not {keys.dtype} {tuple(keys.shape)}")
        if len(keys) > MAX_BLOCKS:
            raise ValueError(f"{len(keys)} blocks are more than int32 rows can number ({MAX_BLOCKS})")
        if bounds is not None and math.prod(high - low + 3 for low, high in zip(*bounds, strict=True)) > max_table_cells:
            bounds = None
        self.bounds, self._host = bounds, host
        self._among: tuple[Topology, Tensor, Tensor] | None = None  # where `around` is found, see `some`
        if bounds is not None and dispatch.can_use_triton(keys, dtypes=None):
            self._believe(keys, bounds, max_table_cells)
            return
        wide = keys.to(torch.int64)
        if bounds is None and len(keys) and bool(((wide < KEY_LOW) | (wide > KEY_HIGH)).any()):
            raise ValueError("block keys must fit into int32")
        self.keys = keys.to(torch.int32).contiguous()
        self._max_table_cells = max_table_cells
        if bounds is not None:
            low, high = (list(ends) for ends in bounds)
        else:
            low = wide.amin(0).tolist() if len(keys) else [0, 0, 0]
            high = wide.amax(0).tolist() if len(keys) else [0, 0, 0]
        self.table_origin = (low[0] - 1, low[1] - 1, low[2] - 1)
        self.table_size = (high[0] - low[0] + 3, high[1] - low[1] + 3, high[2] - low[2] + 3)
        sx, sy, sz = self.table_size
        table: Tensor | None = None
        self._codes: _Codes | None = None
        if sx * sy * sz <= max_table_cells:
            slots = torch.arange(len(keys), dtype=torch.int32, device=keys.device)
            flat = torch.full((sx * sy * sz,), -1, dtype=torch.int32, device=keys.device)
            cells = self._cells(wide)
            flat[cells] = slots
            unique = bounds is not None or bool((flat[cells] == slots).all())
            table = flat.view(sz, sy, sx)
            self._placed = table, cells
        else:
            self._codes = _Codes(wide)
            unique = self._codes.unique
        if not unique:
            raise ValueError("block keys must be unique")
        self._dense = table is not None

    def _believe(self, keys: Tensor, bounds: Bounds, max_table_cells: int) -> None:
        """The rest of the making of one whose keys are believed, on CUDA: the table is made when it is first asked for."""
        self.keys, self._max_table_cells, self._codes, self._dense = keys.to(torch.int32).contiguous(), max_table_cells, None, True
        (ax, ay, az), (bx, by, bz) = bounds
        self.table_origin, self.table_size = (ax - 1, ay - 1, az - 1), (bx - ax + 3, by - ay + 3, bz - az + 3)

    @cached_property
    def _placed(self) -> tuple[Tensor, Tensor]:
        """The table and the cells of its own blocks; elsewhere than on CUDA already known."""
        from fieldfuse.backends.triton import blocks

        return blocks.table(self.keys, self.table_origin, self.table_size)

    @property
    def table(self) -> Tensor | None:
        """See the class."""
        return self._placed[0] if self._dense else None

    @property
    def own_cells(self) -> Tensor:
        """See the class."""
        return self._placed[1]

    @property
    def host(self) -> NDArray[np.int32]:
        """(M, 3) the keys in the processor's memory; the device is asked where they did not come from there."""
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
        return Topology(keys, self._max_table_cells, self.bounds, host)

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
        return self if keys.device == self.device else Topology(keys, self._max_table_cells, self.bounds)

    def _cells(self, wide: Tensor) -> Tensor:
        """(..., 3) int64 keys inside the table's box → (...) flat cell."""
        (ox, oy, oz), (sx, sy, _) = self.table_origin, self.table_size
        if not is_cpu(wide.device):  # fewer launches
            return (wide * constant((1, sx, sx * sy), wide.device)).sum(-1).sub_((oz * sy + oy) * sx + ox)
        return ((wide[..., 2] - oz) * sy + (wide[..., 1] - oy)) * sx + (wide[..., 0] - ox)

    def find(self, query: Tensor) -> Tensor:
        """(..., 3) integer block keys → (...) int64 slots, −1 where there is no such block."""
        wide = query.to(torch.int64)
        if self.table is None:
            assert self._codes is not None
            return self._codes.find(wide)
        ends = tuple(first + size - 1 for first, size in zip(self.table_origin, self.table_size, strict=True))
        low, high = constant(self.table_origin, wide.device), constant(ends, wide.device)
        # Far keys are moved to the table's empty margin, so no mask is needed afterwards.
        return self.table.view(-1)[self._cells(torch.minimum(torch.maximum(wide, low), high))].to(torch.int64)

    def slots_of(self, other: Topology) -> Tensor:
        """(M',) int64 slots here of the other's blocks, −1 where there is no such block."""
        if self.bounds is not None and self.bounds == other.bounds and self.table is not None:
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
        if self.table is None:
            return self.find(self.keys.to(torch.int64)[:, None] + torch.tensor(shifts, device=self.device))
        sx, sy, _ = self.table_size
        # The margin keeps every step inside the table.
        steps = constant(tuple((dz * sy + dy) * sx + dx for dx, dy, dz in shifts), self.device)
        return self.table.view(-1)[self.own_cells[:, None] + steps].to(torch.int64)

    @property
    def neighbours(self) -> Tensor:
        """(M, 26) int64 slots of the blocks that share a face, edge or corner, −1 absent; columns of `around` without the block itself."""
        return torch.cat([self.around[:, :SELF], self.around[:, SELF + 1 :]], dim=1)

    def _rows(self, start: int, stop: int, first: int, size: int) -> Tensor:
        """(stop − start, size³) int32 rows of the lattice corners first … first + size − 1 along each axis of blocks start … stop."""
        which, inner = _pattern(first, size, self.device)
        around = self.around[start:stop]
        base = torch.where(around < 0, self.zero_row, around * VOXELS).to(torch.int32)
        # Absent blocks start at the zero row; whatever is added to that is clamped back to it.
        return base.index_select(1, which).add_(inner).clamp_max_(self.zero_row)

    def lookup_chunk(self, start: int, stop: int) -> Tensor:
        """`lookup_rows` of blocks start … stop − 1 only, not kept."""
        return self._rows(start, min(stop, self.blocks), 0, BLOCK + 1)

    def halo_chunk(self, start: int, stop: int) -> Tensor:
        """`halo_rows` of blocks start … stop − 1 only, not kept."""
        return self._rows(start, min(stop, self.blocks), -1, BLOCK + 2)

    @cached_property
    def lookup_rows(self) -> Tensor:
        """(M, 729) int32 rows of each block's 9×9×9 lattice corners, column (z·9 + y)·9 + x; absent ones point at `zero_row`."""
        return self.lookup_chunk(0, self.blocks)

    @cached_property
    def halo_rows(self) -> Tensor:
        """(M, 1000) int32 rows of the corners −1 … 8 along each axis, column ((z+1)·10 + y+1)·10 + x+1; absent ones point at `zero_row`."""
        return self.halo_chunk(0, self.blocks)

    def dilated_keys(self, steps: int = 1) -> Tensor:
        """(M', 3) int32 keys grown by `steps` blocks in the 26-neighbourhood: these keys first, in their order, then new ones by (z,
        y, x)."""
        if self.blocks == 0 or steps < 1:
            return self.keys.clone()
        sx, sy, sz = (size + 2 * steps for size in self.table_size)
        low = torch.tensor(self.table_origin, device=self.device) - steps
        if sx * sy * sz <= self._max_table_cells:
            grown = torch.zeros((sz, sy, sx), dtype=torch.bool, device=self.device)
            relative = self.keys.to(torch.int64) - low
            grown[relative[:, 2], relative[:, 1], relative[:, 0]] = True
            for _ in range(steps):
                grown = _spread(grown)
            grown[relative[:, 2], relative[:, 1], relative[:, 0]] = False
            new = grown.nonzero().flip(1) + low
        else:
            new = self.keys.to(torch.int64)
            reach = torch.arange(-steps, steps + 1, device=self.device)
            for axis in range(3):
                shift = torch.zeros((len(reach), 3), dtype=torch.int64, device=self.device)
                shift[:, axis] = reach
                new = torch.unique((new[:, None] + shift).view(-1, 3).flip(1), dim=0).flip(1)
            new = new[self.find(new) < 0]
        new = new[((new >= KEY_LOW) & (new <= KEY_HIGH)).all(1)]
        return torch.cat([self.keys, new.to(torch.int32)])


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


def _spread(mask: Tensor) -> Tensor:
    """(Z, Y, X) bool grown by one cell in the 26-neighbourhood: one OR along each axis after the other."""
    for axis in range(3):
        grown = mask.clone()
        length = mask.shape[axis] - 1
        grown.narrow(axis, 0, length).logical_or_(mask.narrow(axis, 1, length))
        grown.narrow(axis, 1, length).logical_or_(mask.narrow(axis, 0, length))
        mask = grown
    return mask


class _Codes:
    """Keys that lie too far apart for a table: each axis is replaced by ranks, so that a key packs into 64 bits whatever its range."""

    def __init__(self, wide: Tensor) -> None:
        self.axes = [torch.unique(wide[:, axis]) for axis in range(3)]
        ranks = [torch.searchsorted(values, wide[:, axis].contiguous()) for axis, values in enumerate(self.axes)]
        pairs = ranks[0] * len(self.axes[1]) + ranks[1]
        self.pairs = torch.unique(pairs)  # at most M of them, so pair rank × z rank stays below M² < 2⁶³
        codes = torch.searchsorted(self.pairs, pairs) * len(self.axes[2]) + ranks[2]
        self.codes, self.slots = torch.sort(codes)
        self.unique = not bool((self.codes[1:] == self.codes[:-1]).any())

    def find(self, wide: Tensor) -> Tensor:
        """(..., 3) int64 → (...) int64 slots, −1 absent."""
        if len(self.slots) == 0:  # only with max_table_cells below the empty set's own 27 cells
            return torch.full(wide.shape[:-1], -1, dtype=torch.int64, device=wide.device)
        x, in_x = _rank(self.axes[0], wide[..., 0].contiguous())
        y, in_y = _rank(self.axes[1], wide[..., 1].contiguous())
        z, in_z = _rank(self.axes[2], wide[..., 2].contiguous())
        pair, in_pair = _rank(self.pairs, x * len(self.axes[1]) + y)
        place, in_codes = _rank(self.codes, pair * len(self.axes[2]) + z)
        return torch.where(in_x & in_y & in_z & in_pair & in_codes, self.slots[place], -1)


def _rank(values: Tensor, query: Tensor) -> tuple[Tensor, Tensor]:
    """Place of each query in sorted `values` (some valid place when absent), and whether it is there."""
    place = torch.searchsorted(values, query).clamp_max_(len(values) - 1)
    return place, values[place] == query
