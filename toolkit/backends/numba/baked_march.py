"""A ray through a baked field, compiled: straight over the quantised arrays as they lie in the file.

The march is that of `march.march_ray` (the same places, the same opacities); what differs is what it costs: a voxel's eight densities are
one read of eight bytes, and nothing is unpacked before.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, cast

import numpy as np
from numba import njit, types
from numba.extending import intrinsic

from fieldfuse.backends.numba import common as K
from fieldfuse.backends.numba.march import brick_distance

F, ZERO, HALF, ONE, TWO = K.F, K.ZERO, K.HALF, K.ONE, K.TWO
LEVELS = 255  # steps of a quantised value
FINER = 16  # entries of the table of optical thickness per step: interpolated densities lie between steps
CORNERS = 9  # corners along a block's side: those on its far faces are stored with it, so that no voxel asks a second block
VX, VY, VZ, VW = range(4)  # columns of a kept sample: place in its voxel, weight


@cast(Any, intrinsic)
def ones(context: Any, value: Any) -> Any:
    """Number of bits set in a uint64."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.ctpop(arguments[0])

    return types.uint64(types.uint64), generate


class Baked(NamedTuple):
    """A baked field's arrays. V: occupied voxels, R: stored corners, M: blocks that hold an occupied voxel."""

    table: Any  # (Sz, Sy, Sx) int32 slot or −1
    bricks: Any  # (B, B, B) uint8 distance in bricks to the nearest occupied one, with a margin of one
    bits: Any  # (M, 8) uint64 occupancy, one word a z-slice
    first: Any  # (M, 8) int32 number of occupied voxels before the z-slice
    packed: Any  # (V,) uint64: eight quantised raw densities, corner 0 in the lowest byte, x fastest
    rows: Any  # (M, 81) int32 corner row z · 9 + y: 9 bits say which corners are stored, above them how many are before in the block
    base: Any  # (M,) int32 stored corners before the block
    feature: Any  # (R, C) uint8
    thickness: Any  # (LEVELS · FINER + 1,) float32 σ of a quantised raw density
    scale: Any  # (C,) float32: feature = low + scale · value
    low: Any


@njit(**K.LEAF)
def corner_starts(baked: Any, slot: Any, x: Any, y: Any, z: Any, starts: Any, kept: Any) -> None:
    """Stored corners at (x, y | y + 1, z | z + 1) of a block into starts[kept, 0 … 3]; the one at x + 1 follows each.

    Here and below rows are never taken as arrays of their own: numba counts their references, in an atomic operation each, which costs as
    much as the features themselves and makes threads wait for each other.
    """
    below = (1 << x) - 1
    for pair in range(4):
        row = int(baked.rows[slot, (z + (pair >> 1)) * CORNERS + y + (pair & 1)])
        starts[kept, pair] = np.int32(baked.base[slot] + (row >> CORNERS) + int(ones(np.uint64(row & below))))


@njit(**K.LEAF)
def packed_density(packed: Any, x: Any, y: Any, z: Any) -> Any:
    """Trilinear quantised raw density of a voxel, in steps."""
    low, high = np.uint32(packed & np.uint64(0xFFFFFFFF)), np.uint32(packed >> np.uint64(32))
    byte = np.uint32(255)
    p0, q0 = F(np.int32(low & byte)), F(np.int32((low >> np.uint32(8)) & byte))
    p1, q1 = F(np.int32((low >> np.uint32(16)) & byte)), F(np.int32(low >> np.uint32(24)))
    p2, q2 = F(np.int32(high & byte)), F(np.int32((high >> np.uint32(8)) & byte))
    p3, q3 = F(np.int32((high >> np.uint32(16)) & byte)), F(np.int32(high >> np.uint32(24)))
    p0 += x * (q0 - p0)
    p1 += x * (q1 - p1)
    p2 += x * (q2 - p2)
    p3 += x * (q3 - p3)
    p0 += y * (p1 - p0)
    p2 += y * (p3 - p2)
    return p0 + z * (p2 - p0)


