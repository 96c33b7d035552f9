"""Pictures of a baked field, compiled: rays made where they are used, tile by tile, marched, coloured and decoded."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from fieldfuse.backends.numba import common as K
from fieldfuse.backends.numba.baked_march import VW, VX, VY, VZ, baked_march
from fieldfuse.backends.numba.decode import RAYS, decode, encode_direction
from fieldfuse.backends.numba.rows import add_mixed_bytes

F, ZERO, HALF, ONE = K.F, K.ZERO, K.HALF, K.ONE
MOST_KEPT = 512  # samples of one ray that are coloured
TILE = 16  # pixels a side: rays of a tile share what they read while it is still in the cache


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
    """Pixels of some tiles of a pinhole picture.

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
    ox, oy, oz = pose[0, 3], pose[1, 3], pose[2, 3]
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
                kept = baked_march(space, baked, ox, oy, oz, dx, dy, dz, stop, threshold, starts, kept_at, result)
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
