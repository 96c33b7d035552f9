"""Samples along a ray, compiled; `render/march.py` is the reference. Empty space is skipped by the distance to what is occupied.

`start_ray` and `next_step` walk along the bricks of a field; the marches differ in what they do with a sample: `march_ray` here (rays that
are decoded once), `per_sample.march_ray` (the paper's decoder) and `baked.baked_march`.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from fieldfuse.backends.numba import common as K
from fieldfuse.backends.numba.lookup import corner_rows, raw_density

ASKEW = (5**0.5 - 1) / 2  # of the distance between two pixels that are looked at in a row: how far the next row's lie beside them
F, ZERO, HALF, ONE, TWO = K.F, K.ZERO, K.HALF, K.ONE, K.TWO


class Ray(NamedTuple):
    """A ray in normalised units, and what its steps need: the box ends at `leave`, beyond the region steps grow as n² · rise up to a norm
    of `far`; a ray has at most `longest` steps, as a direction that is zero or no number leads nowhere."""

    ox: Any
    oy: Any
    oz: Any
    dx: Any
    dy: Any
    dz: Any
    leave: Any
    rise: Any
    far: Any
    longest: Any  # int
    step: Any
    per_brick: Any
    per_voxel: Any
    most: Any  # of a lattice coordinate


class Step(NamedTuple):
    """A coarse step from `begin` to `end` along a ray; a and b are the contracted places there, from the lattice's low corner."""

    begin: Any
    end: Any
    index: Any  # int: how many steps came before
    ax: Any
    ay: Any
    az: Any
    bx: Any
    by: Any
    bz: Any


class Samples(NamedTuple):
    """Samples of some rays whose weight exceeds a threshold, a row a sample."""

    cells: Any  # (S,) int32; −1 − cell of a voxel of the outer field
    rows: Any  # (S, 8) int32 lattice corners
    values: Any  # (S, VALUES) float32


@njit(**K.LEAF)
def mark(marks: Any, cell: Any, weight: Any) -> None:
    """Store of a voxel the largest weight that it was seen with (12 bits) and how often it was visited (4 bits, saturating)."""
    old = np.uint32(marks[cell])
    level = max(old >> np.uint32(4), np.uint32(min(weight * F(4095), F(4095))))
    marks[cell] = np.uint16((level << np.uint32(4)) | min((old & np.uint32(15)) + np.uint32(1), np.uint32(15)))


@njit(**K.LEAF)
def mark_surface(marks: Any, cell: Any) -> None:
    """Mark a voxel as seen with all the light there is."""
    marks[cell] = np.uint16(np.uint32(marks[cell]) | np.uint32(0xFFF0))


@njit(**K.INLINE)
def _norm(shell: Any, x: Any, y: Any, z: Any) -> Any:
    """Maximum norm of a normalised place, at least 1; 1 where nothing exists beyond the region."""
    return max(max(abs(x), abs(y)), max(abs(z), ONE)) if shell != ZERO else ONE


@njit(**K.INLINE)
def _contracted(space: Any, n: Any, x: Any, y: Any, z: Any) -> Any:
    """A normalised place of norm `n`, contracted, from the lattice's low corner."""
    q = ONE
    if n > ONE:
        q = (space.extent - space.shell / n) / n
    return x * q + space.extent, y * q + space.extent, z * q + space.extent


@njit(**K.LEAF)
def brick_distance(bricks: Any, x: Any, y: Any, z: Any, scale: Any) -> Any:
    """Distance in bricks from a place (0 at the lattice's low corner) to the nearest occupied brick."""
    top = bricks.shape[0] - 1
    i = min(max(int(x * scale + ONE), 0), top)
    j = min(max(int(y * scale + ONE), 0), top)
    k = min(max(int(z * scale + ONE), 0), top)
    return int(bricks[k, j, i])


