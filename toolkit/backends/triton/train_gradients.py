"""The loss of a step on CUDA, and its gradients for rays and for rows. `torch_engine.py`, `composite.py` and `losses.py` are the reference.

Gradients of rows are summed by atomic additions, so two fits with the same seed differ in last digits.
"""

from __future__ import annotations

import triton
import triton.language as tl

from fieldfuse.backends.constants import KEEP, REACH
from fieldfuse.backends.triton.lookup import corner, share
from fieldfuse.backends.triton.march import (
    C_AFTER,
    C_BEHIND,
    C_COUNTS,
    C_DISTANCE,
    C_FLOOR,
    C_G_OPACITY,
    C_MOMENT,
    C_OPACITY,
    C_PLACE,
    C_PULL,
    C_RED,
    C_SLOPE,
    C_TARGET,
    gathered,
    noted_at,
)
from fieldfuse.backends.triton.train_adam import R_DEPTH, R_DISTORTION, R_NOISE, R_OPACITY, R_SLOW

C_KEEP, C_REACH = tl.constexpr(KEEP), tl.constexpr(REACH)
HUGE = tl.constexpr(3e38)  # what is not smaller is not finite


@triton.jit(do_not_specialize=["count", "stride"])
def judge(
    rays, sums, logits, g_logits, tiles, error, total, rates, count, stride, REMEMBER: tl.constexpr, B: tl.constexpr,
):  # fmt: skip
    """The squared error of rays, and its gradient for what they composite (`render.rays.shade`)."""
    ray = tl.program_id(0) * B + tl.arange(0, B)
    on = ray < count
    opacity = tl.load(sums + C_OPACITY * stride + ray, mask=on, other=0.0)
    part = tl.load(rays + C_COUNTS * stride + ray, mask=on, other=0.0)
    g_opacity = -(1 - opacity) * (2 * tl.load(rates + R_OPACITY) * part)
    squared = opacity * 0
    for k in tl.static_range(3):
        colour = 1 / (1 + tl.exp(-tl.load(logits + ray * 3 + k, mask=on, other=0.0)))
        behind = tl.load(rays + (C_BEHIND + k) * stride + ray, mask=on, other=0.0)
        residual = opacity * colour + (1 - opacity) * behind - tl.load(rays + (C_RED + k) * stride + ray, mask=on, other=0.0)
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
def spread(
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
    part = tl.load(rays + C_COUNTS * stride + ray, mask=on, other=0.0)
    target = tl.load(rays + C_TARGET * stride + ray, mask=on, other=0.0)
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
        cell, fx, fy, fz, weight = noted_at(cells, notes, at, SLOTS * stride, mask)
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
        cell, fx, fy, fz, weight = noted_at(cells, notes, at, SLOTS * stride, mask)
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
def inspect(gradient, total, bad, size, B: tl.constexpr):
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
