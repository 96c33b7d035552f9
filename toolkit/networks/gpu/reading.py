# mypy: disable-error-code="no-untyped-def,untyped-decorator,misc"
"""What sweeps and witnesses are asked on CUDA: tables read between pixels and planes (`Sweep.look`, `witness.py` in tensors)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from toolkit.gpu import kernel
from toolkit.networks.gpu import matching

BLOCK = 128
TILE = (16, 32)  # rays and planes at once


@triton.jit
def _axes(pose):
    """The nine numbers of a camera's rotation and the three of its place."""
    return (
        tl.load(pose), tl.load(pose + 1), tl.load(pose + 2), tl.load(pose + 4), tl.load(pose + 5), tl.load(pose + 6),
        tl.load(pose + 8), tl.load(pose + 9), tl.load(pose + 10), tl.load(pose + 3), tl.load(pose + 7), tl.load(pose + 11),
    )  # fmt: skip


@triton.jit
def local(x, y, z, pose):
    """Places of the working frame in a camera's axes."""
    r00, r01, r02, r10, r11, r12, r20, r21, r22, px, py, pz = _axes(pose)
    x, y, z = x - px, y - py, z - pz
    return x * r00 + y * r10 + z * r20, x * r01 + y * r11 + z * r21, x * r02 + y * r12 + z * r22


@triton.jit
def _bounded(value, count):
    """A place along an axis (0: the middle of its first entry) kept inside, its lower entry and how far it is to the next."""
    value = tl.minimum(tl.maximum(value, 0.0), count - 1.0)
    low = tl.floor(value)
    at = low.to(tl.int32)
    return at, tl.minimum(at + 1, count - 1), value - low


@triton.jit
def _between(table, left, right, fx, top, below, fy, low, high, fz, width, planes, mask, STRIDE: tl.constexpr):
    """Trilinear value of (h, w, D, STRIDE)."""
    near = tl.load(table + ((top * width + left) * planes + low) * STRIDE, mask, 0.0) * (1 - fx) * (1 - fy) * (1 - fz)
    near += tl.load(table + ((top * width + right) * planes + low) * STRIDE, mask, 0.0) * fx * (1 - fy) * (1 - fz)
    near += tl.load(table + ((below * width + left) * planes + low) * STRIDE, mask, 0.0) * (1 - fx) * fy * (1 - fz)
    near += tl.load(table + ((below * width + right) * planes + low) * STRIDE, mask, 0.0) * fx * fy * (1 - fz)
    near += tl.load(table + ((top * width + left) * planes + high) * STRIDE, mask, 0.0) * (1 - fx) * (1 - fy) * fz
    near += tl.load(table + ((top * width + right) * planes + high) * STRIDE, mask, 0.0) * fx * (1 - fy) * fz
    near += tl.load(table + ((below * width + left) * planes + high) * STRIDE, mask, 0.0) * (1 - fx) * fy * fz
    near += tl.load(table + ((below * width + right) * planes + high) * STRIDE, mask, 0.0) * fx * fy * fz
    return near


@triton.jit
def sighted(x, y, z, truncation, table, pose, lens, size, height, width, planes, lowest, step, some):
    """Signed distance, openness and sureness of places of the working frame, as `Sighted`."""
    x, y, z = local(x, y, z, pose)
    depth = tl.maximum(z, 1e-6)
    u = (x / depth * tl.load(lens) + tl.load(lens + 2)) / tl.load(size) * width - 0.5
    v = (y / depth * tl.load(lens + 1) + tl.load(lens + 3)) / tl.load(size + 1) * height - 0.5
    left, right, fx = _bounded(u, width)
    top, below, fy = _bounded(v, height)
    inverse = 1 / depth
    half = inverse * tl.minimum(truncation / depth, 0.9)
    near, far = (inverse + half - lowest) / step, (inverse - half - lowest) / step
    low, high, fz = _bounded(near, planes)
    hidden = _between(table, left, right, fx, top, below, fy, low, high, fz, width, planes, some, 3)
    upper = _between(table + 1, left, right, fx, top, below, fy, low, high, fz, width, planes, some, 3) - tl.maximum(-near, 0.0) * step
    sure = _between(table + 2, left, right, fx, top, below, fy, low, high, fz, width, planes, some, 3)
    low, high, fz = _bounded(far, planes)
    lower = _between(table + 1, left, right, fx, top, below, fy, low, high, fz, width, planes, some, 3) - tl.maximum(-far, 0.0) * step
    signed = tl.minimum(tl.maximum(1 - (upper - lower) / half, -1.0), 1.0)
    return signed, tl.minimum(tl.maximum(1 - hidden, 0.0), 1.0), tl.minimum(tl.maximum(sure, 0.0), 1.0)


