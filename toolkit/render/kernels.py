"""The CPU fast path's building blocks, compiled by numba: one ray through a sparse field, in float32 scalars and short rows.

Everything here has a twin in torch (`march.py`, `lookup.py`, `decoder.py`) that is the reference; tests compare the two. Compiled
functions are cached on disk. Numba turns an `int * float32` and every Python literal into float64, hence the explicit F(...).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, cast

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

from toolkit.networks.encoding import SH
from toolkit.render.composite import RAW_MAX, SOLID, UNITS
from toolkit.render.march import MAX_STRETCH

F = np.float32
# Sums may be reordered and multiplications fused; NaN and infinity keep their meaning, so that a broken number is seen.
MATHS = {"contract", "reassoc", "nsz", "arcp", "afn"}
OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "fastmath": MATHS, "error_model": "numpy", "boundscheck": False}

ZERO, HALF, ONE, TWO = F(0), F(0.5), F(1), F(2)
_SOLID = F(SOLID)
_RAW_MAX, _UNITS, _STRETCH = F(RAW_MAX), F(UNITS), F(MAX_STRETCH)
_C0, _C1, _C2, _C3, _C4 = (F(value) for value in SH)
_THIN = F(0.01)  # below this optical thickness 1 - exp(-τ) is taken from its series: the difference would lose digits
_THIRD = F(1 / 3)
LINE = 64  # bytes of a cache line
VALUES = 8  # columns of a sample's floats
PADDED = 16  # inputs of the decoder beside the features: nine harmonics, and zeros that make a round number
X, Y, Z, RAW, TAU, WEIGHT, AFTER, PLACE = range(VALUES)  # AFTER: transmittance behind the sample


def _prefetch(context: Any, array: Any, index: Any, half: bool) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind = signature.args[0]
        view = context.make_array(kind)(context, builder, arguments[0])
        width = cgutils.unpack_tuple(builder, view.shape, kind.ndim)[-1] if kind.ndim == 2 else ir.Constant(ir.IntType(64), 1)
        offset = builder.mul(arguments[1], width)
        if half:
            offset = builder.add(offset, builder.lshr(width, ir.Constant(ir.IntType(64), 1)))
        pointer = builder.bitcast(builder.gep(view.data, [offset]), ir.IntType(8).as_pointer())
        number = ir.IntType(32)
        shape = ir.FunctionType(ir.VoidType(), [pointer.type, number, number, number])
        function = cgutils.get_or_insert_function(builder.module, shape, "llvm.prefetch.p0i8")
        builder.call(function, [pointer, number(0), number(3), number(1)])
        return context.get_dummy_value()

    return types.void(array, types.int64), generate


@cast(Any, intrinsic)
def prefetch(context: Any, array: Any, index: Any) -> Any:
    """Ask for the cache line of array[index] or array[index, 0] without waiting for it: memory latency is most of what a ray costs."""
    return _prefetch(context, array, index, False)


@cast(Any, intrinsic)
def prefetch_half(context: Any, array: Any, index: Any) -> Any:
    """The same for the middle of row `index`: a row of 2 C floats is two lines long."""
    return _prefetch(context, array, index, True)


def aligned(shape: tuple[int, ...], dtype: Any, zeroed: bool = False) -> np.ndarray[Any, Any]:
    """An array that starts at a cache line, so that a row of 16 floats is one line and not parts of two."""
    count = math.prod(shape) * np.dtype(dtype).itemsize
    raw = (np.zeros if zeroed else np.empty)(count + LINE, np.uint8)
    start = -raw.ctypes.data % LINE
    return raw[start : start + count].view(dtype).reshape(shape)


class Space(NamedTuple):
    """Scalars of a field: see `volume.space.Space` and `march.MarchGrid`."""

    cx: Any
    cy: Any
    cz: Any
    half: Any
    shell: Any
    extent: Any
    bx: Any
    by: Any
    bz: Any
    voxel: Any
    near: Any
    fine: Any  # int
    resolution: Any  # int
    ox: Any  # table origin, ints
    oy: Any
    oz: Any
    width: Any  # tuple with an entry a channel: its length is known to the compiler, which then unrolls
    hidden: Any  # the same for the decoder's hidden width
    inputs: Any  # and for its inputs


class Volume(NamedTuple):
    """Arrays of a field, all of them views of the field's own tensors but `bits`, `bricks` and `upper`."""

    table: Any  # (Sz, Sy, Sx) int32 slot or −1
    bricks: Any  # (B, B, B) uint8 distance in bricks to the nearest occupied brick, with a margin of one
    bits: Any  # (M, 8) uint64 occupancy, one word a z-slice
    upper: Any  # (M, 8) int32 blocks at +x, +y, +z combinations, bit 0 x, bit 1 y, bit 2 z; M where absent
    density: Any  # (M · 512 + 1,) float32
    feature: Any  # (M · 512 + 1, C) float32


