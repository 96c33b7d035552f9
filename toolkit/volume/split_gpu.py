# mypy: disable-error-code="no-untyped-def,untyped-decorator,misc"
"""Cells on a lattice of half the voxel size, on CUDA: two launches, and the device is asked once in between (`edit.split` in tensors)."""

from __future__ import annotations

import math

import numpy as np
import torch
import triton.language as tl
from numpy.typing import NDArray
from torch import Tensor

from fieldfuse.backends.dispatch import to_device_async
from fieldfuse.backends.triton.launch import kernel, power_of_two
from fieldfuse.volume.blocks_gpu import pooled
from fieldfuse.volume.tables_gpu import row_of
from fieldfuse.volume.topology import VOXELS, Bounds, Topology

FEW = 2**21  # block keys that there can be, up to which all are marked
TILE = 128  # voxels of a block at a time
OCTANTS = np.array([(x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1)], np.int32)  # also steps to blocks that hold corners


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
    # The zero row, by whoever comes first.
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
    fine = Topology(to_device_async(keys, device), bounds=bounds, host=keys)
    if not len(keys):
        return fine, rows.new_zeros((1, channels)), rows.new_zeros(0)
    out, count = rows.new_empty((fine.zero_row + 1, channels)), rows.new_empty(fine.zero_row)
    nodes = pooled(topology, kept, -1, 2).view(torch.uint8)
    sizes = {"CHANNELS": channels, "WIDE": power_of_two(channels), "TILE": TILE}
    _refine[(fine.blocks * (VOXELS // TILE),)](
        rows, nodes, mask, topology.table, fine.keys, out, count, fine.blocks, weight, *topology.table_origin, *topology.table_size, **sizes
    )
    return fine, out, count
