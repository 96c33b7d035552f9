"""Changing the set of voxels: prune, dilate, drop empty blocks, split in eight, resample. Torch only; nothing is changed in place.

Everywhere below `occupied` is (M · 512,) bool (a voxel is the cell whose lowest lattice corner is its row) and `rows` holds value arrays
(M · 512 + 1, C) or (M · 512 + 1,) of lattice corners with the zero row at the end. Only corners of occupied voxels hold values that mean
something; the others are never mixed in.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from fieldfuse.backends import dispatch
from fieldfuse.backends.dispatch import is_cpu
from fieldfuse.volume.host import zero_rows
from fieldfuse.volume.topology import BLOCK, VOXELS, Bounds, Topology, constant

CHUNK = 1024  # blocks at a time …
COPIED = 128  # … and of those that are copied
_ELEMENTS = 2**19  # values gathered at a time by `resample`: about what fits into a core's cache …
_AT_ONCE = 2**27  # … and on another device


def corner_nodes(topology: Topology, occupied: Tensor) -> Tensor:
    """(M · 512,) bool: lattice corners that at least one occupied voxel touches."""
    return _pooled(topology, occupied, 0)


def _pooled(topology: Topology, occupied: Tensor, last: int) -> Tensor:
    """(M · 512,) bool: rows with an occupied row among the offsets −1 … `last` along each axis."""
    width = last + 2
    if is_cpu(occupied.device):
        from fieldfuse.backends.numba import volume

        out = torch.zeros_like(occupied)
        volume.dilate(topology.around.numpy(), occupied.numpy(), -last, 1, out.numpy())
        return out
    if dispatch.can_use_triton(occupied, dtypes=None):
        from fieldfuse.backends.triton import blocks

        return blocks.pooled(topology, occupied, -1, width)
    return pooled_in_torch(topology, occupied, width)


def pooled_in_torch(topology: Topology, occupied: Tensor, width: int) -> Tensor:
    """(M · 512,) bool: rows with an occupied row among the offsets −1 … width − 2 along each axis; on any device."""
    padded = torch.cat([occupied, occupied.new_zeros(1)])
    out = torch.empty_like(occupied)
    side = BLOCK + width - 1
    for start in range(0, topology.blocks, CHUNK):
        stop = min(start + CHUNK, topology.blocks)
        mask = padded[topology.halo_chunk(start, stop).view(-1)].view(-1, 10, 10, 10)[:, :side, :side, :side]
        for axis in (1, 2, 3):
            mask = torch.stack([mask.narrow(axis, shift, BLOCK) for shift in range(width)]).any(0)
        out[start * VOXELS : stop * VOXELS] = mask.reshape(-1)
    return out


def _with_reached_blocks(topology: Topology, occupied: Tensor, lowest: int) -> Topology:
    """These blocks, then the absent ones that hold a row one step (from `lowest` to +1 along each axis) beside an occupied row, in the
    order of the table. The device is read once."""
    (sx, sy, sz), nowhere = topology.table_size, topology.table.numel()  # one more cell takes what is not reached
    # (M, 3, 3, 3) steps: whether a row of a block lies at its low end, anywhere, or at its high end along each axis.
    reaches = occupied.view(-1, BLOCK, BLOCK, BLOCK)
    for axis in (1, 2, 3):
        low, high = reaches.narrow(axis, 0, 1), reaches.narrow(axis, BLOCK - 1, 1)
        reaches = torch.cat([low, reaches.any(axis, keepdim=True), high], axis)
    line = range(lowest, 2)
    steps = [(z, y, x) for z in line for y in line for x in line]
    chosen = constant(tuple(((z + 1) * 3 + y + 1) * 3 + x + 1 for z, y, x in steps), occupied.device)
    cells = constant(tuple((z * sy + y) * sx + x for z, y, x in steps), occupied.device)
    reached = torch.where(reaches.flatten(1)[:, chosen], topology.own_cells[:, None] + cells, nowhere)
    marks = torch.zeros(nowhere + 1, dtype=torch.bool, device=occupied.device).index_fill_(0, reached.view(-1), True)
    new = (marks[:-1].view(sz, sy, sx) & (topology.table < 0)).nonzero().flip(1) + constant(topology.table_origin, occupied.device)
    return topology if len(new) == 0 else topology.alike(torch.cat([topology.keys.long(), new]))


def with_corner_blocks(topology: Topology, occupied: Tensor) -> tuple[Topology, Tensor]:
    """These blocks, then those missing that hold corners of occupied voxels; and `occupied` for them all."""
    return _extended(_with_reached_blocks(topology, occupied, 0), occupied)


def dilate(topology: Topology, occupied: Tensor, steps: int = 1, grow: bool = True) -> tuple[Topology, Tensor]:
    """Occupied voxels grown by `steps` voxels in the 26-neighbourhood, across block borders.

    Returns:
        the topology (these blocks in their order, then, when `grow`, the new ones that were needed) and the new occupancy. Without
        `grow` it is the same growth, cut to these blocks.
    """
    here = topology
    for step in range(steps):
        if grow or step < steps - 1:  # a later step may come back out of a block that is not here
            topology, occupied = _extended(_with_reached_blocks(topology, occupied, -1), occupied)
        occupied = _pooled(topology, occupied, 1)
    return (topology, occupied) if grow else (here, occupied[: here.zero_row])


def _extended(topology: Topology, occupied: Tensor) -> tuple[Topology, Tensor]:
    return topology, torch.cat([occupied, occupied.new_zeros(topology.zero_row - len(occupied))])


def erase_empty_blocks(topology: Topology, occupied: Tensor, rows: Sequence[Tensor]) -> tuple[Topology, Tensor, list[Tensor]]:
    """Without the blocks that hold neither an occupied voxel nor a corner of one; the others keep their order. Of their rows those that no
    occupied voxel uses are zero."""
    nodes = corner_nodes(topology, occupied).view(-1, VOXELS)
    kept = nodes.any(1).nonzero().view(-1)
    values = [_of_blocks(of, kept, nodes) for of in rows]
    return topology.alike(topology.keys[kept]), occupied.view(-1, VOXELS)[kept].view(-1), values


def _of_blocks(values: Tensor, kept: Tensor, nodes: Tensor) -> Tensor:
    """(M · 512 + 1, …) rows → those of the blocks `kept`, as far as they are `nodes` (M, 512), and the last one; a few blocks at a time,
    and what is not used stays unwritten."""
    out = zero_rows((len(kept) * VOXELS + 1, *values.shape[1:]), values.device, values.dtype)
    with torch.no_grad():
        blocks, new = (of[:-1].reshape(-1, VOXELS, *of.shape[1:]) for of in (values, out))
        for first in range(0, len(kept), COPIED):
            some = slice(first, first + COPIED)
            new[some][nodes[kept[some]]] = blocks[kept[some]][nodes[kept[some]]]
        out[-1] = values[-1]
    return out


def split(topology: Topology, occupied: Tensor, rows: Sequence[Tensor]) -> tuple[Topology, Tensor, list[Tensor]]:
    """Every voxel into 2×2×2: the same function inside occupied voxels, on a lattice of half the voxel size and the same origin.

    Returns:
        topology (children in the order of their parents, then blocks that only hold corners), occupancy, and values, which are zero
        at corners that no occupied voxel touches.
    """
    octants = constant(tuple(k for z in (0, 1) for y in (0, 1) for x in (0, 1) for k in (x, y, z)), topology.device).view(8, 3)
    # (M, z half, z, y half, y, x half, x) → (M, 8 octants, 4, 4, 4)
    cubes = occupied.view(-1, 2, 4, 2, 4, 2, 4).permute(0, 1, 3, 5, 2, 4, 6).reshape(-1, 8, 4, 4, 4)
    parent, octant = cubes.flatten(2).any(2).nonzero().unbind(1)
    child = cubes[parent, octant]
    for axis in (1, 2, 3):
        child = child.repeat_interleave(2, axis)
    keys = topology.keys[parent].long() * 2 + octants[octant]
    bounds = None if topology.bounds is None else doubled(*topology.bounds)
    new_topology, new_occupied = with_corner_blocks(Topology(keys, bounds=bounds), child.reshape(-1))
    out = resample(topology, occupied, rows, new_topology.keys, 0.5)
    unused = ~corner_nodes(new_topology, new_occupied)
    for values in out:
        values[:-1].masked_fill_(unused.view(-1, *[1] * (values.ndim - 1)), 0.0)
    return new_topology, new_occupied, out


def doubled(low: tuple[int, int, int], high: tuple[int, int, int]) -> Bounds:
    """Bounds of the blocks' children, and of the blocks that hold corners of these."""
    (ax, ay, az), (bx, by, bz) = low, high
    return (2 * ax, 2 * ay, 2 * az), (2 * bx + 2, 2 * by + 2, 2 * bz + 2)