class Decoder(NamedTuple):
    """The deferred decoder's weights, as sums over whichever index the compiler is to vectorise need them.

    Inputs are C mean features, nine harmonics and seven zeros: I = C + 16.
    """

    w1: Any  # (I, H)
    w1_out: Any  # (H, I), the same transposed
    b1: Any
    w2: Any  # (H, H)
    w2_out: Any
    b2: Any
    w3: Any  # (3, H)
    b3: Any


@njit(**OPTIONS)
def corner_rows(upper: Any, cell: Any, rows: Any) -> None:
    """The eight lattice corners of voxel `cell` into rows[0 … 7], x fastest; an absent block's corner is the zero row."""
    slot, local = cell >> 9, cell & 511
    x, y, z = local & 7, (local >> 3) & 7, local >> 6
    if x < 7 and y < 7 and z < 7:
        rows[0], rows[1], rows[2], rows[3] = cell, cell + 1, cell + 8, cell + 9
        rows[4], rows[5], rows[6], rows[7] = cell + 64, cell + 65, cell + 72, cell + 73
        return
    zero_row = upper.shape[0] * 512
    for corner in range(8):
        u, v, w = x + (corner & 1), y + ((corner >> 1) & 1), z + (corner >> 2)
        block = upper[slot, (u >> 3) | ((v >> 3) << 1) | ((w >> 3) << 2)]
        rows[corner] = min(block * 512 + ((w & 7) * 8 + (v & 7)) * 8 + (u & 7), zero_row)


@njit(**OPTIONS)
def corner_rows_of(upper: Any, cell: Any, rows: Any, index: Any) -> None:
    """`corner_rows` into rows[index, 0 … 7]."""
    slot, local = cell >> 9, cell & 511
    x, y, z = local & 7, (local >> 3) & 7, local >> 6
    if x < 7 and y < 7 and z < 7:
        rows[index, 0], rows[index, 1], rows[index, 2], rows[index, 3] = cell, cell + 1, cell + 8, cell + 9
        rows[index, 4], rows[index, 5], rows[index, 6], rows[index, 7] = cell + 64, cell + 65, cell + 72, cell + 73
        return
    zero_row = upper.shape[0] * 512
    for corner in range(8):
        u, v, w = x + (corner & 1), y + ((corner >> 1) & 1), z + (corner >> 2)
        block = upper[slot, (u >> 3) | ((v >> 3) << 1) | ((w >> 3) << 2)]
        rows[index, corner] = min(block * 512 + ((w & 7) * 8 + (v & 7)) * 8 + (u & 7), zero_row)


@njit(**OPTIONS)
def corner_weights(x: Any, y: Any, z: Any, weights: Any) -> None:
    """Trilinear weights of the place (x, y, z) in a voxel, in the order of `corner_rows`."""
    a, b, c = ONE - x, ONE - y, ONE - z
    weights[0], weights[1], weights[2], weights[3] = a * b * c, x * b * c, a * y * c, x * y * c
    weights[4], weights[5], weights[6], weights[7] = a * b * z, x * b * z, a * y * z, x * y * z


@njit(**OPTIONS)
def raw_density(volume: Any, cell: Any, x: Any, y: Any, z: Any) -> Any:
    """Trilinear raw density in voxel `cell`."""
    slot, local = cell >> 9, cell & 511
    u, v, w = local & 7, (local >> 3) & 7, local >> 6
    d = volume.density
    if u < 7 and v < 7 and w < 7:
        p0, p1, p2, p3 = d[cell], d[cell + 8], d[cell + 64], d[cell + 72]
        q0, q1, q2, q3 = d[cell + 1], d[cell + 9], d[cell + 65], d[cell + 73]
    else:
        up = volume.upper
        zero_row = up.shape[0] * 512
        hx, hy, hz = (u + 1) >> 3, (v + 1) >> 3, (w + 1) >> 3
        x1, y0, y1, z0, z1 = (u + 1) & 7, v * 8, ((v + 1) & 7) * 8, w * 64, ((w + 1) & 7) * 64
        p0, q0 = d[cell], d[min(up[slot, hx] * 512 + z0 + y0 + x1, zero_row)]
        p1, q1 = d[min(up[slot, hy * 2] * 512 + z0 + y1 + u, zero_row)], d[min(up[slot, hy * 2 + hx] * 512 + z0 + y1 + x1, zero_row)]
        p2, q2 = d[min(up[slot, hz * 4] * 512 + z1 + y0 + u, zero_row)], d[min(up[slot, hz * 4 + hx] * 512 + z1 + y0 + x1, zero_row)]
        p3 = d[min(up[slot, hz * 4 + hy * 2] * 512 + z1 + y1 + u, zero_row)]
        q3 = d[min(up[slot, hz * 4 + hy * 2 + hx] * 512 + z1 + y1 + x1, zero_row)]
    p0 += x * (q0 - p0)
    p1 += x * (q1 - p1)
    p2 += x * (q2 - p2)
    p3 += x * (q3 - p3)
    p0 += y * (p1 - p0)
    p2 += y * (p3 - p2)
    return p0 + z * (p2 - p0)


