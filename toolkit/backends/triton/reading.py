# mypy: disable-error-code="no-untyped-def,untyped-decorator,misc"
"""Depth distributions and log odds of surface read between pixels and planes on CUDA (`DepthDistribution.look`, `CrossView`)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
import triton
import triton.language as tl
from torch import Tensor

from fieldfuse.backends.dispatch import to_device_async
from fieldfuse.backends.triton import matching
from fieldfuse.backends.triton.launch import kernel, pieces

BLOCK = 128
TILE = (16, 32)  # rays and planes at once
PARTS = 128  # sums that are added at once


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
    """(3, N): `DepthDistribution.look` at voxels (N, 3) with a truncation (N,) each, from a table (3, D, h, w) of `matching.table`."""
    rows = table.permute(2, 3, 1, 0).contiguous()
    height, width, planes = rows.shape[:3]
    count = len(points)
    out = points.new_empty((3, count))
    if count:
        points, truncation, pose, lens, size = (
            values.contiguous() for values in (points, truncation, camera.world_from_camera, camera.intrinsics, camera.size)
        )
        _look[(pieces(count, BLOCK),)](
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


@triton.jit
def _witness_at(addresses, number):
    """Where a witness's volume and its `numbers` lie, its height, width and planes, its lowest plane, and from one to the next."""
    says = tl.load(addresses + 2 * number).to(tl.pointer_type(tl.float32))
    row = tl.load(addresses + 2 * number + 1).to(tl.pointer_type(tl.float32))
    height, width, planes = tl.load(row + 20).to(tl.int32), tl.load(row + 21).to(tl.int32), tl.load(row + 22).to(tl.int32)
    return says, row, height, width, planes, tl.load(row + 18), tl.load(row + 19)


@kernel("points", "out")
def _confirmed(points, addresses, out, count, blocks, BLOCK: tl.constexpr):
    """Sums of what a witness says of places and of how many it sees, one pair a block. Places that are not numbers are not seen."""
    n = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    number = tl.program_id(1)
    some = n < count
    x, y, z = tl.load(points + 3 * n, some, 0.0), tl.load(points + 3 * n + 1, some, 0.0), tl.load(points + 3 * n + 2, some, 0.0)
    says, row, height, width, planes, lowest, step = _witness_at(addresses, number)
    said, seen = _asked(x, y, z, says, row, row + 12, row + 16, height, width, planes, lowest, step, some)
    place = 2 * (number * blocks + tl.program_id(0))
    tl.store(out + place, tl.sum(tl.where(seen, said, 0.0), 0))
    tl.store(out + place + 1, tl.sum(seen.to(tl.float32), 0))


@triton.jit
def _belief(sums, number, blocks, believed, PARTS: tl.constexpr):
    """How far a witness is to be believed, by what it says of places on average; in full where it sees none of them."""
    said, count = tl.zeros((PARTS,), tl.float32), tl.zeros((PARTS,), tl.float32)
    first = 0
    while first < blocks:
        block = first + tl.arange(0, PARTS)
        place = sums + 2 * (number * blocks + block)
        said += tl.load(place, block < blocks, 0.0)
        count += tl.load(place + 1, block < blocks, 0.0)
        first += PARTS
    seen = tl.sum(count, 0)
    belief = tl.minimum(tl.maximum(tl.sum(said, 0) / tl.maximum(seen, 1.0) / believed, 0.0), 1.0)
    return tl.where(seen > 0, belief, 1.0)


@triton.jit
def _ray(rays, axis, corner, right, below, both, fx, fy, mask):
    """One axis of rays of the pixels' grid, read between them."""
    upper = tl.load(rays + 3 * corner + axis, mask, 0.0) * (1 - fx) + tl.load(rays + 3 * right + axis, mask, 0.0) * fx
    lower = tl.load(rays + 3 * below + axis, mask, 0.0) * (1 - fx) + tl.load(rays + 3 * both + axis, mask, 0.0) * fx
    return (upper * (1 - fy) + lower * fy)[:, None]


