"""Samples along rays on CUDA: one kernel walks, looks densities up, and notes the samples that show; a second composites features.

The lattice of distances, the weights and the thresholds are those of `march.py` and `rays.py`. Empty space is skipped by the distance to
what is occupied, as on the CPU. Noted samples lie in `SLOTS` layers of one sample a ray.
"""

from __future__ import annotations

import triton
import triton.language as tl

from fieldfuse.backends.constants import MAX_STRETCH, OPAQUE, SOLID, STOP
from fieldfuse.backends.triton.lookup import (
    C_RAW_MAX,
    C_UNITS,
    bricks_away,
    contract,
    corner,
    exp,
    largest,
    raw_density,
    share,
    stopped,
    voxel_of,
)

RAYS = 32  # of a program: a warp, each thread with a ray of its own
# Layers of `rays` (LAYERS, N): origin, direction, colour, what a ray counts, distance to a known surface, jitter, what is behind.
DX, RED, COUNTS, TARGET, JITTER, BEHIND, LAYERS = 3, 6, 9, 10, 11, 12, 15
NOTES, SHOWN = 9, 4  # layers of `notes` (NOTES, SLOTS, N): those of C_FX … below; rendering has the first four
OPACITY, MEDIAN, SUMS = 0, 2, 4  # layers of `sums` (SUMS, N): those of C_OPACITY … below
C_JITTER, C_STOP, C_SOLID, C_OPAQUE, C_STRETCH = (tl.constexpr(v) for v in (JITTER, STOP, SOLID, OPAQUE, MAX_STRETCH))
C_FX, C_FY, C_FZ, C_WEIGHT, C_AFTER, C_SLOPE, C_DISTANCE, C_PLACE, C_PULL = (tl.constexpr(v) for v in range(9))
C_OPACITY, C_MOMENT, C_MEDIAN, C_G_OPACITY = (tl.constexpr(v) for v in range(4))
C_RED, C_COUNTS, C_TARGET, C_BEHIND = (tl.constexpr(v) for v in (RED, COUNTS, TARGET, BEHIND))
C_FLOOR = tl.constexpr(1e-6)  # rays.OPACITY_FLOOR


@triton.jit
def _stride(ox, oy, oz, dx, dy, dz, t, rise, far, h, near_limit):
    """Where the step that begins at distance `t` ends, beyond the region of interest as within it (`march._coarse_distances`)."""
    norm = tl.maximum(largest(ox + dx * t, oy + dy * t, oz + dz * t), 1.0)
    stretch = tl.minimum(tl.maximum(norm * norm * rise, 1.0), C_STRETCH)
    return tl.where(norm > far, t, t + stretch * h)