@njit(**K.LEAF)
def baked_march(
    space: Any,
    baked: Any,
    ox: Any,
    oy: Any,
    oz: Any,
    dx: Any,
    dy: Any,
    dz: Any,
    stop: Any,
    threshold: Any,
    starts: Any,
    kept_at: Any,
    result: Any,
) -> Any:
    """March one ray (working frame, unit direction); the counterpart of `march.march_ray`, whose arguments it shares.

    Args:
        starts: (S, 4) int32 and kept_at: (S, 4) float32: corners, places and weights of the samples that are to be coloured.
        result: (4,) float32 distance at which half of the light is stopped (0: never), transmittance left, samples looked up, fine steps.

    Returns:
        number of kept samples.
    """
    half, extent, shell = space.half, space.extent, space.shell
    ox, oy, oz = (ox - space.cx) / half, (oy - space.cy) / half, (oz - space.cz) / half
    fine = space.fine
    step = space.voxel * F(4)
    per_fine = ONE / F(fine)
    per_voxel = ONE / space.voxel
    per_brick = per_voxel * F(0.25)
    near = space.near / half
    s = near
    leave = F(3e38)
    rise = ZERO
    if shell == ZERO:
        enter = near
        for axis in range(3):
            o, d, b = (ox, dx, space.bx) if axis == 0 else (oy, dy, space.by) if axis == 1 else (oz, dz, space.bz)
            if abs(d) < F(1e-9):
                d = F(1e-9)
            low, high = (-b - o) / d, (b - o) / d
            enter, leave = max(enter, min(low, high)), min(leave, max(low, high))
        s = enter
    else:
        along = ox * dx + oy * dy + oz * dz
        px, py, pz = ox - along * dx, oy - along * dy, oz - along * dz
        rise = ONE / math.sqrt(shell * shell + extent * extent * (px * px + py * py + pz * pz))
    far = shell / space.voxel
    kept, looked, walked = 0, 0, 0
    median = ZERO
    transmittance = ONE
    table = baked.table
    most = F(space.resolution) - F(1e-3)
    finer = F(FINER)
    lx, ly, lz = -1, -1, -1
    slot = -1
    known = False
    p0x, p0y, p0z = ZERO, ZERO, ZERO
    for _ in range(int(F(14) * extent / step) + 32):
        if shell == ZERO:
            if s >= leave:
                break
            s1 = min(s + step, leave)
            yx, yy, yz = ox + s * dx, oy + s * dy, oz + s * dz
            n = ONE
        else:
            yx, yy, yz = ox + s * dx, oy + s * dy, oz + s * dz
            n = max(max(abs(yx), abs(yy)), max(abs(yz), ONE))
            if n > far:
                break
            s1 = s + step * min(max(n * n * rise, ONE), K.STRETCH)
        if not known:
            q = ONE
            if n > ONE:
                q = (extent - shell / n) / n
            p0x, p0y, p0z = yx * q + extent, yy * q + extent, yz * q + extent
        yx, yy, yz = ox + s1 * dx, oy + s1 * dy, oz + s1 * dz
        n1 = ONE
        if shell != ZERO:
            n1 = max(max(abs(yx), abs(yy)), max(abs(yz), ONE))
        q = ONE
        if n1 > ONE:
            q = (extent - shell / n1) / n1
        p1x, p1y, p1z = yx * q + extent, yy * q + extent, yz * q + extent
        gap = brick_distance(baked.bricks, HALF * (p0x + p1x), HALF * (p0y + p1y), HALF * (p0z + p1z), per_brick)
        if gap > 1:
            known = gap == 2
            p0x, p0y, p0z = p1x, p1y, p1z
            s = s1
            if gap > 2:
                if shell == ZERO:
                    s = s1 + F(gap - 2) * step
                else:
                    for _skip in range(gap - 2):
                        yx, yy, yz = ox + s * dx, oy + s * dy, oz + s * dz
                        n = max(max(abs(yx), abs(yy)), max(abs(yz), ONE))
                        s += step * min(max(n * n * rise, ONE), K.STRETCH)
            continue
        if s1 > near:
            cx, cy, cz = p1x - p0x, p1y - p0y, p1z - p0z
            length = math.sqrt(cx * cx + cy * cy + cz * cz) * per_fine
            walked += fine
            for index in range(fine):
                where = (F(index) + HALF) * per_fine
                x = min(max((p0x + cx * where) * per_voxel, ZERO), most)
                y = min(max((p0y + cy * where) * per_voxel, ZERO), most)
                z = min(max((p0z + cz * where) * per_voxel, ZERO), most)
                i, j, k = int(x), int(y), int(z)
                tx, ty, tz = (i >> 3) - space.ox, (j >> 3) - space.oy, (k >> 3) - space.oz
                if tx != lx or ty != ly or tz != lz:
                    lx, ly, lz = tx, ty, tz
                    slot = -1
                    if 0 <= tx < table.shape[2] and 0 <= ty < table.shape[1] and 0 <= tz < table.shape[0]:
                        slot = table[tz, ty, tx]
                if slot < 0:
                    continue
                i8, j8, k8 = i & 7, j & 7, k & 7
                word = baked.bits[slot, k8]
                bit = np.uint64(1) << np.uint64(j8 * 8 + i8)
                if word & bit == 0:
                    continue
                fx, fy, fz = x - F(i), y - F(j), z - F(k)
                voxel = baked.first[slot, k8] + int(ones(word & (bit - np.uint64(1))))
                raw = packed_density(baked.packed[voxel], fx, fy, fz)
                tau = baked.thickness[int(raw * finer)] * length
                looked += 1
                after = transmittance * F(math.exp(-tau))
                weight = transmittance - after
                if transmittance > HALF and after <= HALF:
                    part = (transmittance - HALF) / (transmittance - after)
                    median = (s + (s1 - s) * (F(index) + part) * per_fine) * half
                if weight > threshold and kept < starts.shape[0]:
                    corner_starts(baked, slot, i8, j8, k8, starts, kept)
                    for pair in range(4):
                        K.prefetch(baked.feature, np.int64(starts[kept, pair]))
                    kept_at[kept, VX], kept_at[kept, VY], kept_at[kept, VZ], kept_at[kept, VW] = fx, fy, fz, weight
                    kept += 1
                transmittance = after
                if transmittance < stop:
                    break
            if transmittance < stop:
                break
        known = True
        p0x, p0y, p0z = p1x, p1y, p1z
        s = s1
    result[0], result[1], result[2], result[3] = median, transmittance, F(looked), F(walked)
    return kept
