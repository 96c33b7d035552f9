"""The rest of a training step on CUDA: the draw of pixels, the loss, gradients of what was looked up, and the optimiser's step.

`importance.py`, `rays.py`, `step.py`, `adam.py` and `depth.py` are the reference. Gradients of rows are summed by atomic additions, so two
fits with the same seed differ in last digits.
"""

from __future__ import annotations

import triton
import triton.language as tl

from toolkit.networks.encoding import SH
from toolkit.render.composite import OPAQUE
from toolkit.render.triton_lookup import corner, share
from toolkit.render.triton_march import (
    C_AFTER,
    C_DISTANCE,
    C_FLOOR,
    C_FX,
    C_FY,
    C_FZ,
    C_MOMENT,
    C_OPACITY,
    C_PLACE,
    C_SLOPE,
    C_WEIGHT,
    gathered,
)
from toolkit.training.depth import REACH
from toolkit.training.importance import KEEP, TILE, TOP

TRIES = 24  # evenly drawn pixels, of which the first that luck takes is looked at; one of 3·10⁴ rays takes its last one
# Places in `rates`, in the order of `Rates`.
R_DENSITY, R_FEATURE, R_DECODER, R_DISTORTION, R_OPACITY, R_DEPTH, R_NOISE, R_SLOW, R_RANDOM = (tl.constexpr(v) for v in range(9))
RATES = 9
S0, S1, S2, S3, S4, S5, S6, S7, S8, S9 = (tl.constexpr(v) for v in SH)
C_TOP, C_TILE, C_KEEP, C_TRIES, C_REACH, C_OPAQUE = (tl.constexpr(v) for v in (TOP, TILE, KEEP, TRIES, REACH, OPAQUE))
C_PULL, C_G_OPACITY = tl.constexpr(8), tl.constexpr(3)
HUGE = tl.constexpr(3e38)  # what is not smaller is not finite


