# mypy: disable-error-code="no-untyped-def,untyped-decorator,misc"
"""First hits of rays on convex solids on CUDA: every ray meets every solid, in one launch. Imported only there."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
import triton
import triton.language as tl
from torch import Tensor

from fieldfuse.backends.triton.launch import kernel

if TYPE_CHECKING:
    from fieldfuse.simulate.solids import Solids

BLOCK = 128


@triton.jit
def _slab(start, slope, half, PARALLEL: tl.constexpr):
    """Entry and exit of the space between −half and half along one axis."""
    inverse = 1 / tl.maximum(tl.abs(slope), PARALLEL)
    middle = -start * tl.where(slope < 0, -inverse, inverse)
    return middle - inverse * half, middle + inverse * half


@triton.jit
def _own(x, y, z, turn):
    """Vectors in a solid's own axes."""
    a = x * tl.load(turn) + y * tl.load(turn + 3) + z * tl.load(turn + 6)
    b = x * tl.load(turn + 1) + y * tl.load(turn + 4) + z * tl.load(turn + 7)
    c = x * tl.load(turn + 2) + y * tl.load(turn + 5) + z * tl.load(turn + 8)
    return a, b, c


@triton.jit
def _met(centre, half, rotation, solid, ox, oy, oz, dx, dy, dz, KIND: tl.constexpr, FAR: tl.constexpr, NEAREST: tl.constexpr):
    """Distance to one solid; KIND: 0 box, 1 room, 2 ball, 3 cylinder."""
    turn = rotation + 9 * solid
    hx, hy, hz = tl.load(half + 3 * solid), tl.load(half + 3 * solid + 1), tl.load(half + 3 * solid + 2)
    gx, gy, gz = ox - tl.load(centre + 3 * solid), oy - tl.load(centre + 3 * solid + 1), oz - tl.load(centre + 3 * solid + 2)
    sx, sy, sz = _own(gx, gy, gz, turn)
    rx, ry, rz = _own(dx, dy, dz, turn)
    if KIND < 2:
        enter, leave = _slab(sx, rx, hx, 1e-8)
        near, far = _slab(sy, ry, hy, 1e-8)
        enter, leave = tl.maximum(enter, near), tl.minimum(leave, far)
        near, far = _slab(sz, rz, hz, 1e-8)
        enter, leave = tl.maximum(enter, near), tl.minimum(leave, far)
        reached = tl.where(KIND == 0, enter, leave)
        return tl.where((enter <= leave) & (reached > NEAREST), reached, FAR)
    sx, sy, rx, ry = sx / hx, sy / hy, rx / hx, ry / hy
    length, along = rx * rx + ry * ry, sx * rx + sy * ry
    if KIND == 2:
        sz, rz = sz / hz, rz / hz
        length += rz * rz
        along += sz * rz
    length = tl.maximum(length, 1e-12)
    closest = -along / length
    mx, my = sx + closest * rx, sy + closest * ry
    miss = mx * mx + my * my
    if KIND == 2:
        mz = sz + closest * rz
        miss += mz * mz
    reach = tl.sqrt(tl.maximum(1 - miss, 0.0) / length)
    enter, leave = closest - reach, closest + reach
    hit = miss < 1
    if KIND == 3:
        near, far = _slab(sz, rz, hz, 1e-8)
        enter, leave = tl.maximum(enter, near), tl.minimum(leave, far)
        hit = hit & (enter <= leave)
    return tl.where(hit & (enter > NEAREST), enter, FAR)


@kernel("directions", "distance", "number")
def _cast(
    origins, directions, centre, half, rotation, distance, number, rays, boxes, rooms, balls, solids,
    SHARED: tl.constexpr, FAR: tl.constexpr, NEAREST: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Boxes are the solids up to `boxes`, then come rooms up to `rooms`, balls up to `balls` and cylinders up to `solids`."""
    n = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    some = n < rays
    dx, dy = tl.load(directions + 3 * n, some, 0.0), tl.load(directions + 3 * n + 1, some, 0.0)
    dz = tl.load(directions + 3 * n + 2, some, 1.0)
    start = n * 0 if SHARED else n
    ox, oy = tl.load(origins + 3 * start, some, 0.0), tl.load(origins + 3 * start + 1, some, 0.0)
    oz = tl.load(origins + 3 * start + 2, some, 0.0)
    best = tl.full((BLOCK,), FAR, tl.float32)
    which = tl.full((BLOCK,), -1, tl.int64)
    solid = 0
    while solid < boxes:
        t = _met(centre, half, rotation, solid, ox, oy, oz, dx, dy, dz, 0, FAR, NEAREST)
        best, which, solid = tl.minimum(t, best), tl.where(t < best, solid, which), solid + 1
    while solid < rooms:
        t = _met(centre, half, rotation, solid, ox, oy, oz, dx, dy, dz, 1, FAR, NEAREST)
        best, which, solid = tl.minimum(t, best), tl.where(t < best, solid, which), solid + 1
    while solid < balls:
        t = _met(centre, half, rotation, solid, ox, oy, oz, dx, dy, dz, 2, FAR, NEAREST)
        best, which, solid = tl.minimum(t, best), tl.where(t < best, solid, which), solid + 1
    while solid < solids:
        t = _met(centre, half, rotation, solid, ox, oy, oz, dx, dy, dz, 3, FAR, NEAREST)
        best, which, solid = tl.minimum(t, best), tl.where(t < best, solid, which), solid + 1
    tl.store(distance + n, best, some)
    tl.store(number + n, which, some)


def cast(solids: Solids, origins: Tensor, directions: Tensor, far: float, nearest: float) -> tuple[Tensor, Tensor]:
    """See `cast.cast`."""
    distance = directions.new_empty(len(directions))
    number = torch.empty(len(directions), dtype=torch.int64, device=directions.device)
    if len(directions):
        ends = [solids.ranges[kind][1] for kind in ("box", "room", "ball", "cylinder")]
        _cast[(triton.cdiv(len(directions), BLOCK),)](
            origins.contiguous(), directions.contiguous(), solids.centre, solids.half, solids.rotation, distance, number, len(directions),
            *ends, SHARED=len(origins) == 1, FAR=far, NEAREST=nearest, BLOCK=BLOCK,
        )  # fmt: skip
    return distance, number