@njit(**K.INLINE)
def start_ray(space: Any, line: Any, jitter: Any) -> Any:
    """The ray of `line`, six numbers (origin in the working frame, unit direction), and its steps' start.

    Args:
        jitter: moves the ray's lattice towards the camera by that part of a fine step.
    """
    half, extent, shell = space.half, space.extent, space.shell
    ox, oy, oz = (line[0] - space.cx) / half, (line[1] - space.cy) / half, (line[2] - space.cz) / half
    dx, dy, dz = line[3], line[4], line[5]
    begin, leave, rise = space.near / half, F(3e38), ZERO
    if shell == ZERO:
        for axis in range(3):
            o, d, b = (ox, dx, space.bx) if axis == 0 else (oy, dy, space.by) if axis == 1 else (oz, dz, space.bz)
            if abs(d) < F(1e-9):
                d = F(1e-9)
            low, high = (-b - o) / d, (b - o) / d
            begin, leave = max(begin, min(low, high)), min(leave, max(low, high))
    else:
        along = ox * dx + oy * dy + oz * dz
        px, py, pz = ox - along * dx, oy - along * dy, oz - along * dz
        rise = ONE / math.sqrt(shell * shell + extent * extent * (px * px + py * py + pz * pz))
    step, per_voxel = space.voxel * F(4), ONE / space.voxel
    begin -= jitter / F(space.fine) * step
    scales = shell * per_voxel, int(F(14) * extent / step) + 32, step, per_voxel * F(0.25), per_voxel, F(space.resolution) - F(1e-3)
    x, y, z = ox + begin * dx, oy + begin * dy, oz + begin * dz
    x, y, z = _contracted(space, _norm(shell, x, y, z), x, y, z)
    return Ray(ox, oy, oz, dx, dy, dz, leave, rise, *scales), Step(begin, begin, K.START - 1, x, y, z, x, y, z)


@njit(**K.INLINE)
def next_step(space: Any, bricks: Any, ray: Any, last: Any) -> Any:
    """The next coarse step beside something occupied, and whether there is one."""
    shell, step = space.shell, ray.step
    s, index, known = last.end, last.index + 1, True
    ax, ay, az = last.bx, last.by, last.bz
    while index < ray.longest:
        x, y, z = ray.ox + s * ray.dx, ray.oy + s * ray.dy, ray.oz + s * ray.dz
        n = _norm(shell, x, y, z)
        if shell == ZERO:
            if s >= ray.leave:
                break
            end = min(s + step, ray.leave)
        else:
            if n > ray.far:
                break
            end = s + step * min(max(n * n * ray.rise, ONE), K.STRETCH)
        if not known:
            ax, ay, az = _contracted(space, n, x, y, z)
        x, y, z = ray.ox + end * ray.dx, ray.oy + end * ray.dy, ray.oz + end * ray.dz
        bx, by, bz = _contracted(space, _norm(shell, x, y, z), x, y, z)
        gap = brick_distance(bricks, HALF * (ax + bx), HALF * (ay + by), HALF * (az + bz), ray.per_brick)
        if gap <= 1:
            return True, Step(s, end, index, ax, ay, az, bx, by, bz)
        # What is `gap` bricks away cannot be next to the middle of any of the following gap - 2 steps.
        known = gap == 2
        ax, ay, az = bx, by, bz
        s = end
        index += gap - 1
        if gap > 2:
            if shell == ZERO:
                s = end + F(gap - 2) * step
            else:
                for _ in range(gap - 2):
                    n = _norm(shell, ray.ox + s * ray.dx, ray.oy + s * ray.dy, ray.oz + s * ray.dz)
                    s += step * min(max(n * n * ray.rise, ONE), K.STRETCH)
    return False, Step(s, s, index, ax, ay, az, ax, ay, az)


@njit(**K.INLINE)
def place_at(ray: Any, step: Any, where: Any) -> Any:
    """Lattice coordinates at the part `where` of a step."""
    x = min(max((step.ax + (step.bx - step.ax) * where) * ray.per_voxel, ZERO), ray.most)
    y = min(max((step.ay + (step.by - step.ay) * where) * ray.per_voxel, ZERO), ray.most)
    z = min(max((step.az + (step.bz - step.az) * where) * ray.per_voxel, ZERO), ray.most)
    return x, y, z