def resample(topology: Topology, occupied: Tensor, rows: Sequence[Tensor], new_keys: Tensor, scale: float) -> list[Tensor]:
    """Values at the lattice corners of other blocks, on a lattice with the same origin and another voxel size.

    Only corners of occupied voxels count; their weights are scaled to sum to 1, so that borders do not fade into what was never
    fitted. Where none is near, the value is zero.

    Args:
        new_keys: (N, 3) blocks of the new lattice.
        scale: new voxel size ÷ old voxel size.

    Returns:
        per value array (N · 512 + 1, …) with the zero row.
    """
    nodes = corner_nodes(topology, occupied)
    if topology.bounds is not None and dispatch.can_use_triton(*rows):  # keys are small there
        from fieldfuse.backends.triton import blocks

        return blocks.resample(topology, nodes, rows, new_keys, scale)
    row_of_valid = torch.where(nodes, torch.arange(len(nodes), device=nodes.device), topology.zero_row)
    row_of_valid = torch.cat([row_of_valid, row_of_valid.new_full((1,), topology.zero_row)])
    if not rows:
        return []
    out = [values.new_zeros((len(new_keys) * VOXELS + 1, *values.shape[1:])) for values in rows]
    flat = [values.flatten(1) if values.ndim > 1 else values[:, None] for values in rows]
    side = math.floor((BLOCK - 1) * scale) + 3
    widths = [values.shape[1] for values in flat]
    most = _ELEMENTS if is_cpu(topology.device) else _AT_ONCE
    step = max(most // (side**3 * (sum(widths) + 1)), 1)
    for start in range(0, len(new_keys), step):
        corner = new_keys[start : start + step].long()[..., None] * BLOCK + torch.arange(BLOCK, device=new_keys.device)
        place = corner.double() * scale  # (n, 3, 8) in the old lattice
        low = place[..., 0].floor().long()
        base = place.floor().long()
        inside = (place - base).float()
        source = row_of_valid[_box_rows(topology, low, side)]  # (n, side³), z-major
        cube = torch.cat([values[source] for values in flat], -1).masked_fill_((source == topology.zero_row)[..., None], 0.0)
        mixed = _interpolate(cube, source != topology.zero_row, base - low[..., None], inside, side)
        for target, part in zip(out, mixed.split(widths, -1), strict=True):
            target[start * VOXELS : start * VOXELS + len(part)] = part.reshape(-1, *target.shape[1:])
    return out


def _box_rows(topology: Topology, low: Tensor, side: int) -> Tensor:
    """(n, 3) lowest lattice corners → (n, side³) int64 rows of the cubes above them, z-major; the zero row where absent."""
    line = low[..., None] + torch.arange(side, device=low.device)  # (n, 3, side)
    block = line >> 3
    local = line & (BLOCK - 1)
    first = block[..., :1]
    spans = (side + BLOCK - 2) // BLOCK + 1  # as many as there can be
    if is_cpu(low.device):
        spans = int((block[..., -1:] - first).amax()) + 1 if len(low) else 1
    reach = torch.arange(spans, device=low.device)
    near = first + reach  # (n, 3, spans): the blocks that a cube can touch
    z, y, x = (near[:, axis] for axis in (2, 1, 0))
    shape = (len(low), spans, spans, spans)
    keys = torch.stack([x[:, None, None, :].expand(shape), y[:, None, :, None].expand(shape), z[:, :, None, None].expand(shape)], -1)
    slots = topology.find(keys).view(len(low), -1)
    at = block - first  # (n, 3, side) which of those blocks
    which = (at[:, 2, :, None, None] * spans + at[:, 1, None, :, None]) * spans + at[:, 0, None, None, :]
    inner = (local[:, 2, :, None, None] * BLOCK + local[:, 1, None, :, None]) * BLOCK + local[:, 0, None, None, :]
    slot = slots.gather(1, which.view(len(low), side**3))
    return torch.where(slot < 0, topology.zero_row, slot * VOXELS + inner.view(len(low), -1))


def _interpolate(cube: Tensor, known: Tensor, base: Tensor, inside: Tensor, side: int) -> Tensor:
    """(n, side³, C) values with (n, side³) bool, at the places base + inside (n, 3, 8 along each axis) → (n · 512, C)."""
    count, _, channels = cube.shape
    cube = torch.cat([cube, known[..., None].to(cube.dtype)], -1)
    for axis in (2, 1, 0):  # z, y, x: one linear step along each axis, always on contiguous rows
        cube = cube.view(count, -1, side, side**axis * (channels + 1))
        lines = cube.shape[1]
        first = torch.arange(count * lines, device=cube.device).view(count, lines, 1) * side + base[:, None, axis]
        cube = cube.view(count * lines * side, -1)
        weight = inside[:, None, axis].expand(count, lines, BLOCK).reshape(-1, 1).to(cube.dtype)
        cube = torch.lerp(cube[first.view(-1)], cube[first.view(-1) + 1], weight)
    cube = cube.view(-1, channels + 1)
    weight = cube[:, -1:]
    return torch.where(weight > 1e-6, cube[:, :-1] / weight.clamp_min(1e-6), 0.0)
