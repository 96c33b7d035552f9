# mypy: disable-error-code="no-untyped-def,untyped-decorator,misc"
"""Masks and rows of blocks on CUDA: what lies about lattice corners, and values on a finer lattice (`volume/edit.py` in tensors)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
import triton.language as tl
from torch import Tensor

from fieldfuse.backends.constants import VOXELS
from fieldfuse.backends.triton.launch import kernel, power_of_two
from fieldfuse.backends.triton.tables import row_of

if TYPE_CHECKING:
    from fieldfuse.volume.topology import Topology

TILE = 128  # voxels of a block at a time


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
    # The zero row, by whoever comes first.
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
