"""Rays through a baked field and renders of it, compiled: straight over the quantised arrays as they lie in the file.

The march is that of `march.march_ray` (the same places, the same opacities); what differs is what it costs: a voxel's eight densities are
one read of eight bytes, and nothing is unpacked before. A render's rays are made where they are used, tile by tile.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, cast

import numpy as np
from numba import njit, types
from numba.extending import intrinsic

from fieldfuse.backends.numba import common as K
from fieldfuse.backends.numba.decode import RAYS, decode, encode_direction
from fieldfuse.backends.numba.march import block_slot, fine_length, half_way, next_step, place_at, start_ray
from fieldfuse.backends.numba.rows import add_mixed_bytes

F, ZERO, HALF, ONE = K.F, K.ZERO, K.HALF, K.ONE
LEVELS = 255  # steps of a quantised value
FINER = 16  # entries of the table of optical thickness per step: interpolated densities lie between steps
CORNERS = 9  # corners along a block's side: those on its far faces are stored with it, so that no voxel reads a second block
VX, VY, VZ, VW = range(4)  # columns of a kept sample: place in its voxel, weight
MOST_KEPT = 512  # samples of one ray that are coloured
TILE = 16  # pixels a side: rays of a tile share what they read while it is still in the cache


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
def baked_march(space: Any, baked: Any, line: Any, stop: Any, threshold: Any, starts: Any, kept_at: Any, result: Any) -> Any:
    """March one ray; the counterpart of `march.march_ray`, whose arguments it shares.

    Args:
        starts: (S, 4) int32 and kept_at: (S, 4) float32: corners, places and weights of the samples that are to be coloured.
        result: (4,) float32 distance at which half of the light is stopped (0: never), transmittance left, samples looked up, fine steps.

    Returns:
        number of kept samples.
    """
    half, fine, near = space.half, space.fine, space.near / space.half
    per_fine, finer = ONE / F(fine), F(FINER)
    kept, looked, walked = 0, 0, 0
    median = ZERO
    transmittance = ONE
    lx, ly, lz = -1, -1, -1
    slot = np.int64(-1)
    ray, step = start_ray(space, line, ZERO)
    while transmittance >= stop:
        more, step = next_step(space, baked.bricks, ray, step)
        if not more:
            break
        if step.end <= near:
            continue
        walked += fine
        length, span = fine_length(step, per_fine), step.end - step.begin
        for index in range(fine):
            x, y, z = place_at(ray, step, (F(index) + HALF) * per_fine)
            i, j, k = int(x), int(y), int(z)
            tx, ty, tz = (i >> 3) - space.ox, (j >> 3) - space.oy, (k >> 3) - space.oz
            if tx != lx or ty != ly or tz != lz:
                lx, ly, lz = tx, ty, tz
                slot = block_slot(space, baked.table, tx, ty, tz)
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
            looked += 1
            after = transmittance * F(math.exp(-baked.thickness[int(raw * finer)] * length))
            weight = transmittance - after
            if transmittance > HALF and after <= HALF:
                median = (step.begin + span * (F(index) + half_way(transmittance, after)) * per_fine) * half
            if weight > threshold and kept < starts.shape[0]:
                corner_starts(baked, slot, i8, j8, k8, starts, kept)
                for pair in range(4):
                    K.prefetch(baked.feature, np.int64(starts[kept, pair]))
                kept_at[kept, VX], kept_at[kept, VY], kept_at[kept, VZ], kept_at[kept, VW] = fx, fy, fz, weight
                kept += 1
            transmittance = after
            if transmittance < stop:
                break
    result[0], result[1], result[2], result[3] = median, transmittance, F(looked), F(walked)
    return kept


@njit(**K.LEAF)
def add_feature(width: Any, feature: Any, starts: Any, kept_at: Any, i: Any, total: Any) -> None:
    """Add the trilinear feature of kept sample `i`, in steps and times its weight, to total[:C]."""
    x, y, z, weight = kept_at[i, VX], kept_at[i, VY], kept_at[i, VZ], kept_at[i, VW]
    a, b, c = ONE - x, ONE - y, (ONE - z) * weight
    z *= weight
    weights = a * b * c, x * b * c, a * y * c, x * y * c, a * b * z, x * b * z, a * y * z, x * y * z
    add_mixed_bytes(width, total, feature, starts, i, weights)


@njit(**K.OPTIONS)
def _put(layers: Any, tape: Any, background: Any, pixels: Any, count: Any, out: Any) -> None:
    """Decode `count` rays, and put their colours where their pixels are."""
    decode(layers, tape, count)
    colour = tape.colour
    for one in range(count):
        pixel = pixels[one]
        opacity = out[pixel, 4]
        for k in range(3):
            out[pixel, k] = min(max(colour[one, k] * opacity + (ONE - opacity) * background[k], ZERO), ONE)


@njit(**K.OPTIONS)
def render_tiles(
    space: Any, baked: Any, layers: Any, background: Any, camera: Any, pose: Any, size: Any, tape: Any, tiles: Any, limits: Any, out: Any
) -> Any:
    """Pixels of some tiles of a pinhole render.

    Args:
        camera: (4,) float32 fx, fy, cx, cy; pose: (3, 4) float32 world_from_camera; size: (width, height), ints.
        tape: this thread's own `decode.Rays`.
        tiles: range of tiles, row by row, as (first, last + 1).
        limits: float32 stop, threshold: see `baked_march`.
        out: (H · W, 5) float32 colour, depth along z, opacity.

    Returns:
        samples looked up, samples coloured, fine steps.
    """
    channels = len(space.width)
    starts, kept_at = np.empty((MOST_KEPT, 4), np.int32), np.empty((MOST_KEPT, 4), np.float32)
    sums, result, pixels = np.zeros(channels, np.float32), np.empty(4, np.float32), np.empty(RAYS, np.int64)
    given, waiting = tape.given, 0
    width, height = size
    stop, threshold = limits
    across = (width + TILE - 1) // TILE
    looked, coloured, walked = 0, 0, 0
    for tile in range(tiles[0], tiles[1]):
        top, left = tile // across * TILE, tile % across * TILE
        for row in range(top, min(top + TILE, height)):
            for column in range(left, min(left + TILE, width)):
                x, y = (F(column) + HALF - camera[2]) / camera[0], (F(row) + HALF - camera[3]) / camera[1]
                dx = pose[0, 0] * x + pose[0, 1] * y + pose[0, 2]
                dy = pose[1, 0] * x + pose[1, 1] * y + pose[1, 2]
                dz = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2]
                cosine = ONE / math.sqrt(x * x + y * y + ONE)
                dx, dy, dz = dx * cosine, dy * cosine, dz * cosine
                line = pose[0, 3], pose[1, 3], pose[2, 3], dx, dy, dz
                kept = baked_march(space, baked, line, stop, threshold, starts, kept_at, result)
                looked += int(result[2])
                walked += int(result[3])
                coloured += kept
                pixel = row * width + column
                opacity = ONE - result[1]
                if result[1] < stop:
                    opacity = ONE
                out[pixel, 3], out[pixel, 4] = result[0] * cosine, opacity
                if kept == 0:
                    for k in range(3):
                        out[pixel, k] = background[k]
                    continue
                for k in range(channels):
                    sums[k] = ZERO
                total = ZERO
                for sample in range(kept):
                    add_feature(space.width, baked.feature, starts, kept_at, sample, sums)
                    total += kept_at[sample, VW]
                share = ONE / total
                for k in range(channels):
                    given[waiting, k] = baked.low[k] + baked.scale[k] * (sums[k] * share)
                encode_direction(dx, dy, dz, given, waiting, channels)
                pixels[waiting] = pixel
                waiting += 1
                if waiting == RAYS:
                    _put(layers, tape, background, pixels, waiting, out)
                    waiting = 0
    _put(layers, tape, background, pixels, waiting, out)
    return looked, coloured, walked