@kernel("points", "table", "out")
def _look(points, truncation, table, pose, lens, size, out, count, height, width, planes, lowest, step, BLOCK: tl.constexpr):
    n = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    some = n < count
    x, y, z = tl.load(points + 3 * n, some, 0.0), tl.load(points + 3 * n + 1, some, 0.0), tl.load(points + 3 * n + 2, some, 1.0)
    cut = tl.load(truncation + n, some, 1.0)
    signed, clear, sure = sighted(x, y, z, cut, table, pose, lens, size, height, width, planes, lowest, step, some)
    tl.store(out + n, signed, some)
    tl.store(out + count + n, clear, some)
    tl.store(out + 2 * count + n, sure, some)


def look(points: Tensor, truncation: Tensor, table: Tensor, camera: Any, lowest: float, step: float) -> Tensor:
    """(3, N): what `Sweep.look` says of voxels (N, 3) with a truncation (N,) each, from a table (3, D, h, w) of `matching.table`."""
    rows = table.permute(2, 3, 1, 0).contiguous()
    height, width, planes = rows.shape[:3]
    count = len(points)
    out = points.new_empty((3, count))
    if count:
        points, truncation, pose, lens, size = (
            values.contiguous() for values in (points, truncation, camera.world_from_camera, camera.intrinsics, camera.size)
        )
        _look[(triton.cdiv(count, BLOCK),)](
            points, truncation, rows, pose, lens, size, out, count, height, width, planes, lowest, step, BLOCK=BLOCK
        )
    return out


@triton.jit
def _asked(x, y, z, says, pose, lens, size, height, width, planes, lowest, step, mask):
    """What a witness says of places, and whether it sees them."""
    x, y, z = local(x, y, z, pose)
    seen = (z > 1e-4) & mask
    inverse = 1 / tl.where(seen, z, 1.0)
    u = (x * inverse * tl.load(lens) + tl.load(lens + 2)) / tl.load(size)
    v = (y * inverse * tl.load(lens + 1) + tl.load(lens + 3)) / tl.load(size + 1)
    seen = seen & (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1)
    left, right, fx = _bounded(tl.where(seen, u, 0.0) * width - 0.5, width)
    top, below, fy = _bounded(tl.where(seen, v, 0.0) * height - 0.5, height)
    low, high, fz = _bounded((inverse - lowest) / step, planes)
    return _between(says, left, right, fx, top, below, fy, low, high, fz, width, planes, seen, 1), seen


@kernel("points", "says")
def _confirmed(points, says, pose, lens, size, out, count, height, width, planes, lowest, step, BLOCK: tl.constexpr):
    """Sums of what is said of places and of how many are seen, one pair a block. Places that are not numbers are not seen."""
    n = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    some = n < count
    x, y, z = tl.load(points + 3 * n, some, 0.0), tl.load(points + 3 * n + 1, some, 0.0), tl.load(points + 3 * n + 2, some, 0.0)
    said, seen = _asked(x, y, z, says, pose, lens, size, height, width, planes, lowest, step, some)
    tl.store(out + 2 * tl.program_id(0), tl.sum(tl.where(seen, said, 0.0), 0))
    tl.store(out + 2 * tl.program_id(0) + 1, tl.sum(seen.to(tl.float32), 0))


@kernel("says", "total", "count")
def _add(
    rays, inverses, origin, says, pose, lens, size, beliefs, number, witnesses, total, count, rows, asked, height, width, planes, lowest,
    step, BP: tl.constexpr, BD: tl.constexpr,
):  # fmt: skip
    """One more witness's part of what is said along rays; the last one makes it the mean."""
    p = tl.program_id(0) * BP + tl.arange(0, BP)
    d = tl.program_id(1) * BD + tl.arange(0, BD)
    is_row = p < rows
    inside = is_row[:, None] & (d < asked)[None, :]
    far = 1 / tl.load(inverses + d, d < asked, 1.0)[None, :]
    x = tl.load(rays + 3 * p, is_row, 0.0)[:, None] * far + tl.load(origin)
    y = tl.load(rays + 3 * p + 1, is_row, 0.0)[:, None] * far + tl.load(origin + 1)
    z = tl.load(rays + 3 * p + 2, is_row, 0.0)[:, None] * far + tl.load(origin + 2)
    said, seen = _asked(x, y, z, says, pose, lens, size, height, width, planes, lowest, step, inside)
    place = p[:, None] * asked + d[None, :]
    added, looked = tl.where(seen, said * tl.load(beliefs + number), 0.0), seen.to(tl.float32)
    added += tl.load(total + place, inside & (number > 0), 0.0)
    looked += tl.load(count + place, inside & (number > 0), 0.0)
    tl.store(total + place, tl.where(number + 1 == witnesses, added / tl.maximum(looked, 1.0), added), inside)
    tl.store(count + place, looked, inside)


def _of(witness: Any) -> tuple[Any, ...]:
    """A witness's numbers (h, w, D), camera and shape."""
    says = witness.says.permute(1, 2, 0).contiguous()
    camera = witness.camera
    return says, camera.world_from_camera.contiguous(), camera.intrinsics.contiguous(), camera.size.contiguous(), says.shape