@triton.jit
def _harmonics(inputs, at, x, y, z, mask):  # type: ignore[no-untyped-def]
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
def _seen_at(starts, places, camera, pick, views, SOME: tl.constexpr, mask):  # type: ignore[no-untyped-def]
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
def draw(  # type: ignore[no-untyped-def]
    rays, tiles, inputs, state, rates,
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
    wild = tl.load(rates + R_RANDOM) > 0
    for k in tl.static_range(3):
        level = tl.load(colour + pick.to(tl.int64) * 3 + k, mask=on, other=0).to(tl.float32) / 255
        tl.store(rays + (6 + k) * stride + ray, level, mask=on)
        behind = tl.where(wild, tl.rand(key, number + 56 + k), tl.load(background + k))
        tl.store(rays + (12 + k) * stride + ray, behind, mask=on)
    tl.store(rays + 9 * stride + ray, 1 / (density * count), mask=on)
    target = density * 0
    if KNOWN:
        target = tl.load(distance + pick, mask=on, other=0.0)
    tl.store(rays + 10 * stride + ray, target, mask=on)
    tl.store(rays + 11 * stride + ray, tl.rand(key, number + 60), mask=on)


@triton.jit(do_not_specialize=["count", "stride"])
def judge(  # type: ignore[no-untyped-def]
    rays, sums, logits, g_logits, tiles, error, total, rates, count, stride, REMEMBER: tl.constexpr, B: tl.constexpr,
):  # fmt: skip
    """The squared error of rays, and its gradient for what they composite (`Optimiser._deferred`)."""
    ray = tl.program_id(0) * B + tl.arange(0, B)
    on = ray < count
    opacity = tl.load(sums + C_OPACITY * stride + ray, mask=on, other=0.0)
    part = tl.load(rays + 9 * stride + ray, mask=on, other=0.0)
    g_opacity = -(1 - opacity) * (2 * tl.load(rates + R_OPACITY) * part)
    squared = opacity * 0
    for k in tl.static_range(3):
        colour = 1 / (1 + tl.exp(-tl.load(logits + ray * 3 + k, mask=on, other=0.0)))
        behind = tl.load(rays + (12 + k) * stride + ray, mask=on, other=0.0)
        residual = opacity * colour + (1 - opacity) * behind - tl.load(rays + (6 + k) * stride + ray, mask=on, other=0.0)
        squared += residual * residual / 3
        g_mixed = residual * (2.0 / 3.0) * part
        tl.store(g_logits + ray * 3 + k, g_mixed * opacity * colour * (1 - colour), mask=on)
        g_opacity += g_mixed * (colour - behind)
    tl.store(sums + C_G_OPACITY * stride + ray, g_opacity, mask=on)
    tl.atomic_add(total, tl.sum(tl.where(on, squared * part, 0.0), 0), sem="relaxed")
    if REMEMBER:
        tile = tl.load(tiles + ray, mask=on, other=0)
        old = tl.load(error + tile, mask=on, other=0.0)
        tl.store(error + tile, tl.where(old > 0, old * C_KEEP + squared * (1 - C_KEEP), squared), mask=on & (squared < HUGE))


@triton.jit(do_not_specialize=["count", "stride", "columns", "zero_row"])
def spread(  # type: ignore[no-untyped-def]
    rays, cells, notes, counts, sums, inputs, g_inputs, g_logits, features, lookup,
    g_density, g_feature, touched, bad, rates,
    count, stride, columns, zero_row, interval,
    C: tl.constexpr, P: tl.constexpr, SLOTS: tl.constexpr, B: tl.constexpr,
):  # fmt: skip
    """From gradients of rays to gradients of rows: ∂L/∂w of every noted sample, from it ∂L/∂τ, and the sums over corners."""
    ray = tl.program_id(0) * B + tl.arange(0, B)
    channel = tl.arange(0, P)
    on = ray < count
    noted = tl.load(counts + ray, mask=on, other=0)
    most = tl.max(noted, 0)
    opacity = tl.load(sums + C_OPACITY * stride + ray, mask=on, other=0.0)
    moment = tl.load(sums + C_MOMENT * stride + ray, mask=on, other=0.0)
    part = tl.load(rays + 9 * stride + ray, mask=on, other=0.0)
    target = tl.load(rays + 10 * stride + ray, mask=on, other=0.0)
    both = on[:, None] & (channel < C)[None, :]
    mean = tl.load(inputs + ray[:, None] * columns + channel[None, :], mask=both, other=0.0)
    g_mean = tl.load(g_inputs + ray[:, None] * C + channel[None, :], mask=both, other=0.0)
    g_mean += tl.load(g_logits + ray[:, None] * 3 + channel[None, :], mask=on[:, None] & (channel < 3)[None, :], other=0.0)
    # mean = Σ w f / A and A = Σ w: ∂mean/∂w_i = (f_i - mean) / A
    g_sum = g_mean / tl.maximum(opacity, C_FLOOR)[:, None]
    g_rest = tl.load(sums + C_G_OPACITY * stride + ray, mask=on, other=0.0) - tl.sum(g_sum * mean, 1)
    pull_rate = 2 * tl.load(rates + R_DISTORTION) * part
    depth_rate, noise = tl.load(rates + R_DEPTH) * part, tl.load(rates + R_NOISE)
    within = tl.load(rates + R_SLOW)
    product, before, moment_before = opacity * 0, opacity * 0, opacity * 0
    slot = most * 0
    while slot < most:
        mask = slot < noted
        at = slot * stride + ray
        cell = tl.load(cells + at, mask=mask, other=0)
        fx = tl.load(notes + (C_FX * SLOTS) * stride + at, mask=mask, other=0.0)
        fy = tl.load(notes + (C_FY * SLOTS) * stride + at, mask=mask, other=0.0)
        fz = tl.load(notes + (C_FZ * SLOTS) * stride + at, mask=mask, other=0.0)
        weight = tl.load(notes + (C_WEIGHT * SLOTS) * stride + at, mask=mask, other=0.0)
        away = tl.load(notes + (C_DISTANCE * SLOTS) * stride + at, mask=mask, other=0.0)
        place = tl.load(notes + (C_PLACE * SLOTS) * stride + at, mask=mask, other=0.0)
        wanted = mask[:, None] & (channel < C)[None, :]
        value = gathered(features, cell, fx, fy, fz, lookup, channel, C, mask, wanted)
        gradient = tl.sum(value * g_sum, 1) + g_rest
        # Distortion (`composite.distortion`).
        behind, moment_behind = opacity - before - weight, moment - moment_before - weight * place
        gradient += pull_rate * (place * (before - behind) - (moment_before - moment_behind) + weight * interval / 3)
        off = (tl.abs(away - target) / tl.maximum(target, 1e-9) - noise) / C_REACH
        gradient += tl.where(target > 0, depth_rate * (tl.minimum(tl.maximum(off, 0.0), 1.0) - 1), 0.0)
        tl.store(notes + (C_PULL * SLOTS) * stride + at, gradient, mask=mask)
        product += tl.where(mask, weight * gradient, 0.0)
        before += weight
        moment_before += weight * place
        slot += 1
    broken = on & ((tl.abs(product) < HUGE) == 0)
    passed = opacity * 0
    slot = most * 0
    while slot < most:
        mask = slot < noted
        at = slot * stride + ray
        cell = tl.load(cells + at, mask=mask, other=0)
        fx = tl.load(notes + (C_FX * SLOTS) * stride + at, mask=mask, other=0.0)
        fy = tl.load(notes + (C_FY * SLOTS) * stride + at, mask=mask, other=0.0)
        fz = tl.load(notes + (C_FZ * SLOTS) * stride + at, mask=mask, other=0.0)
        weight = tl.load(notes + (C_WEIGHT * SLOTS) * stride + at, mask=mask, other=0.0)
        after = tl.load(notes + (C_AFTER * SLOTS) * stride + at, mask=mask, other=0.0)
        slope = tl.load(notes + (C_SLOPE * SLOTS) * stride + at, mask=mask, other=0.0)
        away = tl.load(notes + (C_DISTANCE * SLOTS) * stride + at, mask=mask, other=0.0)
        gradient = tl.load(notes + (C_PULL * SLOTS) * stride + at, mask=mask, other=0.0)
        passed += weight * gradient
        near = tl.minimum(tl.maximum(away, 0.0) / tl.maximum(within, 1e-20), 1.0)
        slow = tl.where(within > 0, near * near, 1.0)
        g_raw = (after * gradient - (product - passed)) * slope * slow
        broken = broken | (mask & ((tl.abs(g_raw) < HUGE) == 0))
        lit = weight * slow
        for d in tl.static_range(8):
            row = corner(cell, lookup, d & 1, (d >> 1) & 1, d >> 2, mask)
            amount = share(fx, d & 1) * share(fy, (d >> 1) & 1) * share(fz, d >> 2)
            there = mask & (row != zero_row)  # the zero row stays zero
            tl.store(touched + row, tl.full([B], 1, tl.uint8), mask=there)
            tl.atomic_add(g_density + row, g_raw * amount, mask=there, sem="relaxed")
            each = there[:, None] & (channel < C)[None, :]
            tl.atomic_add(
                g_feature + row[:, None].to(tl.int64) * C + channel[None, :], g_sum * (lit * amount)[:, None], mask=each, sem="relaxed"
            )
        slot += 1
    broken = broken | (on & ((tl.sum(tl.abs(g_sum), 1) < HUGE) == 0) & (noted > 0))
    if tl.max(broken.to(tl.int32), 0) > 0:
        tl.atomic_add(bad, 1, sem="relaxed")


@triton.jit(do_not_specialize=["size"])
def inspect(gradient, total, bad, size, B: tl.constexpr):  # type: ignore[no-untyped-def]
    """Note in `bad` a loss or a gradient of the decoder that is not finite."""
    broken = (tl.abs(tl.load(total)) < HUGE) == 0
    found = 0
    start = 0
    while start < size:
        place = start + tl.arange(0, B)
        value = tl.load(gradient + place, mask=place < size, other=0.0)
        found += tl.max(((tl.abs(value) < HUGE) == 0).to(tl.int32), 0)
        start += B
    if broken | (found > 0):
        tl.atomic_add(bad, 1, sem="relaxed")


@triton.jit(do_not_specialize=["rows"])
def move(  # type: ignore[no-untyped-def]
    density, feature, g_density, g_feature, second_density, second_feature, steps, touched, bad, rates,
    rows, log_decay, decay, epsilon,
    C: tl.constexpr, P: tl.constexpr, B: tl.constexpr,
):  # fmt: skip
    """Lazy Adam on the rows that were touched (`LazyAdam.step`), and their gradients back to zero. Nothing is moved where `bad` says so."""
    row = tl.program_id(0) * B + tl.arange(0, B)
    there = tl.load(touched + row, mask=row < rows, other=0) != 0
    if tl.max(there.to(tl.int32), 0) > 0:
        channel = tl.arange(0, P)
        good = (row * 0 + tl.load(bad)) == 0
        both = there[:, None] & (channel < C)[None, :]
        at = row[:, None].to(tl.int64) * C + channel[None, :]
        moved, all_moved = there & good, both & good[:, None]
        step = tl.load(steps + row, mask=there, other=0.0) + 1
        unbias = tl.sqrt(1 - tl.exp2(step * log_decay))
        one = tl.load(g_density + row, mask=there, other=0.0)
        second = decay * tl.load(second_density + row, mask=there, other=0.0) + (1 - decay) * one * one
        change = one / (tl.sqrt(second) + epsilon) * unbias * tl.load(rates + R_DENSITY)
        tl.store(density + row, tl.load(density + row, mask=there, other=0.0) - change, mask=moved)
        tl.store(second_density + row, second, mask=moved)
        tl.store(steps + row, step, mask=moved)
        many = tl.load(g_feature + at, mask=both, other=0.0)
        seconds = decay * tl.load(second_feature + at, mask=both, other=0.0) + (1 - decay) * many * many
        changes = many / (tl.sqrt(seconds) + epsilon) * (unbias * tl.load(rates + R_FEATURE))[:, None]
        tl.store(feature + at, tl.load(feature + at, mask=both, other=0.0) - changes, mask=all_moved)
        tl.store(second_feature + at, seconds, mask=all_moved)
        tl.store(g_density + row, tl.zeros([B], tl.float32), mask=there)  # not 0 · g, which may be NaN
        tl.store(g_feature + at, tl.zeros([B, P], tl.float32), mask=both)
        tl.store(touched + row, tl.zeros([B], tl.uint8), mask=there)


@triton.jit(do_not_specialize=["size"])
def learn(  # type: ignore[no-untyped-def]
    values, gradient, first, second, kept, state, bad, rates, size, log_first, log_second, epsilon, B: tl.constexpr,
):  # fmt: skip
    """Adam on the decoder (`torch.optim.Adam`), whose weights where `kept` is 0 stay as they are."""
    place = tl.program_id(0) * B + tl.arange(0, B)
    on = place < size
    if tl.load(bad) == 0:
        step = tl.load(state + 1).to(tl.float32) + 1
        decay, square_decay = tl.exp2(log_first), tl.exp2(log_second)
        g = tl.load(gradient + place, mask=on, other=0.0)
        m = decay * tl.load(first + place, mask=on, other=0.0) + (1 - decay) * g
        v = square_decay * tl.load(second + place, mask=on, other=0.0) + (1 - square_decay) * g * g
        size_of = tl.load(rates + R_DECODER) / (1 - tl.exp2(step * log_first))
        change = size_of * m / (tl.sqrt(v) / tl.sqrt(1 - tl.exp2(step * log_second)) + epsilon)
        tl.store(first + place, m, mask=on)
        tl.store(second + place, v, mask=on)
        tl.store(values + place, tl.load(values + place, mask=on, other=0.0) - change * tl.load(kept + place, mask=on, other=0.0), mask=on)


@triton.jit
def count_step(state, bad, failed):  # type: ignore[no-untyped-def]
    """The numbers of the next step, and of good and of bad steps so far."""
    broken = tl.load(bad)
    tl.store(state, tl.load(state) + 1)
    tl.store(state + 1, tl.load(state + 1) + (broken == 0).to(tl.int64))
    tl.store(failed, tl.load(failed) + (broken != 0).to(tl.int32))
    tl.store(bad, broken * 0)
