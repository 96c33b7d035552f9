"""The rays of a training step, compiled: training pixels, which of them are drawn, the order they are worked on in, and loss terms.

Pixels are drawn by the errors of their tiles (`training.pixels`). Rays that look at the same place come one after the other, so that the
memory which they share is still in the cache, and threads get equal work.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numba import njit

from fieldfuse.backends import constants
from fieldfuse.backends.numba import common as K

if TYPE_CHECKING:
    from fieldfuse.training.pixels import PixelPool

Array = np.ndarray[Any, Any]
F, ZERO, ONE, TWO = K.F, K.ZERO, K.ONE, K.TWO
REACH, KEEP = F(constants.REACH), F(constants.KEEP)
SHARE, MOST, TOP = F(constants.SHARE), F(constants.MOST), F(constants.TOP)
CELL = np.int32(constants.TILE)
GUESS = 12  # bits: of so many pixels the first one's view is stored
AHEAD = 8  # pixels whose memory is prefetched before they are needed
CANDIDATES = 32  # pixels on their way while they are drawn: first the pixel is prefetched, half a round later its tile
RAY_WORK = F(7)  # what a ray costs beside its samples and coarse steps, in samples
LOW = np.uint64(0xFFFFFFFF)


class Pixels(NamedTuple):
    """The training pixels: see `pixels.PixelPool`."""

    colour: Any  # (N, 3) uint8
    places: Any  # (N,) int32 in their images; of length 0 where all pixels of all views are there
    starts: Any  # (V + 1,) int64 first pixel of each view
    first_view: Any  # (N >> GUESS,) int32 view of every 2^GUESS-th pixel
    camera: Any  # (V, 5) float32 fx, fy, cx, cy, width
    pose: Any  # (V, 4, 4) float32
    distance: Any  # (N,) float32 to the surface along the ray, 0: unknown; or of length 0


class Losses(NamedTuple):
    """Weights of a step's losses, float32."""

    distortion: Any
    opacity: Any
    depth: Any
    depth_noise: Any
    threshold: Any
    stop: Any
    slow_within: Any  # working units; gradients of samples nearer than this are scaled down, 0: none


class Part(NamedTuple):
    """One thread's part of a batch of rays."""

    picks: Any  # (B,) int64 pixels
    jitter: Any  # (B,) float32
    shares: Any  # (B,) float32 what each ray counts in the means over the whole batch
    met: Any  # (B, 3) float32, filled: distance where half of the light was stopped, work in samples, squared colour error


class Sums(NamedTuple):
    """Gradients of lattice corners, summed over one thread's part of a batch."""

    touched: Any  # (T,) int32 rows
    density: Any  # (T,) float32, in the order of `touched`
    feature: Any  # (T, C) float32
    index: Any  # (M · 512 + 1, threads + 1) int32; column `column`, less `base`, is a row's place here; negative: not touched
    column: Any  # int
    base: Any  # int64, which each batch moves past what the ones before wrote, so that nothing has to be wiped


def pixels_of(pool: PixelPool) -> Pixels:
    """What compiled code needs of a pool on the CPU, without a copy."""
    starts, count = pool.starts.numpy(), len(pool)
    first_view = np.searchsorted(starts[1:], np.arange(0, count, 1 << GUESS), side="right").astype(np.int32)
    camera, pose, distance = (of.numpy() for of in (pool.camera, pool.pose, pool.distance))
    return Pixels(pool.colour.numpy(), pool.places.numpy(), starts, first_view, camera, pose, distance)


@njit(**K.LEAF)
def seen_at(pixels: Any, pick: Any) -> Any:
    """Pixel → its view, row and column."""
    view = np.int64(pixels.first_view[pick >> GUESS])
    while pick >= pixels.starts[view + 1]:
        view += 1
    place = np.int32(pick - pixels.starts[view]) if pixels.places.shape[0] == 0 else pixels.places[pick]
    width = np.int32(pixels.camera[view, 4])
    row = place // width
    return view, row, place - row * width


