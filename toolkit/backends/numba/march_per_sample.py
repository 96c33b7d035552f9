"""The compiled march of the paper's decoder, which gives density and colour at every sample: what stops a ray is known after decoding.

A ray collects TILE samples, decodes their densities in one go, and goes on while light is left. Places along a ray are those of
`march.march_ray`, the deferred decoder's march, and of `march.march` in torch.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from fieldfuse.backends.numba import common as K
from fieldfuse.backends.numba.decode import encode_direction
from fieldfuse.backends.numba.decode_per_sample import MOST, Net, Tape, decode_densities
from fieldfuse.backends.numba.lookup import corner_rows, raw_density
from fieldfuse.backends.numba.march import brick_distance, mark, mark_surface
from fieldfuse.backends.numba.matrix import TILE

F, ZERO, HALF, ONE, TWO = K.F, K.ZERO, K.HALF, K.ONE, K.TWO
NEGLIGIBLE = 1e-6  # samples of smaller weight have no colour and get no gradient
BEGIN, SPAN = K.AFTER, K.WEIGHT  # columns of a sample that waits for its density: distance where it begins, and how long it is


@njit(**K.OPTIONS)
def _move(array: Any, source: Any, target: Any) -> None:
    for j in range(array.shape[1]):
        array[target, j] = array[source, j]


@njit(**K.OPTIONS)
def settle(
    space: Any, volume: Any, net: Net, tape: Tape, first: Any, count: Any, stop: Any, threshold: Any, marks: Any, cells: Any, light: Any
) -> Any:
    """Decode the waiting samples first … first + count, composite them, and keep those whose weight exceeds `threshold`.

    Args:
        cells: (TILE,) voxels of the samples.
        light: (5,) float32 of the ray, carried from call to call: optical depth, transmittance, distance where half of the light was
            stopped, samples decoded, strongest weight.

    Returns:
        samples kept, and the voxel of the strongest one if it is among these, else −1.
    """
    decode_densities(space, volume, net, tape, first, count)
    kept, strongest_cell = first, -1
    marking = marks.shape[0] > 0
    for i in range(first, first + count):
        values = tape.values[i]
        raw, begin, span = values[K.RAW], values[BEGIN], values[SPAN]
        tau = math.exp(min(raw, K.RAW_MAX)) * K.UNITS * values[K.TAU]
        transmittance = light[1]
        light[0] += tau
        light[3] += ONE
        after = F(math.exp(-light[0]))
        weight = transmittance - after
        if tau < K.THIN:
            weight = transmittance * tau * (ONE - tau * HALF * (ONE - tau * K.THIRD))
        if transmittance > HALF and after <= HALF:
            light[2] = begin + span * ((transmittance - HALF) / (transmittance - after))
        if marking:
            mark(marks, cells[i - first], weight)
            if weight > light[4]:
                light[4], strongest_cell = weight, cells[i - first]
        light[1] = after
        if weight > threshold:
            values[K.TAU], values[K.WEIGHT], values[K.AFTER] = tau, weight, after
            if kept < i:
                _move(tape.rows, i, kept)
                _move(tape.values, i, kept)
                _move(tape.corners, i, kept)
                _move(tape.given, i, kept)
                _move(tape.h1, i, kept)
                _move(tape.h2, i, kept)
            kept += 1
        if after < stop:
            break
    return kept - first, strongest_cell


@njit(**K.OPTIONS)
def march_ray(
    space: Any,
    volume: Any,
    net: Net,
    tape: Tape,
    first: Any,
    ray: Any,
    jitter: Any,
    stop: Any,
    threshold: Any,
    marks: Any,
    light: Any,
) -> Any:
    """March one ray (working frame, unit direction) and put samples whose weight exceeds `threshold` on the tape, from row `first` on.

    Args:
        ray: (6,) origin and direction.
        jitter, stop, marks: as in `march.march_ray`, whose lattice of places this follows.
        light: (5,) float32, see `settle`; written.

    Returns:
        number of kept samples.
    """
    half, extent, shell = space.half, space.extent, space.shell
    ox, oy, oz = (ray[0] - space.cx) / half, (ray[1] - space.cy) / half, (ray[2] - space.cz) / half
    dx, dy, dz = ray[3], ray[4], ray[5]
    fine, step = space.fine, space.voxel * F(4)
    per_fine, per_voxel = ONE / F(fine), ONE / space.voxel
    per_brick = per_voxel * F(0.25)
    near = space.near / half
    s = near - jitter * per_fine * step
    leave, rise = F(3e38), ZERO  # rise: 1 / c of the step's rule n² / c beyond the region
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
    light[0], light[1], light[2], light[3], light[4] = ZERO, ONE, ZERO, ZERO, ZERO
    cells = np.empty(TILE, np.int32)
    kept, waiting = K.START, K.START
    strongest_cell = 0
    step_index = 0
    unit = step / (TWO * extent)
    table = volume.table
    most = F(space.resolution) - F(1e-3)
    lx, ly, lz = -1, -1, -1
    slot = -1
    known = False  # whether p0 holds the contracted place at s
    p0x, p0y, p0z = ZERO, ZERO, ZERO
    longest = int(F(14) * extent / step) + 32  # steps: a direction that is zero or no number leads nowhere
    while step_index < longest and kept <= MOST - TILE:
        yx, yy, yz = ox + s * dx, oy + s * dy, oz + s * dz
        n = ONE
        if shell == ZERO:
            if s >= leave:
                break
            s1 = min(s + step, leave)
        else:
            n = max(max(abs(yx), abs(yy)), max(abs(yz), ONE))
            if n > far:
                break
            s1 = s + step * min(max(n * n * rise, ONE), K.STRETCH)
        if not known:
            q = ONE if n <= ONE else (extent - shell / n) / n
            p0x, p0y, p0z = yx * q + extent, yy * q + extent, yz * q + extent
        yx, yy, yz = ox + s1 * dx, oy + s1 * dy, oz + s1 * dz
        q = ONE
        if shell != ZERO:
            n = max(max(abs(yx), abs(yy)), max(abs(yz), ONE))
            if n > ONE:
                q = (extent - shell / n) / n
        p1x, p1y, p1z = yx * q + extent, yy * q + extent, yz * q + extent
        gap = brick_distance(volume.bricks, HALF * (p0x + p1x), HALF * (p0y + p1y), HALF * (p0z + p1z), per_brick)
        if gap > 1:
            # What is `gap` bricks away cannot be next to the middle of any of the following gap - 2 steps.
            known = gap == 2
            p0x, p0y, p0z = p1x, p1y, p1z
            s = s1
            step_index += gap - 1
            if gap > 2:
                if shell == ZERO:
                    s = s1 + F(gap - 2) * step
                else:
                    for _ in range(gap - 2):
                        yx, yy, yz = ox + s * dx, oy + s * dy, oz + s * dz
                        n = max(max(abs(yx), abs(yy)), max(abs(yz), ONE))
                        s += step * min(max(n * n * rise, ONE), K.STRETCH)
            continue
        if s1 > near:
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
                if (volume.bits[slot, k & 7] >> np.uint64((j & 7) * 8 + (i & 7))) & np.uint64(1) == 0:
                    continue
                cell = slot * 512 + ((k & 7) * 8 + (j & 7)) * 8 + (i & 7)
                cells[waiting] = cell
                at = first + kept + waiting
                values, rows = tape.values[at], tape.rows[at]
                corner_rows(volume.upper, cell, rows)
                for corner in range(8):
                    K.prefetch(volume.feature, np.int64(rows[corner]))
                values[K.X], values[K.Y], values[K.Z] = x - F(i), y - F(j), z - F(k)
                values[K.RAW] = raw_density(volume.density, volume.upper, cell, x - F(i), y - F(j), z - F(k))
                values[K.TAU] = length
                values[K.PLACE] = (F(step_index) + where) * unit
                values[K.ALONG] = (s + (s1 - s) * where) * half
                values[BEGIN], values[SPAN] = (s + (s1 - s) * F(index) * per_fine) * half, (s1 - s) * per_fine * half
                waiting += 1
                if waiting == TILE:
                    more, cell = settle(space, volume, net, tape, first + kept, waiting, stop, threshold, marks, cells, light)
                    kept, waiting = kept + more, K.START
                    strongest_cell = cell if cell >= 0 else strongest_cell
                    if light[1] < stop:
                        break
            if light[1] < stop:
                break
        known = True
        p0x, p0y, p0z = p1x, p1y, p1z
        s = s1
        step_index += 1
    if waiting > 0:
        more, cell = settle(space, volume, net, tape, first + kept, waiting, stop, threshold, marks, cells, light)
        kept += more
        strongest_cell = cell if cell >= 0 else strongest_cell
    if marks.shape[0] > 0 and light[1] < K.SOLID:
        mark_surface(marks, strongest_cell)
    hidden = len(net.density)
    for i in range(first, first + kept):
        encode_direction(dx, dy, dz, tape.h2, i, hidden)
    return kept
