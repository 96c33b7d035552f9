# mypy: disable-error-code="no-untyped-def,untyped-decorator,misc"
"""Which block lies where, on CUDA: the table of a `Topology` and the slots about its blocks, a launch each."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from fieldfuse.backends.triton.launch import kernel, pieces

BLOCK = 256


@triton.jit
def row_of(x, y, z, table, ox, oy, oz, sx, sy, sz):
    """Slots of the blocks that hold lattice corners, −1 where there is none, and the corners' rows."""
    bx = tl.minimum(tl.maximum((x >> 3) - ox, 0), sx - 1)  # far blocks are moved to the table's empty margin
    by = tl.minimum(tl.maximum((y >> 3) - oy, 0), sy - 1)
    bz = tl.minimum(tl.maximum((z >> 3) - oz, 0), sz - 1)
    slot = tl.load(table + (bz * sy + by) * sx + bx).to(tl.int64)
    return slot, slot * 512 + ((z & 7) * 8 + (y & 7)) * 8 + (x & 7)


@kernel("keys", "table")
def _table(keys, table, cells, count, ox, oy, oz, sx, sy, BLOCK: tl.constexpr):
    n = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    some = n < count
    x, y, z = tl.load(keys + 3 * n, some, 0) - ox, tl.load(keys + 3 * n + 1, some, 0) - oy, tl.load(keys + 3 * n + 2, some, 0) - oz
    cell = (z.to(tl.int64) * sy + y) * sx + x
    tl.store(cells + n, cell, some)
    tl.store(table + cell, n, some)


def table(keys: Tensor, origin: tuple[int, int, int], size: tuple[int, int, int]) -> tuple[Tensor, Tensor]:
    """`Topology.table` of keys (M, 3) int32, and (M,) int64 cells of them."""
    sx, sy, sz = size
    out = torch.full((sz, sy, sx), -1, dtype=torch.int32, device=keys.device)
    count = keys.shape[0]
    cells = torch.empty(count, dtype=torch.int64, device=keys.device)
    if count:
        _table[(pieces(count, BLOCK),)](keys, out, cells, count, *origin, sx, sy, BLOCK=BLOCK)
    return out, cells


@kernel("table", "cells", "out")
def _around(table, cells, chosen, slots, out, count, sx, sy, SOME: tl.constexpr, BLOCK: tl.constexpr):
    n = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    some = n < count
    k = n % 27
    step = ((k // 9 - 1) * sy + (k // 3) % 3 - 1) * sx + k % 3 - 1
    block = n // 27
    if SOME:
        block = tl.load(chosen + block, some, 0)
    # The margin keeps every step inside the table.
    slot = tl.load(table + tl.load(cells + block, some, 0) + step, some, -1)
    if SOME:
        slot = tl.load(slots + slot, slot >= 0, -1)
    tl.store(out + n, slot.to(tl.int64), some)


def around(table: Tensor, cells: Tensor, chosen: Tensor | None = None, slots: Tensor | None = None) -> Tensor:
    """`Topology.around` from its table and the cells of its blocks.

    Args:
        chosen, slots: (M',) int32, some of the blocks, and (M,) int32 the slot of each block among these, −1 where it is not one: then
            (M', 27) of these alone, without a table of theirs.
    """
    _, sy, sx = table.shape
    blocks = cells.shape[0] if chosen is None else chosen.shape[0]
    out = torch.empty((blocks, 27), dtype=torch.int64, device=cells.device)
    if blocks:
        given = table, cells, table if chosen is None else chosen, table if slots is None else slots
        _around[(pieces(27 * blocks, BLOCK),)](*given, out, 27 * blocks, sx, sy, SOME=chosen is not None, BLOCK=BLOCK)
    return out
