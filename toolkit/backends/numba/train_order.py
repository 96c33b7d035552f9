"""The order of a batch's rays, compiled: those that look at the same place come one after the other, and threads get equal work."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from fieldfuse.backends.constants import KEEP as KEEP_
from fieldfuse.backends.constants import RENEW
from fieldfuse.backends.numba import common as K
from fieldfuse.backends.numba import train_draw
from fieldfuse.backends.numba.train_common import ask_for, pixel_ray

Array = np.ndarray[Any, Any]
F, ZERO, ONE, TWO = K.F, K.ZERO, K.ONE, K.TWO
RAY_WORK = F(7)  # what a ray costs beside its samples and coarse steps, in samples
KEEP = F(KEEP_)
AHEAD = 8  # pixels for which memory is asked before they are needed


@njit(**K.LEAF)
def _spread_bits(value: Any) -> Any:
    """10 bits → every third bit."""
    v = np.uint32(value)
    v = (v | (v << np.uint32(16))) & np.uint32(0x030000FF)
    v = (v | (v << np.uint32(8))) & np.uint32(0x0300F00F)
    v = (v | (v << np.uint32(4))) & np.uint32(0x030C30C3)
    return (v | (v << np.uint32(2))) & np.uint32(0x09249249)


@njit(**K.OPTIONS)
def hit_codes(space: Any, pixels: Any, picks: Any, memory: Any, grid: Any, codes: Any, tiles: Any) -> None:
    """Morton codes of where rays are expected to hit: rays that look at the same place come one after the other, so that the memory
    which they share is still in the cache.

    Args:
        memory, grid: of `Tiles`.
        codes: (B,) uint32 and tiles: (B,) int32, a pixel's place in `memory`: filled here.
    """
    ray = np.empty((1, 6), np.float32)
    top = F(1023)
    high, wide = grid
    for index in range(len(picks)):
        if index + AHEAD < len(picks):
            ask_for(pixels, picks[index + AHEAD])
        pick = picks[index]
        pixel_ray(pixels, pick, ray, K.START)
        tile = train_draw.tile_of(pixels, pick, high, wide)
        tiles[index] = tile
        t = memory[tile, 0] / space.half
        x = (ray[0, 0] - space.cx) / space.half + t * ray[0, 3]
        y = (ray[0, 1] - space.cy) / space.half + t * ray[0, 4]
        z = (ray[0, 2] - space.cz) / space.half + t * ray[0, 5]
        n = max(max(abs(x), abs(y)), max(abs(z), ONE))
        q = (space.extent - space.shell / n) / n * (top / (TWO * space.extent))
        centre = top * K.HALF
        i = int(min(max(x * q + centre, ZERO), top))
        j = int(min(max(y * q + centre, ZERO), top))
        k = int(min(max(z * q + centre, ZERO), top))
        codes[index] = _spread_bits(i) | (_spread_bits(j) << np.uint32(1)) | (_spread_bits(k) << np.uint32(2))


@njit(**K.OPTIONS)
def _remember(tiles: Any, met: Any, memory: Any, error: Any) -> None:
    """Write what a batch met (B, 3) into `memory` and `error`, at its tiles (B,)."""
    for index in range(len(tiles)):
        if met[index, 0] > ZERO:
            memory[tiles[index], 0] = met[index, 0]
        memory[tiles[index], 1] = met[index, 1]
        old = error[tiles[index]]
        error[tiles[index]] = KEEP * old + (ONE - KEEP) * met[index, 2] if old > ZERO else met[index, 2]


@njit(**K.OPTIONS)
def share(tiles: Any, memory: Any, cuts: Any) -> None:
    """Places cuts[1 : -1] where the rays of `tiles` (B,) fall into parts of equal expected work."""
    total = ZERO
    for index in range(len(tiles)):
        total += RAY_WORK + memory[tiles[index], 1]
    parts = len(cuts) - 1
    done, part = ZERO, 1
    for index in range(len(tiles)):
        while part < parts and done * F(parts) >= total * F(part):
            cuts[part] = index
            part += 1
        done += RAY_WORK + memory[tiles[index], 1]
    while part < parts:
        cuts[part] = len(tiles)
        part += 1


class Tiles:
    """What rays from each tile of a training picture met last, and pixels drawn by it.

    Attributes:
        grid: rows and columns of tiles of the largest picture.
        met: (V · rows · columns, 2) float32 distance where half of the light was stopped (0: unknown), and work.
        error: (V · rows · columns,) float32 squared error of late (0: no ray yet); density: how often pixels are drawn, see `importance`.
    """

    def __init__(self, views: int, grid: tuple[int, int]) -> None:
        self.grid = grid
        count = views * grid[0] * grid[1]
        self.met = np.zeros((count, 2), np.float32)
        self.error, self.density = np.zeros(count, np.float32), np.ones(count, np.float32)
        self.steps = 0

    def draw(self, pixels: Any, limit: int, seed: int, picks: Array, weights: Array) -> None:
        """Fill `picks` (B,) int64 with pixels before `limit`, and `weights` (B,) float32 with what each of them counts."""
        if not 0 < limit <= len(pixels.colour):  # compiled code looks where it is told to
            raise ValueError(f"pixels are to be drawn from the first {limit} of {len(pixels.colour)}")
        train_draw.draw(pixels, limit, seed, self.density, *self.grid, picks, weights)

    def renew(self) -> None:
        """Renew the densities from the errors, now and then; called once a step."""
        if self.steps % RENEW == 0:
            train_draw.densities(self.error, self.density)
        self.steps += 1

    def remember(self, tiles: Array, met: Array) -> None:
        """What a batch met (B, 3) at its tiles (B,)."""
        _remember(tiles, met, self.met, self.error)


class Batch:
    """Rays of one step, and the order that they are worked on in.

    To find the order would take two threads a twentieth of a step, one of them waiting; so it is found beside the step before: `look`
    by every thread for its part, which is drawn there as well, and `sort` by one of them.

    Attributes:
        picks: (B,) int64 pixels; jitter: (B,) float32 by which the rays' lattices are moved; weights: (B,) float32 what they count.
        limit: pixels that `picks` are drawn from; seed: of the draw, None: the picks are given.
        tiles: (B,) int32 places in `Tiles.met`.
        cuts: (threads + 1,) int64 where each thread's part begins and ends: equal numbers as drawn, equal expected work once sorted.
    """

    def __init__(self, picks: Array, jitter: Array, weights: Array, threads: int, limit: int = 0, seed: int | None = None) -> None:
        count = len(picks)
        self.picks, self.jitter, self.weights, self.limit, self.seed = picks, jitter, weights, limit, seed
        self.codes, self.tiles = np.empty(count, np.uint32), np.empty(count, np.int32)
        self.cuts = np.array([count * t // threads for t in range(threads + 1)], np.int64)
        self.sorted = False

    def part(self, thread: int) -> slice:
        """The rays of one thread."""
        return slice(int(self.cuts[thread]), int(self.cuts[thread + 1]))

    def look(self, thread: int, space: Any, pixels: Any, tiles: Tiles) -> None:
        """Codes and tiles of one thread's part, which is drawn first."""
        part = self.part(thread)
        if self.seed is not None:
            tiles.draw(pixels, self.limit, self.seed + thread, self.picks[part], self.weights[part])
        hit_codes(space, pixels, self.picks[part], tiles.met, tiles.grid, self.codes[part], self.tiles[part])

    def sort(self, tiles: Tiles) -> None:
        """Once all threads have looked."""
        order = np.argsort(self.codes)
        self.picks, self.jitter, self.weights, self.tiles = (of[order] for of in (self.picks, self.jitter, self.weights, self.tiles))
        share(self.tiles, tiles.met, self.cuts)
        self.sorted = True