def confirmed(witnesses: Sequence[Any], points: Tensor) -> Tensor:
    """(W, 2): for each witness the sum of what it says of places (N, 3), and how many of them it sees."""
    blocks = max(1, triton.cdiv(len(points), BLOCK))
    out, points = points.new_empty((len(witnesses), blocks, 2)), points.contiguous()
    for number, one in enumerate(witnesses):
        says, pose, lens, size, shape = _of(one)
        _confirmed[(blocks,)](points, says, pose, lens, size, out[number], len(points), *shape, one.lowest, one.step, BLOCK=BLOCK)
    return out.sum(1)


def mean(rays: Tensor, inverses: Tensor, origin: Tensor, witnesses: Sequence[Any], beliefs: Tensor) -> Tensor:
    """(P, D) what witnesses that look there say in the mean, times how far each is believed (W,), along rays (P, 3) at (D,)."""
    total = rays.new_empty((len(rays), len(inverses)))
    count = torch.empty_like(total)
    rays, origin, beliefs = rays.contiguous(), origin.contiguous(), beliefs.contiguous()
    grid = (triton.cdiv(len(rays), TILE[0]), triton.cdiv(len(inverses), TILE[1]))
    for number, one in enumerate(witnesses):
        says, pose, lens, size, shape = _of(one)
        _add[grid](
            rays, inverses, origin, says, pose, lens, size, beliefs, number, len(witnesses), total, count, len(rays), len(inverses), *shape,
            one.lowest, one.step, BP=TILE[0], BD=TILE[1],
        )  # fmt: skip
    return total


@kernel("table", "out")
def _witness(table, out, pixels, planes, gain, against, ABOUT: tl.constexpr, BP: tl.constexpr, BD: tl.constexpr):
    p = (tl.program_id(0) * BP + tl.arange(0, BP)).to(tl.int64)[:, None]
    d = tl.arange(0, BD)[None, :]
    inside = (p < pixels) & (d < planes)
    row = p * planes + d
    hidden = tl.load(table + 3 * (row + ABOUT), (p < pixels) & (d + ABOUT < planes), 0.0)
    not_free = tl.load(table + 3 * (row - ABOUT), (p < pixels) & (d >= ABOUT) & (d < planes), 1.0)
    tl.store(out + row, tl.log(gain * tl.maximum(not_free - hidden, 0.0) + hidden + against), inside)


def says(table: Tensor, gain: float, against: float, about: int) -> Tensor:
    """(D, h, w) of `Witness` from the table (3, D, h, w) of a sweep."""
    rows = table.permute(2, 3, 1, 0).contiguous()
    height, width, planes = rows.shape[:3]
    out = rows.new_empty((height, width, planes))
    grid = (triton.cdiv(height * width, matching.PIXELS),)
    sizes = {"ABOUT": about, "BP": matching.PIXELS, "BD": matching.wide(planes)}
    _witness[grid](rows, out, height * width, planes, gain, against, **sizes)
    return out.permute(2, 0, 1)


@kernel("table", "rays", "out")
def _surest(table, rays, inverses, origin, out, pixels, planes, least, BP: tl.constexpr, BD: tl.constexpr):
    p = tl.program_id(0) * BP + tl.arange(0, BP)
    d = tl.arange(0, BD)[None, :]
    some = p < pixels
    row = p[:, None].to(tl.int64) * planes + d
    between = some[:, None] & (d + 1 < planes)
    likely = tl.load(table + 3 * row, between, 0.0) - tl.load(table + 3 * row + 3, between, 0.0)
    best = tl.argmax(tl.where(d + 1 < planes, likely, -1.0), 1)
    middle = 0.5 * (tl.load(inverses + best) + tl.load(inverses + best + 1))
    sure = tl.load(table + 3 * p.to(tl.int64) * planes + 2, some, 0.0) > least
    for axis in range(3):
        place = tl.load(rays + 3 * p + axis, some, 0.0) / middle + tl.load(origin + axis)
        tl.store(out + 3 * p + axis, tl.where(sure, place, float("nan")), some)


def surest(table: Tensor, rays: Tensor, inverses: Tensor, origin: Tensor, least: float) -> Tensor:
    """(P, 3) likeliest places along rays (P, 3), not numbers where no depth has more than `least` of the likelihood about it."""
    rows, rays, origin = table.permute(2, 3, 1, 0).contiguous(), rays.contiguous(), origin.contiguous()
    planes = rows.shape[2]
    out = torch.empty_like(rays)
    sizes = {"BP": matching.PIXELS, "BD": matching.wide(planes)}
    _surest[(triton.cdiv(len(rays), matching.PIXELS),)](rows, rays, inverses, origin, out, len(rays), planes, least, **sizes)
    return out