@triton.jit(do_not_specialize=["count", "stride", "width", "tx", "ty", "tz", "sx", "sy", "sz"])
def walk(
    rays, cells, notes, counts, sums, seen, visits,
    skip, table, occupied, lookup, density,
    count, stride,  # rays of this call, and of a layer
    cx, cy, cz, half, extent, shell, bx, by, bz, near, step, voxel,
    width, top, tx, ty, tz, sx, sy, sz,
    threshold,
    FINE: tl.constexpr, HAS_SHELL: tl.constexpr, TRAIN: tl.constexpr, SLOTS: tl.constexpr, B: tl.constexpr,
):  # fmt: skip
    """Walk along rays; note the samples whose weight exceeds `threshold`, near to far.

    Writes `cells` (SLOTS, N) int32, `notes`, `counts` (N,) int32 and the opacity, moment and median distance in `sums`. In training the
    largest weight and the visits of voxels are noted in `seen` and `visits`, and rays are moved by their jitter.
    """
    ray = tl.program_id(0) * B + tl.arange(0, B)
    on = ray < count
    ox = (tl.load(rays + 0 * stride + ray, mask=on, other=0.0) - cx) / half
    oy = (tl.load(rays + 1 * stride + ray, mask=on, other=0.0) - cy) / half
    oz = (tl.load(rays + 2 * stride + ray, mask=on, other=0.0) - cz) / half
    dx = tl.load(rays + 3 * stride + ray, mask=on, other=1.0) / half
    dy = tl.load(rays + 4 * stride + ray, mask=on, other=0.0) / half
    dz = tl.load(rays + 5 * stride + ray, mask=on, other=0.0) / half
    shift = ox * 0
    if TRAIN:
        shift = tl.load(rays + C_JITTER * stride + ray, mask=on, other=0.0) / FINE
    speed = tl.sqrt(dx * dx + dy * dy + dz * dz)
    h = step / speed
    if HAS_SHELL:
        back = (ox * dx + oy * dy + oz * dz) / (speed * speed)
        px, py, pz = ox - dx * back, oy - dy * back, oz - dz * back
        rise = 1 / tl.sqrt(shell * shell + extent * extent * (px * px + py * py + pz * pz))
        far = shell / voxel + 0 * ox
        first = near - shift * h
        leave = first * 0
    else:
        ex = tl.where(tl.abs(dx) < 1e-9, 1e-9, dx)
        ey = tl.where(tl.abs(dy) < 1e-9, 1e-9, dy)
        ez = tl.where(tl.abs(dz) < 1e-9, 1e-9, dz)
        lx, hx, ly, hy, lz, hz = (-bx - ox) / ex, (bx - ox) / ex, (-by - oy) / ey, (by - oy) / ey, (-bz - oz) / ez, (bz - oz) / ez
        enter = tl.maximum(tl.maximum(tl.minimum(lx, hx), tl.minimum(ly, hy)), tl.minimum(lz, hz))
        enter = tl.maximum(enter, near)
        leave = tl.minimum(tl.minimum(tl.maximum(lx, hx), tl.maximum(ly, hy)), tl.maximum(lz, hz))
        on = on & (leave > enter)
        first = enter
        rise, far = ox * 0, ox * 0
    per_voxel, per_brick = 1 / voxel, 1 / (4 * voxel)
    number = tl.zeros([B], tl.int32)  # of the coarse step
    t = first if HAS_SHELL else tl.minimum(first - shift * h, leave)
    px, py, pz = contract(ox + dx * t, oy + dy * t, oz + dz * t, shell, HAS_SHELL)
    end, qx, qy, qz = t, px, py, pz
    gone, opacity, moment, median, full, peak = ox * 0, ox * 0, ox * 0, ox * 0, ox * 0, ox * 0
    strongest, noted = tl.zeros([B], tl.int32), tl.zeros([B], tl.int32)
    while tl.max(on.to(tl.int32), 0) > 0:
        # To the next step that crosses a brick with something in or beside it.
        searching, found = on, on & False
        while tl.max(searching.to(tl.int32), 0) > 0:
            if HAS_SHELL:
                next_t = _stride(ox, oy, oz, dx, dy, dz, t, rise, far, h, near)
            else:
                next_t = tl.minimum(first + ((number + 1).to(tl.float32) - shift) * h, leave)
            nx, ny, nz = contract(ox + dx * next_t, oy + dy * next_t, oz + dz * next_t, shell, HAS_SHELL)
            end, qx, qy, qz = (
                tl.where(searching, next_t, end), tl.where(searching, nx, qx), tl.where(searching, ny, qy), tl.where(searching, nz, qz),
            )  # fmt: skip
            over = searching & (next_t <= t)
            on = on & (over == 0)
            searching = searching & (over == 0)
            place = bricks_away(skip, 0.5 * (px + nx), 0.5 * (py + ny), 0.5 * (pz + nz), extent, per_brick, width)
            away = tl.load(skip + place, mask=searching, other=255).to(tl.int32)
            here = searching & (away <= 1) & (next_t > near)
            found = found | here
            searching = searching & (here == 0)
            more = tl.where(searching, tl.maximum(away - 1, 1), 0)  # steps: each crosses one brick at most
            number += more
            if HAS_SHELL:
                t = tl.where(searching, next_t, t)
                more -= 1
                while tl.max(more, 0) > 0:
                    t = tl.where(more > 0, _stride(ox, oy, oz, dx, dy, dz, t, rise, far, h, near), t)
                    more -= 1
            else:
                t = tl.where(searching, tl.minimum(first + (number.to(tl.float32) - shift) * h, leave), t)
            mx, my, mz = contract(ox + dx * t, oy + dy * t, oz + dz * t, shell, HAS_SHELL)
            px, py, pz = tl.where(searching, mx, px), tl.where(searching, my, py), tl.where(searching, mz, pz)
        # The samples of that step.
        vx, vy, vz = qx - px, qy - py, qz - pz
        length = tl.sqrt(vx * vx + vy * vy + vz * vz) / FINE
        for f in range(FINE):
            part = (f + 0.5) / FINE
            cell, fx, fy, fz = voxel_of(
                table, px + vx * part, py + vy * part, pz + vz * part, extent, per_voxel, top, tx, ty, tz, sx, sy, sz, found
            )
            held = found & (cell >= 0)
            held = held & (tl.load(occupied + cell, mask=held, other=0) != 0)
            light = exp(-gone)
            alive = held & (light >= C_STOP)
            if tl.max(alive.to(tl.int32), 0) > 0:
                raw = raw_density(density, cell, fx, fy, fz, lookup, alive)
                tau = exp(tl.minimum(raw, C_RAW_MAX)) * C_UNITS * length
                weight = tl.where(alive, light * stopped(tau), 0.0)
                after = light * exp(-tau)
                distance = t + (end - t) * part
                if TRAIN:
                    tl.atomic_max(seen + cell, weight, mask=alive, sem="relaxed")
                    tl.atomic_add(visits + cell, tl.full([B], 1.0, tl.float32), mask=alive, sem="relaxed")
                    full += weight
                    strongest = tl.where(weight > peak, cell, strongest)
                    peak = tl.maximum(peak, weight)
                # Within a sample's interval its weight counts as spread evenly (`rays._median_distance`).
                middle = alive & (light > 0.5) & (after <= 0.5)
                within = (light - 0.5) / tl.maximum(light - after, 1e-12) - 0.5
                median = tl.where(middle, distance + within * (end - t) / FINE, median)
                shows = alive & (weight > threshold) & (noted < SLOTS)
                at = noted * stride + ray
                along = (number.to(tl.float32) + part) * (step / (2 * extent))
                tl.store(cells + at, cell, mask=shows)
                tl.store(notes + (C_FX * SLOTS) * stride + at, fx, mask=shows)
                tl.store(notes + (C_FY * SLOTS) * stride + at, fy, mask=shows)
                tl.store(notes + (C_FZ * SLOTS) * stride + at, fz, mask=shows)
                tl.store(notes + (C_WEIGHT * SLOTS) * stride + at, weight, mask=shows)
                if TRAIN:
                    tl.store(notes + (C_AFTER * SLOTS) * stride + at, after, mask=shows)
                    tl.store(notes + (C_SLOPE * SLOTS) * stride + at, tl.where(raw < C_RAW_MAX, tau, 0.0), mask=shows)
                    tl.store(notes + (C_DISTANCE * SLOTS) * stride + at, distance, mask=shows)
                    tl.store(notes + (C_PLACE * SLOTS) * stride + at, along, mask=shows)
                counted = tl.where(shows, weight, 0.0)
                opacity += counted
                moment += counted * along
                noted += shows.to(tl.int32)
                gone += tl.where(alive, tl.minimum(tau, C_OPAQUE), 0.0)
        on = on & (exp(-gone) >= C_STOP)
        t = tl.where(found, end, t)
        px, py, pz = tl.where(found, qx, px), tl.where(found, qy, py), tl.where(found, qz, pz)
        number += found.to(tl.int32)
    inside = ray < count
    tl.store(counts + ray, noted, mask=inside)
    tl.store(sums + C_OPACITY * stride + ray, opacity, mask=inside)
    tl.store(sums + C_MOMENT * stride + ray, moment, mask=inside)
    tl.store(sums + C_MEDIAN * stride + ray, median, mask=inside)
    if TRAIN:  # of a ray that ends somewhere the strongest sample counts as seen fully
        ends = inside & (peak > 0) & (1 - full < C_SOLID)
        tl.atomic_max(seen + strongest, tl.full([B], 1.0, tl.float32), mask=ends, sem="relaxed")