@njit(**K.LEAF)
def prefetch_pixel(pixels: Any, pick: Any) -> None:
    """Prefetch the memory of a pixel that will be needed soon."""
    K.prefetch(pixels.colour, pick)
    if pixels.places.shape[0] > 0:
        K.prefetch(pixels.places, pick)
    if pixels.distance.shape[0] > 0:
        K.prefetch(pixels.distance, pick)


@njit(**K.LEAF)
def pixel_ray(pixels: Any, pick: Any) -> Any:
    """Origin (working frame) and unit direction of pixel `pick`: six numbers."""
    view, row, column = seen_at(pixels, pick)
    camera, pose = pixels.camera, pixels.pose
    x = (F(column) + K.HALF - camera[view, 2]) / camera[view, 0]
    y = (F(row) + K.HALF - camera[view, 3]) / camera[view, 1]
    dx = pose[view, 0, 0] * x + pose[view, 0, 1] * y + pose[view, 0, 2]
    dy = pose[view, 1, 0] * x + pose[view, 1, 1] * y + pose[view, 1, 2]
    dz = pose[view, 2, 0] * x + pose[view, 2, 1] * y + pose[view, 2, 2]
    scale = ONE / np.sqrt(dx * dx + dy * dy + dz * dz)
    return pose[view, 0, 3], pose[view, 1, 3], pose[view, 2, 3], dx * scale, dy * scale, dz * scale


@njit(**K.LEAF)
def depth_pull(along: Any, distance: Any, noise: Any) -> Any:
    """`losses.depth_gradient` of one sample."""
    if distance <= ZERO:
        return ZERO
    return min(max(abs(along - distance) / distance - noise, ZERO) / REACH, ONE) - ONE


@njit(**K.LEAF)
def near_scale(along: Any, within: Any) -> Any:
    """`losses.near_gradient_scaling` of one sample."""
    share = max(along, ZERO) / within if along < within and within > ZERO else ONE  # a sample may lie behind its camera
    return share * share


@njit(**K.INLINE)
def add_ray_terms(
    space: Any, values: Any, first: Any, last: Any, totals: Any, share: Any, distance: Any, losses: Any, g_weight: Any
) -> None:
    """Add the gradients of a ray's distortion and depth term to those for the weights of its samples, g_weight[first : last].

    Args:
        totals: sums of the samples' weights, and of the weights times their places.
    """
    spread = F(4) / (F(space.fine) * F(space.resolution))
    distortion, depth_loss = losses.distortion * share, losses.depth * share
    total, total_place = totals
    before, before_place = ZERO, ZERO
    for i in range(first, last):
        weight, place = values[i, K.WEIGHT], values[i, K.PLACE]
        after, after_place = total - before - weight, total_place - before_place - weight * place
        pull = place * (before - after) - (before_place - after_place)
        depth = depth_loss * depth_pull(values[i, K.ALONG], distance, losses.depth_noise)
        g_weight[i] += depth + TWO * distortion * (pull + weight * spread * K.THIRD)
        before += weight
        before_place += weight * place


