"""The order of a batch's rays, compiled: those that look at the same place come one after the other."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from toolkit.render import kernels as K
from toolkit.training.fused_kernels import pixel_ray

F, ZERO, ONE, TWO = K.F, K.ZERO, K.ONE, K.TWO
AHEAD = 8  # pixels for which memory is asked before they are needed


@njit(**K.OPTIONS)
def _spread_bits(value: Any) -> Any:
    """10 bits → every third bit."""
    v = np.uint32(value)
    v = (v | (v << np.uint32(16))) & np.uint32(0x030000FF)
    v = (v | (v << np.uint32(8))) & np.uint32(0x0300F00F)
    v = (v | (v << np.uint32(4))) & np.uint32(0x030C30C3)
    return (v | (v << np.uint32(2))) & np.uint32(0x09249249)


@njit(**K.OPTIONS)
def hit_codes(space: Any, pixels: Any, picks: Any, guess: Any, grid: Any, codes: Any, tiles: Any) -> None:
    """Morton codes of where rays are expected to hit: rays that look at the same place come one after the other, so that the memory
    which they share is still in the cache.

    Args:
        guess: (V · gh · gw,) float32 distances last seen from each view, in tiles of `cell` pixels; 0: unknown.
        grid: ints gh, gw, cell.
        codes: (B,) uint32 and tiles: (B,) int32, a pixel's place in `guess`: filled here.
    """
    ray = np.empty(6, np.float32)
    top = F(1023)
    high, wide, cell = np.int32(grid[0]), np.int32(grid[1]), np.int32(grid[2])
    for index in range(len(picks)):
        if index + AHEAD < len(picks):
            later = picks[index + AHEAD]
            K.prefetch(pixels.place, later)
            K.prefetch(pixels.source, later)
            K.prefetch(pixels.colour, later)
        pick = picks[index]
        pixel_ray(pixels, pick, ray)
        view, place = pixels.source[pick], pixels.place[pick]
        width = np.int32(pixels.camera[view, 4])
        row = place // width
        column = place - row * width
        tile = (view * high + row // cell) * wide + column // cell
        tiles[index] = tile
        t = guess[tile] / space.half
        x = (ray[0] - space.cx) / space.half + t * ray[3]
        y = (ray[1] - space.cy) / space.half + t * ray[4]
        z = (ray[2] - space.cz) / space.half + t * ray[5]
        n = max(max(abs(x), abs(y)), max(abs(z), ONE))
        q = (space.extent - space.shell / n) / n * (top / (TWO * space.extent))
        centre = top * K.HALF
        i = int(min(max(x * q + centre, ZERO), top))
        j = int(min(max(y * q + centre, ZERO), top))
        k = int(min(max(z * q + centre, ZERO), top))
        codes[index] = _spread_bits(i) | (_spread_bits(j) << np.uint32(1)) | (_spread_bits(k) << np.uint32(2))


@njit(**K.OPTIONS)
def remember_depths(tiles: Any, depths: Any, guess: Any) -> None:
    """Write the distances (B,) that a batch saw into `guess`, at its tiles (B,)."""
    for index in range(len(tiles)):
        if depths[index] > ZERO:
            guess[tiles[index]] = depths[index]