@triton.jit
def noted_at(cells, notes, at, layer, mask):
    """Voxel, place within it and weight of noted samples `at` (slot · N + ray); `layer`: numbers from one layer of `notes` to the next."""
    cell = tl.load(cells + at, mask=mask, other=0)
    fx = tl.load(notes + C_FX * layer + at, mask=mask, other=0.0)
    fy = tl.load(notes + C_FY * layer + at, mask=mask, other=0.0)
    fz = tl.load(notes + C_FZ * layer + at, mask=mask, other=0.0)
    weight = tl.load(notes + C_WEIGHT * layer + at, mask=mask, other=0.0)
    return cell, fx, fy, fz, weight


@triton.jit
def gathered(features, cell, fx, fy, fz, lookup, channel, C: tl.constexpr, mask, wanted):
    """(B, P) trilinear features of voxels `cell` (B,)."""
    value = tl.zeros([cell.shape[0], channel.shape[0]], tl.float32)
    for d in tl.static_range(8):
        row = corner(cell, lookup, d & 1, (d >> 1) & 1, d >> 2, mask)
        part = share(fx, d & 1) * share(fy, (d >> 1) & 1) * share(fz, d >> 2)
        value += part[:, None] * tl.load(features + row[:, None].to(tl.int64) * C + channel[None, :], mask=wanted, other=0.0)
    return value


@triton.jit(do_not_specialize=["count", "stride", "columns"])
def composite(
    cells, notes, counts, sums, features, lookup, inputs,
    count, stride, columns,
    C: tl.constexpr, P: tl.constexpr, SLOTS: tl.constexpr, B: tl.constexpr,
):  # fmt: skip
    """Mean features of rays: Σ w f / max(Σ w, floor), into the first C columns of `inputs` (N, columns). P: C as a power of two."""
    ray = tl.program_id(0) * B + tl.arange(0, B)
    channel = tl.arange(0, P)
    on = ray < count
    noted = tl.load(counts + ray, mask=on, other=0)
    total = tl.zeros([B, P], tl.float32)
    most = tl.max(noted, 0)
    slot = most * 0
    while slot < most:
        mask = slot < noted
        at = slot * stride + ray
        cell, fx, fy, fz, weight = noted_at(cells, notes, at, SLOTS * stride, mask)
        wanted = mask[:, None] & (channel < C)[None, :]
        total += weight[:, None] * gathered(features, cell, fx, fy, fz, lookup, channel, C, mask, wanted)
        slot += 1
    opacity = tl.load(sums + C_OPACITY * stride + ray, mask=on, other=0.0)
    mean = total / tl.maximum(opacity, C_FLOOR)[:, None]
    tl.store(inputs + ray[:, None].to(tl.int64) * columns + channel[None, :], mean, mask=on[:, None] & (channel < C)[None, :])