@njit(**OPTIONS)
def gather_feature(width: Any, feature: Any, rows: Any, x: Any, y: Any, z: Any, weights: Any, out: Any) -> None:
    """Trilinear feature of the corners rows (8,) into out[:C]; weights (8,) are left for the caller."""
    corner_weights(x, y, z, weights)
    r0, r1, r2, r3, r4, r5, r6, r7 = rows[0], rows[1], rows[2], rows[3], rows[4], rows[5], rows[6], rows[7]
    w0, w1, w2, w3 = weights[0], weights[1], weights[2], weights[3]
    w4, w5, w6, w7 = weights[4], weights[5], weights[6], weights[7]
    for c in range(len(width)):
        low = w0 * feature[r0, c] + w1 * feature[r1, c] + w2 * feature[r2, c] + w3 * feature[r3, c]
        out[c] = low + w4 * feature[r4, c] + w5 * feature[r5, c] + w6 * feature[r6, c] + w7 * feature[r7, c]


@njit(**OPTIONS)
def gather_row(width: Any, feature: Any, rows: Any, values: Any, weights: Any, out: Any, index: Any) -> None:
    """`gather_feature` of sample `index`: rows, weights (S, 8), values (S, 8), out (S, C).

    Rows are never taken as arrays of their own inside a loop over samples: each such view is counted, by an atomic operation.
    """
    x, y, z = values[index, X], values[index, Y], values[index, Z]
    a, b, c = ONE - x, ONE - y, ONE - z
    w0, w1, w2, w3 = a * b * c, x * b * c, a * y * c, x * y * c
    w4, w5, w6, w7 = a * b * z, x * b * z, a * y * z, x * y * z
    weights[index, 0], weights[index, 1], weights[index, 2], weights[index, 3] = w0, w1, w2, w3
    weights[index, 4], weights[index, 5], weights[index, 6], weights[index, 7] = w4, w5, w6, w7
    r0, r1, r2, r3 = rows[index, 0], rows[index, 1], rows[index, 2], rows[index, 3]
    r4, r5, r6, r7 = rows[index, 4], rows[index, 5], rows[index, 6], rows[index, 7]
    for k in range(len(width)):
        low = w0 * feature[r0, k] + w1 * feature[r1, k] + w2 * feature[r2, k] + w3 * feature[r3, k]
        out[index, k] = low + w4 * feature[r4, k] + w5 * feature[r5, k] + w6 * feature[r6, k] + w7 * feature[r7, k]


@njit(**OPTIONS)
def mark(marks: Any, cell: Any, weight: Any) -> None:
    """Remember of a voxel the largest weight it was seen with (12 bits) and how often it was visited (4 bits, saturating)."""
    old = np.uint32(marks[cell])
    level = max(old >> np.uint32(4), np.uint32(min(weight * F(4095), F(4095))))
    marks[cell] = np.uint16((level << np.uint32(4)) | min((old & np.uint32(15)) + np.uint32(1), np.uint32(15)))


@njit(**OPTIONS)
def mark_surface(marks: Any, cell: Any) -> None:
    """Remember a voxel as seen with all the light there is."""
    marks[cell] = np.uint16(np.uint32(marks[cell]) | np.uint32(0xFFF0))


@njit(**OPTIONS)
def brick_distance(bricks: Any, x: Any, y: Any, z: Any, scale: Any) -> Any:
    """Distance in bricks from a place in lattice-cube coordinates (0 at its low corner) to the nearest occupied brick."""
    top = bricks.shape[0] - 1
    i = min(max(int(x * scale + ONE), 0), top)
    j = min(max(int(y * scale + ONE), 0), top)
    k = min(max(int(z * scale + ONE), 0), top)
    return int(bricks[k, j, i])


