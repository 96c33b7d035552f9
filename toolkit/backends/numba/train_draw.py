"""Pixels drawn by the errors of their tiles, compiled: the twin of `training/importance.py`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from fieldfuse.backends.constants import MOST as MOST_
from fieldfuse.backends.constants import SHARE as SHARE_
from fieldfuse.backends.constants import TILE as TILE_
from fieldfuse.backends.constants import TOP as TOP_
from fieldfuse.backends.numba import common as K
from fieldfuse.backends.numba.train_common import seen_at

F, ZERO, ONE = K.F, K.ZERO, K.ONE
SHARE, MOST, TOP = F(SHARE_), F(MOST_), F(TOP_)
CELL = np.int32(TILE_)
AHEAD = 32  # candidates on their way: memory is slow, so it is asked for early, first for the pixel, half a round later for its tile
LOW = np.uint64(0xFFFFFFFF)


@njit(**K.LEAF)
def tile_of(pixels: Any, pick: Any, high: Any, wide: Any) -> Any:
    """The tile of pixel `pick`."""
    view, row, column = seen_at(pixels, pick)
    return (view * high + row // CELL) * wide + column // CELL


@njit(**K.OPTIONS)
def densities(error: Any, out: Any) -> None:
    """`importance.densities`: (T,) float32 errors → out (T,) float32."""
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
    candidates, tiles, luck = np.empty(AHEAD, np.int64), np.empty(AHEAD, np.int64), np.empty(AHEAD, np.float32)
    state = np.uint64(seed)
    found, number = 0, 0
    while found < len(picks):
        at = number % AHEAD
        if number >= AHEAD:
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
        half = (number + AHEAD // 2) % AHEAD
        if number >= AHEAD // 2:
            tiles[half] = tile_of(pixels, candidates[half], high, wide)
            K.prefetch(density, tiles[half])
        number += 1