@njit(**K.INLINE)
def fine_length(step: Any, per_fine: Any) -> Any:
    """Length of a fine step in contracted units."""
    x, y, z = step.bx - step.ax, step.by - step.ay, step.bz - step.az
    return math.sqrt(x * x + y * y + z * z) * per_fine


@njit(**K.INLINE)
def block_slot(space: Any, table: Any, x: Any, y: Any, z: Any) -> Any:
    """Slot of the block (x, y, z), counted from the table's first cell; −1 where there is none."""
    if 0 <= x < table.shape[2] and 0 <= y < table.shape[1] and 0 <= z < table.shape[0]:
        return np.int64(table[z, y, x])
    return np.int64(-1)


@njit(**K.INLINE)
def is_set(bits: Any, slot: Any, x: Any, y: Any, z: Any) -> Any:
    """Whether the voxel at lattice place (x, y, z) of block `slot` is occupied."""
    return (bits[np.uintp(slot), np.uintp(z & 7)] >> np.uint64((y & 7) * 8 + (x & 7))) & np.uint64(1) != 0


@njit(**K.LEAF)
def march_ray(
    space: Any, volume: Any, line: Any, jitter: Any, stop: Any, threshold: Any, marks: Any, first: Any, samples: Any, result: Any
) -> Any:
    """March one ray and store the samples whose weight exceeds `threshold`.

    Args:
        line, jitter: see `start_ray`.
        stop: the march ends once the transmittance is below.
        marks: (M · 512,) uint16 for `mark`, or of length 0. Of a ray that ends somewhere the strongest sample counts as seen fully: on a
            fine lattice a surface is several voxels thick and none of them may hold much weight.
        first: place of the ray's first sample among `samples`.
        result: (4,) float32 distance at which half of the light is stopped (0: never), transmittance left, samples looked up, coarse steps
            whose fine ones were tried.

    Returns:
        the place after the last stored sample.
    """
    half, fine, near = space.half, space.fine, space.near / space.half
    per_fine, unit = ONE / F(fine), space.voxel * F(4) / (TWO * space.extent)
    cells, all_rows, values = samples
    table, bits, density, upper, feature = volume.table, volume.bits, volume.density, volume.upper, volume.feature
    outer, marking, surrounded = volume.outer, marks.shape[0] > 0, volume.outer.table.shape[0] > 0
    kept, looked, walked = first, 0, 0
    depth, median = ZERO, ZERO  # optical depth so far
    transmittance = ONE
    lx, ly, lz = -1, -1, -1
    slot = np.int64(-1)
    strongest, strongest_cell = ZERO, K.START
    ray, step = start_ray(space, line, jitter)
    while transmittance >= stop:
        more, step = next_step(space, volume.bricks, ray, step)
        if not more:
            break
        if step.end <= near:
            continue
        walked += 1
        length, span = fine_length(step, per_fine), step.end - step.begin
        for index in range(fine):
            where = (F(index) + HALF) * per_fine
            x, y, z = place_at(ray, step, where)
            i, j, k = int(x), int(y), int(z)
            tx, ty, tz = (i >> 3) - space.ox, (j >> 3) - space.oy, (k >> 3) - space.oz
            if tx != lx or ty != ly or tz != lz:
                lx, ly, lz = tx, ty, tz
                slot = block_slot(space, table, tx, ty, tz)
            own = slot >= 0 and is_set(bits, slot, i, j, k)
            if own:
                cell = slot * 512 + ((k & 7) * 8 + (j & 7)) * 8 + (i & 7)
                if marking:
                    K.prefetch(marks, np.int64(cell))
                fx, fy, fz = x - F(i), y - F(j), z - F(k)
                raw = raw_density(density, upper, cell, fx, fy, fz)
            elif surrounded:
                x, y, z = x * outer.shrink, y * outer.shrink, z * outer.shrink
                i, j, k = int(x), int(y), int(z)
                around = block_slot(space, outer.table, (i >> 3) - outer.ox, (j >> 3) - outer.oy, (k >> 3) - outer.oz)
                if around < 0 or not is_set(outer.bits, around, i, j, k):
                    continue
                cell = around * 512 + ((k & 7) * 8 + (j & 7)) * 8 + (i & 7)
                fx, fy, fz = x - F(i), y - F(j), z - F(k)
                raw = raw_density(outer.density, outer.upper, cell, fx, fy, fz)
            else:
                continue
            tau = math.exp(min(raw, K.RAW_MAX)) * K.UNITS * length
            looked += 1
            depth += tau
            after = F(math.exp(-depth))
            weight = weight_of(transmittance, after, tau)
            if transmittance > HALF and after <= HALF:
                median = (step.begin + span * (F(index) + half_way(transmittance, after)) * per_fine) * half
            if marking:
                if own:
                    mark(marks, cell, weight)
                if weight > strongest:
                    strongest, strongest_cell = weight, cell if own else np.int64(-1)
            if weight > threshold and kept < cells.shape[0]:
                values[kept, K.X], values[kept, K.Y], values[kept, K.Z] = fx, fy, fz
                values[kept, K.RAW], values[kept, K.TAU] = raw, tau
                values[kept, K.WEIGHT], values[kept, K.AFTER] = weight, after
                values[kept, K.PLACE] = (F(step.index) + where) * unit
                values[kept, K.ALONG] = (step.begin + span * where) * half
                if own:
                    cells[kept] = cell
                    corner_rows(upper, cell, all_rows, kept)
                    for corner in range(8):
                        K.prefetch(feature, np.int64(all_rows[kept, corner]))
                else:
                    cells[kept] = -1 - cell
                    corner_rows(outer.upper, cell, all_rows, kept)
                    for corner in range(8):
                        K.prefetch(outer.feature, np.int64(all_rows[kept, corner]))
                kept += 1
            transmittance = after
            if transmittance < stop:
                break
    if marking and transmittance < K.SOLID and strongest_cell >= 0:
        mark_surface(marks, strongest_cell)
    result[0], result[1], result[2], result[3] = median, transmittance, F(looked), F(walked)
    return kept