@kernel("rays", "inverses", "sums", "out")
def _mean(
    rays, inverses, pose, addresses, sums, out, witnesses, blocks, height, width, down, across, asked, believed, share,
    BP: tl.constexpr, BD: tl.constexpr, PARTS: tl.constexpr,
):  # fmt: skip
    """What all witnesses say along some of the rays in the mean."""
    p = tl.program_id(0) * BP + tl.arange(0, BP)
    d = tl.program_id(1) * BD + tl.arange(0, BD)
    is_row = p < down * across
    inside = is_row[:, None] & (d < asked)[None, :]
    left, right, fx = _bounded((p % across + 0.5) * (width * 1.0 / across) - 0.5, width)
    top, below, fy = _bounded((p // across + 0.5) * (height * 1.0 / down) - 0.5, height)
    one, two, three, four = top * width + left, top * width + right, below * width + left, below * width + right
    far = 1 / tl.load(inverses + d, d < asked, 1.0)[None, :]
    x = _ray(rays, 0, one, two, three, four, fx, fy, is_row) * far + tl.load(pose + 3)
    y = _ray(rays, 1, one, two, three, four, fx, fy, is_row) * far + tl.load(pose + 7)
    z = _ray(rays, 2, one, two, three, four, fx, fy, is_row) * far + tl.load(pose + 11)
    total, looked = tl.zeros((BP, BD), tl.float32), tl.zeros((BP, BD), tl.float32)
    number = 0
    while number < witnesses:
        says, row, tall, wide, planes, lowest, step = _witness_at(addresses, number)
        said, seen = _asked(x, y, z, says, row, row + 12, row + 16, tall, wide, planes, lowest, step, inside)
        total += tl.where(seen, said * _belief(sums, number, blocks, believed, PARTS), 0.0)
        looked += seen.to(tl.float32)
        number += 1
    tl.store(out + p[:, None] * asked + d[None, :], total / tl.maximum(looked, 1.0) * share, inside)


def numbers(camera: Any, says: Tensor, lowest: float, step: float) -> Tensor:
    """(23,) that a witness is asked by: its pose (12), lens (4) and size (2), its planes' lowest and step, and h, w and D."""
    rest = to_device_async(np.array([lowest, step, says.shape[1], says.shape[2], says.shape[0]], np.float32), says.device)
    return torch.cat([camera.world_from_camera[0, :3].reshape(12), camera.intrinsics[0], camera.size[0], rest])


class Asked:
    """Witnesses that are asked together, in one launch.

    Args:
        witnesses: W ≥ 1.
    """

    def __init__(self, witnesses: Sequence[Any]) -> None:
        self.count = len(witnesses)
        # Kept until kernels that go to their addresses are on their way.
        self._kept = [(matching.rows(one.log_odds), one.numbers()) for one in witnesses]
        places = np.array([(says.data_ptr(), row.data_ptr()) for says, row in self._kept], np.int64)
        self._addresses = to_device_async(places, self._kept[0][0].device)

    def confirmed(self, points: Tensor) -> Tensor:
        """(W, B, 2): for each witness the sum of what it says of places (N, 3), and how many of them it sees, in B parts."""
        blocks = max(1, pieces(len(points), BLOCK))
        out = points.new_empty((self.count, blocks, 2))
        _confirmed[(blocks, self.count)](points.contiguous(), self._addresses, out, len(points), blocks, BLOCK=BLOCK)
        return out

    def mean(
        self, rays: Tensor, inverses: Tensor, camera: Any, grid: tuple[int, int], coarse: tuple[int, int], sums: Tensor | None,
        believed: float, share: float,
    ) -> Tensor:  # fmt: skip
        """What witnesses that look there say in the mean, each by how far it is believed.

        Args:
            rays: (h · w, 3) from the camera, through the pixels of a grid (h, w).
            inverses: (D,) inverse depths along each.
            coarse: (h', w') of the grid at which they are asked.
            sums: of `confirmed`; None: each is believed in full.
            believed: mean of what is said from which on a witness is.
            share: of the mean that is given.

        Returns:
            (h', w', D).
        """
        out = rays.new_empty((*coarse, len(inverses)))
        blocks = 0 if sums is None else sums.shape[1]
        tiles = (pieces(coarse[0] * coarse[1], TILE[0]), pieces(len(inverses), TILE[1]))
        _mean[tiles](
            rays.contiguous(), inverses, matching.lens(camera)[0], self._addresses, out if sums is None else sums, out, self.count, blocks,
            *grid, *coarse, len(inverses), believed, share, BP=TILE[0], BD=TILE[1], PARTS=PARTS,
        )  # fmt: skip
        return out


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
    grid = (pieces(height * width, matching.PIXELS),)
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
    _surest[(pieces(len(rays), matching.PIXELS),)](rows, rays, inverses, origin, out, len(rays), planes, least, **sizes)
    return out