@njit(**K.LEAF)
def tile_of(pixels: Any, pick: Any, high: Any, wide: Any) -> Any:
    """The tile of pixel `pick`."""
    view, row, column = seen_at(pixels, pick)
    return (view * high + row // CELL) * wide + column // CELL


@njit(**K.OPTIONS)
def densities(error: Any, out: Any) -> None:
    """`pixels.densities`: (T,) float32 errors → out (T,) float32."""
    total, known = 0.0, 0
    for tile in range(len(error)):
        if error[tile] > ZERO:
            total += np.sqrt(error[tile])
            known += 1
    mean = F(max(total / max(known, 1), 1e-12))
    for tile in range(len(error)):
        ratio = min(np.sqrt(error[tile]) / mean, MOST) if error[tile] > ZERO else ONE
        out[tile] = ONE - SHARE + SHARE * ratio


@njit(**K.LEAF)
def _mixed(state: Any) -> Any:
    """64 bits that look random, of a counter (splitmix64)."""
    z = state
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@njit(**K.OPTIONS)
def draw(pixels: Any, limit: Any, seed: Any, density: Any, high: Any, wide: Any, picks: Any, weights: Any) -> None:
    """Fill `picks` (B,) int64 with pixels before `limit` (at most 2³²), and `weights` (B,) float32 with what each of them counts."""
    candidates, tiles, luck = np.empty(CANDIDATES, np.int64), np.empty(CANDIDATES, np.int64), np.empty(CANDIDATES, np.float32)
    state = np.uint64(seed)
    found, number = 0, 0
    while found < len(picks):
        at = number % CANDIDATES
        if number >= CANDIDATES:
            q = density[tiles[at]]
            if luck[at] * TOP < q:
                picks[found] = candidates[at]
                weights[found] = ONE / q
                found += 1
        state += np.uint64(0x9E3779B97F4A7C15)
        bits = _mixed(state)
        candidates[at] = np.int64(((bits >> np.uint64(32)) * np.uint64(limit)) >> np.uint64(32))
        luck[at] = F((bits & LOW) >> np.uint64(8)) * F(1 / 16777216)
        if pixels.places.shape[0] > 0:
            K.prefetch(pixels.places, candidates[at])
        half = (number + CANDIDATES // 2) % CANDIDATES
        if number >= CANDIDATES // 2:
            tiles[half] = tile_of(pixels, candidates[half], high, wide)
            K.prefetch(density, tiles[half])
        number += 1


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
    """Morton codes of where rays are expected to hit.

    Args:
        memory, grid: of `Tiles`.
        codes: (B,) uint32 and tiles: (B,) int32, a pixel's place in `memory`: filled here.
    """
    top = F(1023)
    high, wide = grid
    for index in range(len(picks)):
        if index + AHEAD < len(picks):
            prefetch_pixel(pixels, picks[index + AHEAD])
        pick = picks[index]
        ox, oy, oz, dx, dy, dz = pixel_ray(pixels, pick)
        tile = tile_of(pixels, pick, high, wide)
        tiles[index] = tile
        t = memory[tile, 0] / space.half
        x = (ox - space.cx) / space.half + t * dx
        y = (oy - space.cy) / space.half + t * dy
        z = (oz - space.cz) / space.half + t * dz
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
def split_work(tiles: Any, memory: Any, cuts: Any) -> None:
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
    """What rays from each tile of a training image met last, and pixels drawn by it.

    Attributes:
        grid: rows and columns of tiles of the largest image.
        met: (V · rows · columns, 2) float32 distance where half of the light was stopped (0: unknown), and work.
        error: (V · rows · columns,) float32 squared error of late (0: no ray yet).
        density: how often pixels are drawn, see `training.pixels`.
    """

    def __init__(self, views: int, grid: tuple[int, int]) -> None:
        self.grid = grid
        count = views * grid[0] * grid[1]
        self.met = np.zeros((count, 2), np.float32)
        self.error, self.density = np.zeros(count, np.float32), np.ones(count, np.float32)
        self.steps = 0

    def draw(self, pixels: Any, limit: int, seed: int, picks: Array, weights: Array) -> None:
        """Fill `picks` (B,) int64 with pixels before `limit`, and `weights` (B,) float32 with what each of them counts."""
        if not 0 < limit <= len(pixels.colour):  # compiled code checks no bounds
            raise ValueError(f"pixels are to be drawn from the first {limit} of {len(pixels.colour)}")
        draw(pixels, limit, seed, self.density, *self.grid, picks, weights)

    def renew(self) -> None:
        """Renew the densities from the errors, now and then; called once a step."""
        if self.steps % constants.RENEW == 0:
            densities(self.error, self.density)
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
        split_work(self.tiles, tiles.met, self.cuts)
        self.sorted = True
