"""The draw of a step's pixels on CUDA, by the errors of their tiles, and their rays. `training/pixels.py` is the reference."""

from __future__ import annotations

import triton
import triton.language as tl

from fieldfuse.backends.constants import SH, TILE, TOP
from fieldfuse.backends.triton.march import C_BEHIND, C_COUNTS, C_JITTER, C_RED, C_TARGET

TRIES = 24  # evenly drawn pixels, of which the first that luck takes is looked at; one of 3·10⁴ rays takes its last one
S0, S1, S2, S3, S4, S5, S6, S7, S8, S9 = (tl.constexpr(v) for v in SH)
C_TOP, C_TILE, C_TRIES = (tl.constexpr(v) for v in (TOP, TILE, TRIES))


@triton.jit
def _harmonics(inputs, at, x, y, z, mask):
    """`encoding.spherical_harmonics` of unit vectors, into 16 columns."""
    tl.store(inputs + at, x * 0 + S0, mask=mask)
    tl.store(inputs + at + 1, -y * S1, mask=mask)
    tl.store(inputs + at + 2, z * S1, mask=mask)
    tl.store(inputs + at + 3, -x * S1, mask=mask)
    tl.store(inputs + at + 4, x * y * S2, mask=mask)
    tl.store(inputs + at + 5, -y * z * S2, mask=mask)
    tl.store(inputs + at + 6, (3 * z * z - 1) * S3, mask=mask)
    tl.store(inputs + at + 7, -x * z * S2, mask=mask)
    tl.store(inputs + at + 8, (x * x - y * y) * S4, mask=mask)
    tl.store(inputs + at + 9, -y * (3 * x * x - y * y) * S5, mask=mask)
    tl.store(inputs + at + 10, x * y * z * S6, mask=mask)
    tl.store(inputs + at + 11, -y * (5 * z * z - 1) * S7, mask=mask)
    tl.store(inputs + at + 12, z * (5 * z * z - 3) * S8, mask=mask)
    tl.store(inputs + at + 13, -x * (5 * z * z - 1) * S7, mask=mask)
    tl.store(inputs + at + 14, z * (x * x - y * y) * S9, mask=mask)
    tl.store(inputs + at + 15, -x * (x * x - 3 * y * y) * S5, mask=mask)


@triton.jit
def _seen_at(starts, places, camera, pick, views, SOME: tl.constexpr, mask):
    """View, row and column of pixels (`PixelPool.seen_at`)."""
    low, high = pick * 0, pick * 0 + views
    while tl.max(high - low, 0) > 1:
        middle = (low + high) >> 1
        before = tl.load(starts + middle, mask=mask, other=0).to(tl.int32) <= pick
        low, high = tl.where(before, middle, low), tl.where(before, high, middle)
    place = pick - tl.load(starts + low, mask=mask, other=0).to(tl.int32)
    if SOME:
        place = tl.load(places + pick, mask=mask, other=0)
    wide = tl.load(camera + low * 5 + 4, mask=mask, other=1.0).to(tl.int32)
    return low, place // wide, place % wide


@triton.jit(do_not_specialize=["count", "stride", "columns", "channels", "views", "tiles_high", "tiles_wide", "seed"])
def draw(
    rays, tiles, inputs, state,
    colour, places, starts, distance, camera, pose, densities, background, limit,
    count, stride, columns, channels, views, tiles_high, tiles_wide, seed,
    SOME: tl.constexpr, KNOWN: tl.constexpr, B: tl.constexpr,
):  # fmt: skip
    """Draw pixels by the errors of their tiles, and make their rays; harmonics of directions go into `inputs` behind `channels` columns."""
    ray = tl.program_id(0) * B + tl.arange(0, B)
    on = ray < count
    key, number = seed + tl.load(state).to(tl.int32), ray * 64  # of random numbers: no step and no ray takes one twice
    pick, tile = ray * 0, ray * 0
    view, row, column = ray * 0, ray * 0, ray * 0
    many = tl.load(limit).to(tl.uint64)
    missing, trial = on, 0
    density = tl.full([B], 1.0, tl.float32)
    while (tl.max(missing.to(tl.int32), 0) > 0) & (trial < C_TRIES):
        chance = tl.randint(key, number + 2 * trial).to(tl.uint32, bitcast=True).to(tl.uint64)
        candidate = ((chance * many) >> 32).to(tl.int32)
        v, r, c = _seen_at(starts, places, camera, candidate, views, SOME, missing)
        where = (v * tiles_high + r // C_TILE) * tiles_wide + c // C_TILE
        q = tl.load(densities + where, mask=missing, other=1.0)
        pick, tile, view = tl.where(missing, candidate, pick), tl.where(missing, where, tile), tl.where(missing, v, view)
        row, column, density = tl.where(missing, r, row), tl.where(missing, c, column), tl.where(missing, q, density)
        missing = missing & (tl.rand(key, number + 2 * trial + 1) * C_TOP >= q)
        trial += 1
    fx, fy = tl.load(camera + view * 5, mask=on, other=1.0), tl.load(camera + view * 5 + 1, mask=on, other=1.0)
    cx, cy = tl.load(camera + view * 5 + 2, mask=on, other=0.0), tl.load(camera + view * 5 + 3, mask=on, other=0.0)
    u, v = (column.to(tl.float32) + 0.5 - cx) / fx, (row.to(tl.float32) + 0.5 - cy) / fy
    to = pose + view * 16
    x = tl.load(to, mask=on, other=0.0) * u + tl.load(to + 1, mask=on, other=0.0) * v + tl.load(to + 2, mask=on, other=0.0)
    y = tl.load(to + 4, mask=on, other=0.0) * u + tl.load(to + 5, mask=on, other=0.0) * v + tl.load(to + 6, mask=on, other=0.0)
    z = tl.load(to + 8, mask=on, other=0.0) * u + tl.load(to + 9, mask=on, other=0.0) * v + tl.load(to + 10, mask=on, other=1.0)
    length = 1 / tl.sqrt(x * x + y * y + z * z)
    x, y, z = x * length, y * length, z * length
    tl.store(tiles + ray, tile, mask=on)
    tl.store(rays + ray, tl.load(to + 3, mask=on, other=0.0), mask=on)
    tl.store(rays + stride + ray, tl.load(to + 7, mask=on, other=0.0), mask=on)
    tl.store(rays + 2 * stride + ray, tl.load(to + 11, mask=on, other=0.0), mask=on)
    tl.store(rays + 3 * stride + ray, x, mask=on)
    tl.store(rays + 4 * stride + ray, y, mask=on)
    tl.store(rays + 5 * stride + ray, z, mask=on)
    _harmonics(inputs, ray * columns + channels, x, y, z, on)
    for k in tl.static_range(3):
        level = tl.load(colour + pick.to(tl.int64) * 3 + k, mask=on, other=0).to(tl.float32) / 255
        tl.store(rays + (C_RED + k) * stride + ray, level, mask=on)
        tl.store(rays + (C_BEHIND + k) * stride + ray, tl.load(background + k), mask=on)
    tl.store(rays + C_COUNTS * stride + ray, 1 / (density * count), mask=on)
    target = density * 0
    if KNOWN:
        target = tl.load(distance + pick, mask=on, other=0.0)
    tl.store(rays + C_TARGET * stride + ray, target, mask=on)
    tl.store(rays + C_JITTER * stride + ray, tl.rand(key, number + 60), mask=on)
