"""Lattices, compiled: pruning and refining voxel by voxel where something is (`volume/edit.py` is the reference), distances to what is
occupied, votes of images with depth, and the visual hull."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "boundscheck": False}


@njit(**OPTIONS)
def chessboard_distance(bricks: Any, most: Any) -> None:
    """In place: 0 where something is, else `most` → distance along the longest axis, capped; two sweeps are exact for it.

    Each sweep takes rows from four rows that it has been to, many bricks at a time, and then goes along the row.
    """
    a, b, c = bricks.shape
    far, one = np.uint8(most), np.uint8(1)
    near = np.empty(c + 2, np.uint8)  # the nearest of the four rows, with a margin
    for sweep in range(2):
        way = 1 if sweep == 0 else -1
        for i0 in range(a):
            i = i0 if sweep == 0 else a - 1 - i0
            for j0 in range(b):
                j = j0 if sweep == 0 else b - 1 - j0
                row = bricks[i, j]
                near[:] = far
                for side in range(4):
                    p, q = (i, j - way) if side == 3 else (i - way, j + side - 1)
                    if 0 <= p < a and 0 <= q < b:
                        other = bricks[p, q]
                        for k in range(c):
                            here, there = near[k + 1], other[k]
                            near[k + 1] = there if there < here else here
                for k in range(c):
                    left, here, right = near[k], near[k + 1], near[k + 2]
                    here = left if left < here else here
                    here = np.uint8((right if right < here else here) + one)
                    row[k] = here if here < row[k] else row[k]
                last = far
                for k0 in range(c):
                    k = k0 if sweep == 0 else c - 1 - k0
                    step, here = np.uint8(last + one), row[k]
                    last = step if step < here else here
                    row[k] = last


@njit(**OPTIONS)
def _neighbour(around: Any, slot: Any, x: Any, y: Any, z: Any) -> Any:
    """Row of the lattice place (x, y, z), each −1 … 8, relative to block `slot`; −1 where its block is absent."""
    which = (((z + 8) >> 3) * 3 + ((y + 8) >> 3)) * 3 + ((x + 8) >> 3)
    other = around[slot, which]
    if other < 0:
        return -1
    return other * 512 + ((z & 7) * 8 + (y & 7)) * 8 + (x & 7)


@njit(**OPTIONS)
def dilate(around: Any, strong: Any, low: Any, high: Any, out: Any) -> None:
    """out[row] = True for every row at offsets low … high of a strong row, inside these blocks."""
    for row in range(len(strong)):
        if not strong[row]:
            continue
        slot, local = row >> 9, row & 511
        x, y, z = local & 7, (local >> 3) & 7, local >> 6
        if x + low >= 0 and y + low >= 0 and z + low >= 0 and x + high < 8 and y + high < 8 and z + high < 8:
            for dz in range(low, high + 1):
                for dy in range(low, high + 1):
                    for dx in range(low, high + 1):
                        out[row + dz * 64 + dy * 8 + dx] = True
            continue
        for dz in range(low, high + 1):
            for dy in range(low, high + 1):
                for dx in range(low, high + 1):
                    other = _neighbour(around, slot, x + dx, y + dy, z + dz)
                    if other >= 0:
                        out[other] = True


@njit(**OPTIONS)
def _first_child(index: Any, ratio: Any) -> Any:
    """First voxel of the finer lattice whose centre lies in voxel `index` or beyond: j with (j + ½) / ratio ≥ index."""
    return int(np.ceil(index * ratio - 0.5))


@njit(**OPTIONS)
def mark_blocks(keys: Any, occupied: Any, ratio: Any, low: Any, blocks: Any) -> None:
    """blocks[z, y, x] = True for finer blocks that hold children of occupied voxels or corners of them; cell 0 is block `low`."""
    for row in range(len(occupied)):
        if not occupied[row]:
            continue
        slot, local = row >> 9, row & 511
        x = keys[slot, 0] * 8 + (local & 7)
        y = keys[slot, 1] * 8 + ((local >> 3) & 7)
        z = keys[slot, 2] * 8 + (local >> 6)
        x0, x1 = _first_child(x, ratio), _first_child(x + 1, ratio)
        y0, y1 = _first_child(y, ratio), _first_child(y + 1, ratio)
        z0, z1 = _first_child(z, ratio), _first_child(z + 1, ratio)
        if x0 == x1 or y0 == y1 or z0 == z1:
            continue
        for k in range((z0 >> 3) - low[2], (z1 >> 3) - low[2] + 1):
            for j in range((y0 >> 3) - low[1], (y1 >> 3) - low[1] + 1):
                for i in range((x0 >> 3) - low[0], (x1 >> 3) - low[0] + 1):
                    blocks[k, j, i] = True


@njit(**OPTIONS)
def mark_children(keys: Any, occupied: Any, ratio: Any, table: Any, ox: Any, oy: Any, oz: Any, out: Any) -> None:
    """out[row] = True for the voxels of the finer lattice whose centres lie in occupied ones."""
    for row in range(len(occupied)):
        if not occupied[row]:
            continue
        slot, local = row >> 9, row & 511
        x = keys[slot, 0] * 8 + (local & 7)
        y = keys[slot, 1] * 8 + ((local >> 3) & 7)
        z = keys[slot, 2] * 8 + (local >> 6)
        for k in range(_first_child(z, ratio), _first_child(z + 1, ratio)):
            for j in range(_first_child(y, ratio), _first_child(y + 1, ratio)):
                for i in range(_first_child(x, ratio), _first_child(x + 1, ratio)):
                    block = table[(k >> 3) - oz, (j >> 3) - oy, (i >> 3) - ox]
                    out[block * 512 + ((k & 7) * 8 + (j & 7)) * 8 + (i & 7)] = True


@njit(**OPTIONS)
def resample(
    new_keys: Any,
    nodes: Any,
    scale: Any,
    table: Any,
    ox: Any,
    oy: Any,
    oz: Any,
    place: Any,
    density: Any,
    feature: Any,
    out_density: Any,
    out_feature: Any,
) -> None:
    """Values at the corners `nodes` of the finer lattice from the known corners of the coarser, weights scaled to sum to 1. Row r of the
    coarser has the value `place[r]`, or none (−1)."""
    channels = feature.shape[1]
    for row in range(len(nodes)):
        if not nodes[row]:
            continue
        slot, local = row >> 9, row & 511
        x = (new_keys[slot, 0] * 8 + (local & 7)) * scale
        y = (new_keys[slot, 1] * 8 + ((local >> 3) & 7)) * scale
        z = (new_keys[slot, 2] * 8 + (local >> 6)) * scale
        i, j, k = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
        fx, fy, fz = x - i, y - j, z - k
        total = 0.0
        value = 0.0
        for corner in range(8):
            dx, dy, dz = corner & 1, (corner >> 1) & 1, corner >> 2
            weight = (fx if dx else 1 - fx) * (fy if dy else 1 - fy) * (fz if dz else 1 - fz)
            if weight <= 0:
                continue
            u, v, w = i + dx, j + dy, k + dz
            bx, by, bz = (u >> 3) - ox, (v >> 3) - oy, (w >> 3) - oz
            if bx < 0 or by < 0 or bz < 0 or bx >= table.shape[2] or by >= table.shape[1] or bz >= table.shape[0]:
                continue
            block = table[bz, by, bx]
            if block < 0:
                continue
            source = place[block * 512 + ((w & 7) * 8 + (v & 7)) * 8 + (u & 7)]
            if source < 0:
                continue
            total += weight
            value += weight * density[source]
            share = np.float32(weight)
            for c in range(channels):
                out_feature[row, c] += share * feature[source, c]
        if total > 1e-6:
            out_density[row] = value / total
            part = np.float32(1 / total)
            for c in range(channels):
                out_feature[row, c] *= part
        else:
            for c in range(channels):
                out_feature[row, c] = 0


@njit(**OPTIONS)
def vote(centres: Any, radius: Any, camera: Any, world: Any, depth: Any, out: Any) -> None:
    """Add the votes of one image on voxels to out (3, N): unknown, past, here."""
    fx, fy, cx, cy = camera
    height, width = depth.shape
    for i in range(len(centres)):
        x, y, z = centres[i]
        far = world[2, 0] * x + world[2, 1] * y + world[2, 2] * z + world[2, 3]
        reach = 2 * radius[i]
        if far <= reach:
            continue
        u = (world[0, 0] * x + world[0, 1] * y + world[0, 2] * z + world[0, 3]) / far * fx + cx
        v = (world[1, 0] * x + world[1, 1] * y + world[1, 2] * z + world[1, 3]) / far * fy + cy
        if not (0 <= u < width and 0 <= v < height):
            continue
        there = depth[int(v), int(u)]
        if not there > 0:
            out[0, i] += 1
        elif far < there - reach:
            out[1, i] += 1
        elif far <= there + reach:
            out[2, i] += 1


@njit(**OPTIONS)
def add_points(places: Any, colours: Any, out: Any) -> None:
    """Add points (P, 3), in voxels, to the corners about them, out (z, y, x, 4): weight, and colours by it."""
    high, long, wide = out.shape[0] - 1, out.shape[1] - 1, out.shape[2] - 1
    for i in range(len(places)):
        x, y, z = places[i]
        if not (0 <= x < wide and 0 <= y < long and 0 <= z < high):
            continue
        left, top, front = int(x), int(y), int(z)
        for corner in range(8):
            dx, dy, dz = corner & 1, (corner >> 1) & 1, corner >> 2
            weight = abs(1 - dx - (x - left)) * abs(1 - dy - (y - top)) * abs(1 - dz - (z - front))
            node = out[front + dz, top + dy, left + dx]
            node[0] += weight
            for channel in range(3):
                node[channel + 1] += weight * colours[i, channel]


@njit(**OPTIONS)
def outside_hull(points: Any, empty: Any, numbers: Any, out: Any) -> None:
    """`silhouettes.Hull` at points (N, 3), into `out`; `numbers` are of the space: centre, half, shell, extent."""
    side, one = len(empty), np.float32(1)
    half, shell, extent = numbers[3], numbers[4], numbers[5]
    voxels = np.float32(side) / (extent + extent)
    for n in range(len(points)):
        x, y, z = (points[n, 0] - numbers[0]) / half, (points[n, 1] - numbers[1]) / half, (points[n, 2] - numbers[2]) / half
        if shell > 0:
            norm = max(max(abs(x), abs(y)), max(abs(z), one))
            factor = (one + shell - shell / norm) / norm
            x, y, z = x * factor, y * factor, z * factor
        x, y, z = (x + extent) * voxels, (y + extent) * voxels, (z + extent) * voxels
        inside = x >= 0 and y >= 0 and z >= 0 and x < side and y < side and z < side
        out[n] = empty[int(z), int(y), int(x)] if inside else True