@njit(**OPTIONS)
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
        cells: (S,) int32, all_rows: (S, 8) int32 corners, values: (S, 8) float32: the kept samples.
        result: (3,) float32 distance at which half of the light is stopped (0: never), transmittance left, samples looked up.

    Returns:
        number of kept samples.
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
    kept, looked = 0, 0
    depth, median = ZERO, ZERO  # optical depth so far
    transmittance = ONE
    step_index = 0
    unit = step / (TWO * extent)
    table = volume.table
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
            s1 = s + step * min(max(n * n * rise, ONE), _STRETCH)
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
        gap = brick_distance(volume.bricks, HALF * (p0x + p1x), HALF * (p0y + p1y), HALF * (p0z + p1z), per_brick)
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
                        s += step * min(max(n * n * rise, ONE), _STRETCH)
                        step_index += 1
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
                fx, fy, fz = x - F(i), y - F(j), z - F(k)
                raw = raw_density(volume, cell, fx, fy, fz)
                tau = math.exp(min(raw, _RAW_MAX)) * _UNITS * length
                looked += 1
                depth += tau
                after = F(math.exp(-depth))
                # w = T (1 - exp(-τ)): from the difference where it holds the digits, else from the series
                weight = transmittance - after
                if tau < _THIN:
                    weight = transmittance * tau * (ONE - tau * HALF * (ONE - tau * _THIRD))
                if transmittance > HALF and after <= HALF:  # T e^{-p τ} = ½ within the sample's interval
                    part = math.log(TWO * transmittance) / max(tau, F(1e-12))
                    median = (s + (s1 - s) * (F(index) + part) * per_fine) * half
                if marking:
                    mark(marks, cell, weight)
                    if weight > strongest:
                        strongest, strongest_cell = weight, cell
                if weight > threshold and kept < cells.shape[0]:
                    cells[kept] = cell
                    corner_rows_of(volume.upper, cell, all_rows, kept)
                    values[kept, X], values[kept, Y], values[kept, Z] = fx, fy, fz
                    values[kept, RAW], values[kept, TAU] = raw, tau
                    values[kept, WEIGHT], values[kept, AFTER] = weight, after
                    values[kept, PLACE] = (F(step_index) + where) * unit
                    for corner in range(8):
                        prefetch(volume.feature, np.int64(all_rows[kept, corner]))
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
    if marking and transmittance < _SOLID:
        mark_surface(marks, strongest_cell)
    result[0], result[1], result[2] = median, transmittance, F(looked)
    return kept


@njit(**OPTIONS)
def encode_direction(x: Any, y: Any, z: Any, out: Any) -> None:
    """Spherical harmonics up to degree 2 into out[0 … 8]; see `networks.encoding.spherical_harmonics`."""
    out[0], out[1], out[2], out[3] = _C0, -_C1 * y, _C1 * z, -_C1 * x
    out[4], out[5], out[6] = _C2 * x * y, -_C2 * y * z, _C3 * (F(3) * z * z - ONE)
    out[7], out[8] = -_C2 * x * z, _C4 * (x * x - y * y)


@njit(**OPTIONS)
def sigmoid(value: Any) -> Any:
    """1 / (1 + e^{-v}) without overflow."""
    return ONE / (ONE + math.exp(-min(max(value, F(-80)), F(80))))


@njit(**OPTIONS)
def multiply(rows: Any, columns: Any, matrix: Any, given: Any, out: Any) -> None:
    """out[j] = Σ_i matrix[j, i] given[i]; four sums at a time, which the compiler turns into seven times faster code than one."""
    n = len(columns)
    whole = len(rows) // 4 * 4
    for j in range(0, whole, 4):
        a, b, c, d = ZERO, ZERO, ZERO, ZERO
        for i in range(n):
            value = given[i]
            a += value * matrix[j, i]
            b += value * matrix[j + 1, i]
            c += value * matrix[j + 2, i]
            d += value * matrix[j + 3, i]
        out[j], out[j + 1], out[j + 2], out[j + 3] = a, b, c, d
    for j in range(whole, len(rows)):
        a = ZERO
        for i in range(n):
            a += given[i] * matrix[j, i]
        out[j] = a


@njit(**OPTIONS)
def decode(space: Any, decoder: Any, given: Any, h1: Any, h2: Any, colour: Any) -> None:
    """`Deferred.forward` of one ray: given (I,) mean features, encoded direction and zeros → h1, h2 (H,) hidden layers and colour (3,)."""
    hidden = len(space.hidden)
    multiply(space.hidden, space.inputs, decoder.w1_out, given, h1)
    for j in range(hidden):
        h1[j] = max(h1[j] + decoder.b1[j], ZERO)
    multiply(space.hidden, space.hidden, decoder.w2_out, h1, h2)
    a, b, c = ZERO, ZERO, ZERO
    for j in range(hidden):
        value = max(h2[j] + decoder.b2[j], ZERO)
        h2[j] = value
        a += value * decoder.w3[0, j]
        b += value * decoder.w3[1, j]
        c += value * decoder.w3[2, j]
    colour[0] = sigmoid(given[0] + a + decoder.b3[0])
    colour[1] = sigmoid(given[1] + b + decoder.b3[1])
    colour[2] = sigmoid(given[2] + c + decoder.b3[2])
