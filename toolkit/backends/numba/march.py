"""Samples along a ray, compiled; `render/march.py` is the reference. Empty space is skipped by the distance to what is occupied."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from fieldfuse.backends.numba.common import (
    AFTER,
    ALONG,
    HALF,
    LEAF,
    ONE,
    PLACE,
    RAW,
    RAW_MAX,
    SOLID,
    STRETCH,
    TAU,
    THIN,
    THIRD,
    TWO,
    UNITS,
    WEIGHT,
    ZERO,
    F,
    X,
    Y,
    Z,
    prefetch,
)
from fieldfuse.backends.numba.lookup import corner_rows_of, raw_density


@njit(**LEAF)
def mark(marks: Any, cell: Any, weight: Any) -> None:
    """Remember of a voxel the largest weight it was seen with (12 bits) and how often it was visited (4 bits, saturating)."""
    old = np.uint32(marks[cell])
    level = max(old >> np.uint32(4), np.uint32(min(weight * F(4095), F(4095))))
    marks[cell] = np.uint16((level << np.uint32(4)) | min((old & np.uint32(15)) + np.uint32(1), np.uint32(15)))


@njit(**LEAF)
def mark_surface(marks: Any, cell: Any) -> None:
    """Remember a voxel as seen with all the light there is."""
    marks[cell] = np.uint16(np.uint32(marks[cell]) | np.uint32(0xFFF0))


@njit(**LEAF)
def brick_distance(bricks: Any, x: Any, y: Any, z: Any, scale: Any) -> Any:
    """Distance in bricks from a place in lattice-cube coordinates (0 at its low corner) to the nearest occupied brick."""
    top = bricks.shape[0] - 1
    i = min(max(int(x * scale + ONE), 0), top)
    j = min(max(int(y * scale + ONE), 0), top)
    k = min(max(int(z * scale + ONE), 0), top)
    return int(bricks[k, j, i])


@njit(**LEAF)
def march_ray(
    space: Any,
    volume: Any,
    ox: Any,
    oy: Any,
    oz: Any,
    dx: Any,
    dy: Any,
    dz: Any,
    jitter: Any,
    stop: Any,
    threshold: Any,
    marks: Any,
    first: Any,
    cells: Any,
    all_rows: Any,
    values: Any,
    result: Any,
) -> Any:
    """March one ray (working frame, unit direction) and keep the samples whose weight exceeds `threshold`.

    Args:
        jitter: moves the ray's lattice towards the camera by that part of a fine step.
        stop: the march ends once the transmittance is below.
        marks: (M · 512,) uint16 for `mark`, or of length 0. Of a ray that ends somewhere the strongest sample counts as seen fully: on a
            fine lattice a surface is several voxels thick and none of them may hold much weight.
        first: place of the ray's first sample among these:
        cells: (S,) int32, all_rows: (S, 8) int32 corners, values: (S, VALUES) float32: the kept samples.
        result: (4,) float32 distance at which half of the light is stopped (0: never), transmittance left, samples looked up, coarse steps
            whose fine ones were tried.

    Returns:
        the place after the last kept sample.
    """
    half, extent, shell = space.half, space.extent, space.shell
    ox, oy, oz = (ox - space.cx) / half, (oy - space.cy) / half, (oz - space.cz) / half
    fine = space.fine
    step = space.voxel * F(4)
    per_fine = ONE / F(fine)
    per_voxel = ONE / space.voxel
    per_brick = per_voxel * F(0.25)
    near = space.near / half
    s = near - jitter * per_fine * step
    leave = F(3e38)
    rise = ZERO  # 1 / c of the step's rule n² / c beyond the region
    if shell == ZERO:
        enter = near
        for axis in range(3):
            o, d, b = (ox, dx, space.bx) if axis == 0 else (oy, dy, space.by) if axis == 1 else (oz, dz, space.bz)
            if abs(d) < F(1e-9):
                d = F(1e-9)
            low, high = (-b - o) / d, (b - o) / d
            enter, leave = max(enter, min(low, high)), min(leave, max(low, high))
        s = enter - jitter * per_fine * step
    else:
        along = ox * dx + oy * dy + oz * dz
        px, py, pz = ox - along * dx, oy - along * dy, oz - along * dz
        rise = ONE / math.sqrt(shell * shell + extent * extent * (px * px + py * py + pz * pz))
    far = shell / space.voxel
    marking = marks.shape[0] > 0
    kept, looked, walked = first, 0, 0
    depth, median = ZERO, ZERO  # optical depth so far
    transmittance = ONE
    step_index = 0
    unit = step / (TWO * extent)
    table, bricks, bits, density, upper, feature = volume.table, volume.bricks, volume.bits, volume.density, volume.upper, volume.feature
    most = F(space.resolution) - F(1e-3)
    lx, ly, lz = -1, -1, -1
    slot = -1
    strongest, strongest_cell = ZERO, 0
    known = False  # whether p holds the contracted place at s
    p0x, p0y, p0z = ZERO, ZERO, ZERO
    longest = int(F(14) * extent / step) + 32  # steps: a direction that is zero or no number leads nowhere
    while step_index < longest:
        if shell == ZERO:
            if s >= leave:
                break
            s1 = min(s + step, leave)
            yx, yy, yz = ox + s * dx, oy + s * dy, oz + s * dz
            n = ONE
        else:
            yx, yy, yz = ox + s * dx, oy + s * dy, oz + s * dz
            n = max(max(abs(yx), abs(yy)), max(abs(yz), ONE))
            if n > far:
                break
            s1 = s + step * min(max(n * n * rise, ONE), STRETCH)
        if not known:
            q = ONE
            if n > ONE:
                q = (extent - shell / n) / n
            p0x, p0y, p0z = yx * q + extent, yy * q + extent, yz * q + extent
        yx, yy, yz = ox + s1 * dx, oy + s1 * dy, oz + s1 * dz
        n1 = ONE
        if shell != ZERO:
            n1 = max(max(abs(yx), abs(yy)), max(abs(yz), ONE))
        q = ONE
        if n1 > ONE:
            q = (extent - shell / n1) / n1
        p1x, p1y, p1z = yx * q + extent, yy * q + extent, yz * q + extent
        gap = brick_distance(bricks, HALF * (p0x + p1x), HALF * (p0y + p1y), HALF * (p0z + p1z), per_brick)
        if gap > 1:
            # What is `gap` bricks away cannot be next to the middle of any of the following gap - 2 steps.
            known = gap == 2
            p0x, p0y, p0z = p1x, p1y, p1z
            s = s1
            step_index += 1
            if gap > 2:
                if shell == ZERO:
                    s = s1 + F(gap - 2) * step
                    step_index += gap - 2
                else:
                    for _ in range(gap - 2):
                        yx, yy, yz = ox + s * dx, oy + s * dy, oz + s * dz
                        n = max(max(abs(yx), abs(yy)), max(abs(yz), ONE))
                        s += step * min(max(n * n * rise, ONE), STRETCH)
                        step_index += 1
            continue
        if s1 > near:
            walked += 1
            cx, cy, cz = p1x - p0x, p1y - p0y, p1z - p0z
            length = math.sqrt(cx * cx + cy * cy + cz * cz) * per_fine
            for index in range(fine):
                where = (F(index) + HALF) * per_fine
                x = min(max((p0x + cx * where) * per_voxel, ZERO), most)
                y = min(max((p0y + cy * where) * per_voxel, ZERO), most)
                z = min(max((p0z + cz * where) * per_voxel, ZERO), most)
                i, j, k = int(x), int(y), int(z)
                tx, ty, tz = (i >> 3) - space.ox, (j >> 3) - space.oy, (k >> 3) - space.oz
                if tx != lx or ty != ly or tz != lz:
                    lx, ly, lz = tx, ty, tz
                    slot = -1
                    if 0 <= tx < table.shape[2] and 0 <= ty < table.shape[1] and 0 <= tz < table.shape[0]:
                        slot = table[tz, ty, tx]
                if slot < 0:
                    continue
                if (bits[np.uintp(slot), np.uintp(k & 7)] >> np.uint64((j & 7) * 8 + (i & 7))) & np.uint64(1) == 0:
                    continue
                cell = slot * 512 + ((k & 7) * 8 + (j & 7)) * 8 + (i & 7)
                if marking:
                    prefetch(marks, np.int64(cell))
                fx, fy, fz = x - F(i), y - F(j), z - F(k)
                raw = raw_density(density, upper, cell, fx, fy, fz)
                tau = math.exp(min(raw, RAW_MAX)) * UNITS * length
                looked += 1
                depth += tau
                after = F(math.exp(-depth))
                # w = T (1 - exp(-τ)): from the difference where it holds the digits, else from the series
                weight = transmittance - after
                if tau < THIN:
                    weight = transmittance * tau * (ONE - tau * HALF * (ONE - tau * THIRD))
                if transmittance > HALF and after <= HALF:  # where it would be ½ if the sample's weight were spread evenly
                    part = (transmittance - HALF) / (transmittance - after)
                    median = (s + (s1 - s) * (F(index) + part) * per_fine) * half
                if marking:
                    mark(marks, cell, weight)
                    if weight > strongest:
                        strongest, strongest_cell = weight, cell
                if weight > threshold and kept < cells.shape[0]:
                    cells[kept] = cell
                    corner_rows_of(upper, cell, all_rows, kept)
                    values[kept, X], values[kept, Y], values[kept, Z] = fx, fy, fz
                    values[kept, RAW], values[kept, TAU] = raw, tau
                    values[kept, WEIGHT], values[kept, AFTER] = weight, after
                    values[kept, PLACE] = (F(step_index) + where) * unit
                    values[kept, ALONG] = (s + (s1 - s) * where) * half
                    for corner in range(8):
                        prefetch(feature, np.int64(all_rows[kept, corner]))
                    kept += 1
                transmittance = after
                if transmittance < stop:
                    break
            if transmittance < stop:
                break
        known = True
        p0x, p0y, p0z = p1x, p1y, p1z
        s = s1
        step_index += 1
    if marking and transmittance < SOLID:
        mark_surface(marks, strongest_cell)
    result[0], result[1], result[2], result[3] = median, transmittance, F(looked), F(walked)
    return kept
