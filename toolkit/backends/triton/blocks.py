# mypy: disable-error-code="no-untyped-def,untyped-decorator,misc"
"""Blocks on CUDA: which lies where, masks and rows about their corners, cells on a lattice of half the voxel size (`volume/edit.py` in
tensors)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
import triton
import triton.language as tl
from numpy.typing import NDArray
from torch import Tensor

from fieldfuse.backends.constants import VOXELS
from fieldfuse.backends.dispatch import to_device_async
from fieldfuse.backends.triton.launch import kernel, pieces, power_of_two

if TYPE_CHECKING:
    from fieldfuse.volume.topology import Bounds, Topology

BLOCK = 256  # keys at a time
TILE = 128  # voxels of a block at a time
FEW = 2**21  # block keys that there can be, up to which all are marked
OCTANTS = np.array([(x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1)], np.int32)  # also steps to blocks that hold corners


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


@kernel("mask", "around", "out")
def _pool(mask, around, out, FIRST: tl.constexpr, WIDTH: tl.constexpr, EVERY: tl.constexpr):
    """Whether any, or every, row among the offsets FIRST … FIRST + WIDTH − 1 along each axis is set; one block."""
    block = tl.program_id(0)
    voxel = tl.arange(0, 512)
    z, y, x = voxel // 64, (voxel // 8) % 8, voxel % 8
    found = tl.full((512,), 1 if EVERY else 0, tl.int32)
    for k in range(WIDTH * WIDTH * WIDTH):
        nz = z + FIRST + k // (WIDTH * WIDTH) + 8  # of the 3 × 3 × 3 blocks, 0 to 23
        ny, nx = y + FIRST + (k // WIDTH) % WIDTH + 8, x + FIRST + k % WIDTH + 8
        slot = tl.load(around + block * 27 + (nz // 8 * 3 + ny // 8) * 3 + nx // 8)
        value = tl.load(mask + slot * 512 + (nz % 8 * 8 + ny % 8) * 8 + nx % 8, slot >= 0, 0).to(tl.int32)
        found = (found & value) if EVERY else (found | value)
    tl.store(out + block.to(tl.int64) * 512 + voxel, found.to(tl.uint8))


def pooled(topology: Topology, mask: Tensor, first: int, width: int, every: bool = False) -> Tensor:
    """(M · 512,) bool: whether any, or every, of the rows `first` … `first` + `width` − 1 steps off along each axis is set."""
    out = torch.empty_like(mask)
    if topology.blocks:
        given = mask.contiguous().view(torch.uint8), topology.around, out.view(torch.uint8)
        _pool[(topology.blocks,)](*given, FIRST=first, WIDTH=width, EVERY=every)
    return out


@kernel("rows", "table", "out")
def _resample(
    rows, nodes, table, keys, out, ox, oy, oz, sx, sy, sz, scale, CHANNELS: tl.constexpr, WIDE: tl.constexpr, TILE: tl.constexpr
):  # fmt: skip
    """Values at corners of one new block from the corners about them that count, in proportion to their weights."""
    parts: tl.constexpr = 512 // TILE
    block = tl.program_id(0) // parts
    voxel = (tl.program_id(0) % parts) * TILE + tl.arange(0, TILE)
    px = (tl.load(keys + 3 * block).to(tl.int32) * 8 + voxel % 8).to(tl.float32) * scale
    py = (tl.load(keys + 3 * block + 1).to(tl.int32) * 8 + (voxel // 8) % 8).to(tl.float32) * scale
    pz = (tl.load(keys + 3 * block + 2).to(tl.int32) * 8 + voxel // 64).to(tl.float32) * scale
    fx, fy, fz = tl.floor(px), tl.floor(py), tl.floor(pz)
    lx, ly, lz = fx.to(tl.int32), fy.to(tl.int32), fz.to(tl.int32)
    fx, fy, fz = px - fx, py - fy, pz - fz
    c = tl.arange(0, WIDE)[None, :]
    total = tl.zeros((TILE, WIDE), tl.float32)
    share = tl.zeros((TILE,), tl.float32)
    for k in range(8):
        x, y, z = lx + k % 2, ly + (k // 2) % 2, lz + k // 4
        weight = tl.where(k % 2 == 1, fx, 1 - fx) * tl.where((k // 2) % 2 == 1, fy, 1 - fy) * tl.where(k // 4 == 1, fz, 1 - fz)
        slot, row = row_of(x, y, z, table, ox, oy, oz, sx, sy, sz)
        counts = tl.load(nodes + row, slot >= 0, 0) != 0
        weight = tl.where(counts, weight, 0.0)
        share += weight
        total += weight[:, None] * tl.load(rows + row[:, None] * CHANNELS + c, counts[:, None] & (c < CHANNELS), 0.0)
    value = tl.where((share > 1e-6)[:, None], total / tl.maximum(share, 1e-6)[:, None], 0.0)
    place = block.to(tl.int64) * 512 + voxel
    tl.store(out + place[:, None] * CHANNELS + c, value, (c < CHANNELS) & (voxel < 512)[:, None])


def resample(topology: Topology, nodes: Tensor, rows: Sequence[Tensor], new_keys: Tensor, scale: float) -> list[Tensor]:
    """`edit.resample`, trilinear, of float32 rows; `nodes`: (M · 512,) bool, the corners that count."""
    table = topology.table
    nodes, keys, out = nodes.view(torch.uint8), new_keys.contiguous(), []
    for values in rows:
        flat = values.reshape(len(values), -1).contiguous()
        made = flat.new_empty((len(keys) * VOXELS + 1, flat.shape[1]))
        made[-1:].zero_()
        if len(keys):
            sizes = {"CHANNELS": flat.shape[1], "WIDE": power_of_two(flat.shape[1]), "TILE": TILE}
            ends = *topology.table_origin, *topology.table_size
            _resample[(len(keys) * (VOXELS // TILE),)](flat, nodes, table, keys, made, *ends, scale, **sizes)
        out.append(made.view(-1, *values.shape[1:]))
    return out


@kernel("rows", "below", "out")
def _take(
    rows, count, slots, below, below_count, table, keys, out, out_count, blocks, ox, oy, oz, sx, sy,
    INHERITS: tl.constexpr, CHANNELS: tl.constexpr, WIDE: tl.constexpr, TILE: tl.constexpr,
):  # fmt: skip
    """Rows and counts of one block, zero where there is none; corners of which nothing is known are as below."""
    parts: tl.constexpr = 512 // TILE
    block = (tl.program_id(0) // parts).to(tl.int64)
    voxel = (tl.program_id(0) % parts) * TILE + tl.arange(0, TILE)
    c = tl.arange(0, WIDE)[None, :]
    slot = tl.load(slots + block).to(tl.int64)
    here = (voxel < 512) & (slot >= 0)
    known = tl.load(count + slot * 512 + voxel, here, 0.0)
    value = tl.load(rows + (slot * 512 + voxel)[:, None] * CHANNELS + c, here[:, None] & (c < CHANNELS), 0.0)
    if INHERITS:
        x, y, z = tl.load(keys + 3 * block) - ox, tl.load(keys + 3 * block + 1) - oy, tl.load(keys + 3 * block + 2) - oz
        slot = tl.load(table + (z.to(tl.int64) * sy + y) * sx + x).to(tl.int64)
        new = (voxel < 512) & (slot >= 0) & (known == 0)
        inherited = tl.load(below_count + slot * 512 + voxel, new, 0.0)
        new = new & (inherited > 0)
        value = tl.where(
            new[:, None], tl.load(below + (slot * 512 + voxel)[:, None] * CHANNELS + c, new[:, None] & (c < CHANNELS), 0.0), value
        )
        known = tl.where(new, inherited, known)
    tl.store(out + (block * 512 + voxel)[:, None] * CHANNELS + c, value, (voxel < 512)[:, None] & (c < CHANNELS))
    tl.store(out_count + block * 512 + voxel, known, voxel < 512)
    # The zero row, written by the first program.
    last = (voxel == 0) & (tl.program_id(0) == 0)
    nothing = tl.zeros((TILE, WIDE), tl.float32)
    tl.store(out + (blocks.to(tl.int64) * 512 + voxel)[:, None] * CHANNELS + c, nothing, last[:, None] & (c < CHANNELS))


def take(
    rows: Tensor, count: Tensor, slots: Tensor, topology: Topology, below: tuple[Tensor, Tensor, Topology] | None = None
) -> tuple[Tensor, Tensor]:
    """(N, C) rows and (N,) counts of all blocks → (M · 512 + 1, C) and (M · 512,) of those at `slots` (M,) int32, zero where one is −1.

    Args:
        topology: the blocks that are taken.
        below: rows, counts and blocks of a volume with the same bounds, taken at corners whose count is zero here.
    """
    channels, blocks = rows.shape[1], slots.shape[0]
    if not blocks:
        return rows.new_zeros((1, channels)), rows.new_zeros(0)
    out, out_count = rows.new_empty((blocks * VOXELS + 1, channels)), rows.new_empty(blocks * VOXELS)
    other, other_count, place = below or (rows, count, topology)
    table = slots if below is None else place.table
    sizes = {"CHANNELS": channels, "WIDE": power_of_two(channels), "TILE": TILE}
    _take[(blocks * (VOXELS // TILE),)](
        rows, count, slots, other, other_count, table, topology.keys, out, out_count, blocks, *place.table_origin, *place.table_size[:2],
        INHERITS=below is not None, **sizes,
    )  # fmt: skip
    return out, out_count


@kernel("rows", "values")
def _put(rows, count, slots, values, values_count, changed, CHANNELS: tl.constexpr, WIDE: tl.constexpr, TILE: tl.constexpr):
    """Rows and counts of one block, where they have changed, to where they are kept."""
    parts: tl.constexpr = 512 // TILE
    block = (tl.program_id(0) // parts).to(tl.int64)
    voxel = (tl.program_id(0) % parts) * TILE + tl.arange(0, TILE)
    c = tl.arange(0, WIDE)[None, :]
    at, to = block * 512 + voxel, tl.load(slots + block).to(tl.int64) * 512 + voxel
    new = tl.load(changed + at, voxel < 512, 0) != 0
    mask = new[:, None] & (c < CHANNELS)
    tl.store(rows + to[:, None] * CHANNELS + c, tl.load(values + at[:, None] * CHANNELS + c, mask, 0.0), mask)
    tl.store(count + to, tl.load(values_count + at, new, 0.0), new)


def put(rows: Tensor, count: Tensor, slots: Tensor, values: Tensor, values_count: Tensor, changed: Tensor) -> None:
    """The way back of `take`, of the corners `changed` (M · 512,) alone, in place."""
    if len(slots):
        sizes = {"CHANNELS": rows.shape[1], "WIDE": power_of_two(rows.shape[1]), "TILE": TILE}
        given = values.contiguous(), values_count.contiguous(), changed.contiguous().view(torch.uint8)
        _put[(len(slots) * (VOXELS // TILE),)](rows, count, slots, *given, **sizes)


@kernel("kept", "out")
def _reach(kept, out):
    """For each octant of one block a bit for each step 0 … 1 along z, y, x: whether a cell there lies at the far sides it goes over."""
    block = tl.program_id(0).to(tl.int64)
    voxel = tl.arange(0, 512)
    z, y, x = voxel // 64, (voxel // 8) % 8, voxel % 8
    here = tl.load(kept + block * 512 + voxel).to(tl.int32)
    octant = (z // 4) * 4 + (y // 4) * 2 + x // 4
    o = 0
    while o < 8:
        bits, step = 0, 0
        while step < 8:
            far = ((step < 4) | (z % 4 == 3)) & ((step // 2 % 2 == 0) | (y % 4 == 3)) & ((step % 2 == 0) | (x % 4 == 3))
            bits += tl.max(tl.where((octant == o) & far, here, 0), 0) << step
            step += 1
        tl.store(out + block * 8 + o, bits)
        o += 1


@kernel("rows", "table", "out")
def _refine(
    rows, nodes, kept, table, keys, out, count, blocks, weight, ox, oy, oz, sx, sy, sz,
    CHANNELS: tl.constexpr, WIDE: tl.constexpr, TILE: tl.constexpr,
):  # fmt: skip
    """Values at corners of one new block that kept cells touch, from the coarse corners about them that do, by their weights."""
    parts: tl.constexpr = 512 // TILE
    block = tl.program_id(0) // parts
    voxel = (tl.program_id(0) % parts) * TILE + tl.arange(0, TILE)
    px = tl.load(keys + 3 * block) * 8 + voxel % 8
    py = tl.load(keys + 3 * block + 1) * 8 + (voxel // 8) % 8
    pz = tl.load(keys + 3 * block + 2) * 8 + voxel // 64
    c = tl.arange(0, WIDE)[None, :]
    used = tl.zeros((TILE,), tl.int32)
    for k in range(8):  # the cells about it
        slot, row = row_of((px - 1 + k % 2) >> 1, (py - 1 + (k // 2) % 2) >> 1, (pz - 1 + k // 4) >> 1, table, ox, oy, oz, sx, sy, sz)
        used = used | tl.load(kept + row, slot >= 0, 0).to(tl.int32)
    touched = used > 0
    fx, fy, fz = (px & 1).to(tl.float32) * 0.5, (py & 1).to(tl.float32) * 0.5, (pz & 1).to(tl.float32) * 0.5
    total, share = tl.zeros((TILE, WIDE), tl.float32), tl.zeros((TILE,), tl.float32)
    for k in range(8):
        slot, row = row_of((px >> 1) + k % 2, (py >> 1) + (k // 2) % 2, (pz >> 1) + k // 4, table, ox, oy, oz, sx, sy, sz)
        part = tl.where(k % 2 == 1, fx, 1 - fx) * tl.where((k // 2) % 2 == 1, fy, 1 - fy) * tl.where(k // 4 == 1, fz, 1 - fz)
        counts = touched & (part > 0) & (tl.load(nodes + row, slot >= 0, 0) != 0)
        part = tl.where(counts, part, 0.0)
        share += part
        total += part[:, None] * tl.load(rows + row[:, None] * CHANNELS + c, counts[:, None] & (c < CHANNELS), 0.0)
    value = tl.where((share > 1e-6)[:, None], total / tl.maximum(share, 1e-6)[:, None], 0.0)
    place = block.to(tl.int64) * 512 + voxel
    tl.store(out + place[:, None] * CHANNELS + c, value, (c < CHANNELS) & (voxel < 512)[:, None])
    tl.store(count + place, tl.where(touched, weight, 0.0), voxel < 512)
    # The zero row, written by the first program.
    last = (voxel == 0) & (tl.program_id(0) == 0)
    nothing = tl.zeros((TILE, WIDE), tl.float32)
    tl.store(out + (blocks.to(tl.int64) * 512 + voxel)[:, None] * CHANNELS + c, nothing, last[:, None] & (c < CHANNELS))


def children(topology: Topology, reach: NDArray[np.uint8]) -> NDArray[np.int32]:
    """(M', 3) keys of the blocks of half the voxel size that hold kept cells, in the order of their parents, then of those that only hold
    corners of such cells, by (z, y, x).

    Args:
        reach: (M, 8) of `_reach`.
    """
    parent, octant = np.divmod(np.flatnonzero(reach & 1), 8)
    keys = topology.host[parent] * 2 + OCTANTS[octant]
    # One number for each key, in the order of the table.
    size = 2 * np.array(topology.table_size, np.int32) + 2
    first = 2 * np.array(topology.table_origin, np.int32)
    code = np.array([1, size[0], size[0] * size[1]], np.int32)
    own = (keys - first) @ code
    steps = OCTANTS @ code
    bits = np.unpackbits(reach[parent, octant][:, None], axis=1, bitorder="little")
    bits[:, 0] = 0
    which, step = np.divmod(np.flatnonzero(bits), 8)
    reached = own[which] + steps[step]
    if (cells := math.prod(size.tolist())) <= FEW:
        marks = np.zeros(cells, bool)
        marks[reached] = True
        marks[own] = False
        new = np.flatnonzero(marks)
    else:
        new = np.setdiff1d(reached, own)
    corners = np.stack([new % size[0], new // size[0] % size[1], new // code[2]], 1) + first
    return np.concatenate([keys, corners.astype(np.int32)])


def split(topology: Topology, kept: Tensor, rows: Tensor, bounds: Bounds, weight: float) -> tuple[Topology, Tensor, Tensor]:
    """The cells `kept` (M · 512,) bool on a lattice of half the voxel size.

    Args:
        rows: (M · 512 + 1, C) float32.
        bounds: of the new blocks.

    Returns:
        the new blocks; (M' · 512 + 1, C) rows, interpolated between corners of kept cells, and (M' · 512,) the `weight` at corners of their
        children, both zero elsewhere.
    """
    device, channels = rows.device, rows.shape[1]
    reach = torch.empty((topology.blocks, 8), dtype=torch.uint8, device=device)
    mask = kept.view(torch.uint8)
    if topology.blocks:
        _reach[(topology.blocks,)](mask, reach)
    keys = children(topology, reach.cpu().numpy())
    fine = type(topology)(to_device_async(keys, device), bounds=bounds, host=keys)
    if not len(keys):
        return fine, rows.new_zeros((1, channels)), rows.new_zeros(0)
    out, count = rows.new_empty((fine.zero_row + 1, channels)), rows.new_empty(fine.zero_row)
    nodes = pooled(topology, kept, -1, 2).view(torch.uint8)
    sizes = {"CHANNELS": channels, "WIDE": power_of_two(channels), "TILE": TILE}
    _refine[(fine.blocks * (VOXELS // TILE),)](
        rows, nodes, mask, topology.table, fine.keys, out, count, fine.blocks, weight, *topology.table_origin, *topology.table_size, **sizes
    )
    return fine, out, count