@njit(**K.INLINE)
def weight_of(before: Any, after: Any, tau: Any) -> Any:
    """w = T (1 - exp(-τ)): from the difference of transmittances where it holds the digits, else from the series."""
    return before * tau * (ONE - tau * HALF * (ONE - tau * K.THIRD)) if tau < K.THIN else before - after


@njit(**K.INLINE)
def half_way(before: Any, after: Any) -> Any:
    """Part of a sample's interval at which the transmittance falls through ½ if its weight is spread evenly."""
    return (before - HALF) / (before - after)


@njit(**K.OPTIONS)
def mark_pass(space: Any, volume: Any, cameras: Any, poses: Any, first: Any, last: Any, stride: Any, stop: Any, marks: Any) -> None:
    """Mark what views `first` … `last` - 1 see, every `stride`-th pixel of a row, from row to row askew, so that none is far from all.

    Args:
        cameras: (N, 6) float32 fx, fy, cx, cy, width, height; poses: (N, 3, 4) float32; marks: (M · 512,) uint16, see `mark`.
    """
    samples = Samples(np.empty(0, np.int32), np.empty((0, 8), np.int32), np.empty((0, K.VALUES), np.float32))
    result, shift = np.empty(4, np.float32), int(ASKEW * stride)
    for view in range(first, last):
        camera, pose = cameras[view], poses[view]
        width, height = int(camera[4]), int(camera[5])
        for row in range(height):
            for column in range((view + row * shift) % stride, width, stride):
                x = (F(column) + HALF - camera[2]) / camera[0]
                y = (F(row) + HALF - camera[3]) / camera[1]
                dx = pose[0, 0] * x + pose[0, 1] * y + pose[0, 2]
                dy = pose[1, 0] * x + pose[1, 1] * y + pose[1, 2]
                dz = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2]
                scale = ONE / np.sqrt(dx * dx + dy * dy + dz * dz)
                line = pose[0, 3], pose[1, 3], pose[2, 3], dx * scale, dy * scale, dz * scale
                march_ray(space, volume, line, ZERO, stop, TWO, marks, K.START, samples, result)
