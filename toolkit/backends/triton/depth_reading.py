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
from fieldfuse.backends.triton import plane_sweep
from fieldfuse.backends.triton.launch import kernel, pieces
from fieldfuse.backends.triton.plane_sweep import corners, table_of

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
def estimate(x, y, z, truncation, table, pose, lens, size, height, width, planes, lowest, step, some):
    """Expected signed distance, visibility and confidence of places of the working frame, as `SdfEstimate`."""
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
    signed, clear, sure = estimate(x, y, z, cut, table, pose, lens, size, height, width, planes, lowest, step, some)
    tl.store(out + n, signed, some)
    tl.store(out + count + n, clear, some)
    tl.store(out + 2 * count + n, sure, some)


def look(points: Tensor, truncation: Tensor, table: Tensor, camera: Any, lowest: float, step: float) -> Tensor:
    """(3, N): `DepthDistribution.look` at voxels (N, 3) with a truncation (N,) each, from a table (3, D, h, w) of `plane_sweep.table`."""
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
def _odds_at(x, y, z, odds, pose, lens, size, height, width, planes, lowest, step, mask):
    """Log odds of one key frame at places, and whether it sees them."""
    x, y, z = local(x, y, z, pose)
    seen = (z > 1e-4) & mask
    inverse = 1 / tl.where(seen, z, 1.0)
    u = (x * inverse * tl.load(lens) + tl.load(lens + 2)) / tl.load(size)
    v = (y * inverse * tl.load(lens + 1) + tl.load(lens + 3)) / tl.load(size + 1)
    seen = seen & (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1)
    left, right, fx = _bounded(tl.where(seen, u, 0.0) * width - 0.5, width)
    top, below, fy = _bounded(tl.where(seen, v, 0.0) * height - 0.5, height)
    low, high, fz = _bounded((inverse - lowest) / step, planes)
    return _between(odds, left, right, fx, top, below, fy, low, high, fz, width, planes, seen, 1), seen


@triton.jit
def _view_at(addresses, number):
    """Where a key frame's log odds and its `numbers` lie, its height, width and planes, its lowest plane, and from one to the next."""
    odds = tl.load(addresses + 2 * number).to(tl.pointer_type(tl.float32))
    row = tl.load(addresses + 2 * number + 1).to(tl.pointer_type(tl.float32))
    height, width, planes = tl.load(row + 20).to(tl.int32), tl.load(row + 21).to(tl.int32), tl.load(row + 22).to(tl.int32)
    return odds, row, height, width, planes, tl.load(row + 18), tl.load(row + 19)


@kernel("points", "out")
def _confirmed(points, addresses, out, count, blocks, BLOCK: tl.constexpr):
    """Sums of one key frame's log odds at places and of how many it sees, one pair a block. Places that are not numbers are not seen."""
    n = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    number = tl.program_id(1)
    some = n < count
    x, y, z = tl.load(points + 3 * n, some, 0.0), tl.load(points + 3 * n + 1, some, 0.0), tl.load(points + 3 * n + 2, some, 0.0)
    odds, row, height, width, planes, lowest, step = _view_at(addresses, number)
    found, seen = _odds_at(x, y, z, odds, row, row + 12, row + 16, height, width, planes, lowest, step, some)
    place = 2 * (number * blocks + tl.program_id(0))
    tl.store(out + place, tl.sum(tl.where(seen, found, 0.0), 0))
    tl.store(out + place + 1, tl.sum(seen.to(tl.float32), 0))


@triton.jit
def _reliability(sums, number, blocks, believed, PARTS: tl.constexpr):
    """How much a key frame counts, by its mean log odds at places; in full where it sees none of them."""
    total, count = tl.zeros((PARTS,), tl.float32), tl.zeros((PARTS,), tl.float32)
    first = 0
    while first < blocks:
        block = first + tl.arange(0, PARTS)
        place = sums + 2 * (number * blocks + block)
        total += tl.load(place, block < blocks, 0.0)
        count += tl.load(place + 1, block < blocks, 0.0)
        first += PARTS
    seen = tl.sum(count, 0)
    counts = tl.minimum(tl.maximum(tl.sum(total, 0) / tl.maximum(seen, 1.0) / believed, 0.0), 1.0)
    return tl.where(seen > 0, counts, 1.0)


@triton.jit
def _ray(rays, axis, corner, right, below, both, fx, fy, mask):
    """One axis of rays of the pixels' grid, read between them."""
    upper = tl.load(rays + 3 * corner + axis, mask, 0.0) * (1 - fx) + tl.load(rays + 3 * right + axis, mask, 0.0) * fx
    lower = tl.load(rays + 3 * below + axis, mask, 0.0) * (1 - fx) + tl.load(rays + 3 * both + axis, mask, 0.0) * fx
    return (upper * (1 - fy) + lower * fy)[:, None]


@kernel("rays", "inverses", "sums", "out")
def _mean(
    rays, inverses, pose, addresses, sums, out, views, blocks, height, width, down, across, depths, believed, share,
    BP: tl.constexpr, BD: tl.constexpr, PARTS: tl.constexpr,
):  # fmt: skip
    """Mean log odds of all key frames along some of the rays."""
    p = tl.program_id(0) * BP + tl.arange(0, BP)
    d = tl.program_id(1) * BD + tl.arange(0, BD)
    is_row = p < down * across
    inside = is_row[:, None] & (d < depths)[None, :]
    left, right, fx = _bounded((p % across + 0.5) * (width * 1.0 / across) - 0.5, width)
    top, below, fy = _bounded((p // across + 0.5) * (height * 1.0 / down) - 0.5, height)
    one, two, three, four = top * width + left, top * width + right, below * width + left, below * width + right
    far = 1 / tl.load(inverses + d, d < depths, 1.0)[None, :]
    x = _ray(rays, 0, one, two, three, four, fx, fy, is_row) * far + tl.load(pose + 3)
    y = _ray(rays, 1, one, two, three, four, fx, fy, is_row) * far + tl.load(pose + 7)
    z = _ray(rays, 2, one, two, three, four, fx, fy, is_row) * far + tl.load(pose + 11)
    total, looked = tl.zeros((BP, BD), tl.float32), tl.zeros((BP, BD), tl.float32)
    number = 0
    while number < views:
        odds, row, tall, wide, planes, lowest, step = _view_at(addresses, number)
        found, seen = _odds_at(x, y, z, odds, row, row + 12, row + 16, tall, wide, planes, lowest, step, inside)
        total += tl.where(seen, found * _reliability(sums, number, blocks, believed, PARTS), 0.0)
        looked += seen.to(tl.float32)
        number += 1
    tl.store(out + p[:, None] * depths + d[None, :], total / tl.maximum(looked, 1.0) * share, inside)


def numbers(camera: Any, odds: Tensor, lowest: float, step: float) -> Tensor:
    """(23,) that a key frame's log odds are read by: its pose (12), lens (4) and size (2), its planes' lowest and step, and h, w and D."""
    rest = to_device_async(np.array([lowest, step, odds.shape[1], odds.shape[2], odds.shape[0]], np.float32), odds.device)
    return torch.cat([camera.world_from_camera[0, :3].reshape(12), camera.intrinsics[0], camera.size[0], rest])


class Together:
    """Log odds of W ≥ 1 key frames (`CrossView`), read together in one launch."""

    def __init__(self, views: Sequence[Any]) -> None:
        self.count = len(views)
        # Held until kernels that go to their addresses are on their way.
        self._held = [(plane_sweep.rows(one.log_odds), one.numbers()) for one in views]
        places = np.array([(odds.data_ptr(), row.data_ptr()) for odds, row in self._held], np.int64)
        self._addresses = to_device_async(places, self._held[0][0].device)

    def confirmed(self, points: Tensor) -> Tensor:
        """(W, B, 2): for each the sum of its log odds at places (N, 3), and how many of them it sees, in B parts."""
        blocks = max(1, pieces(len(points), BLOCK))
        out = points.new_empty((self.count, blocks, 2))
        _confirmed[(blocks, self.count)](points.contiguous(), self._addresses, out, len(points), blocks, BLOCK=BLOCK)
        return out

    def mean(self, costs: Any, coarse: tuple[int, int], sums: Tensor | None, believed: float, share: float) -> Tensor:
        """Mean log odds of the key frames that look there, each by its reliability.

        Args:
            costs: `CostVolume` (D, h, w), along whose rays and at whose planes they are read …
            coarse: … of a grid (h', w').
            sums: of `confirmed`; None: each counts in full.
            believed: mean of them from which on a key frame counts in full.
            share: of the mean that is given.

        Returns:
            (h', w', D).
        """
        rays, depths = costs.rays, len(costs.inverses)
        out = rays.new_empty((*coarse, depths))
        blocks = 0 if sums is None else sums.shape[1]
        tiles = (pieces(coarse[0] * coarse[1], TILE[0]), pieces(depths, TILE[1]))
        _mean[tiles](
            rays.contiguous(), costs.inverses, plane_sweep.lens(costs.camera)[0], self._addresses, out if sums is None else sums, out,
            self.count, blocks, *costs.cost.shape[1:], *coarse, depths, believed, share, BP=TILE[0], BD=TILE[1], PARTS=PARTS,
        )  # fmt: skip
        return out


@kernel("table", "out")
def _log_odds(table, out, pixels, planes, gain, against, ABOUT: tl.constexpr, BP: tl.constexpr, BD: tl.constexpr):
    p = (tl.program_id(0) * BP + tl.arange(0, BP)).to(tl.int64)[:, None]
    d = tl.arange(0, BD)[None, :]
    inside = (p < pixels) & (d < planes)
    row = p * planes + d
    hidden = tl.load(table + 3 * (row + ABOUT), (p < pixels) & (d + ABOUT < planes), 0.0)
    not_free = tl.load(table + 3 * (row - ABOUT), (p < pixels) & (d >= ABOUT) & (d < planes), 1.0)
    tl.store(out + row, tl.log(gain * tl.maximum(not_free - hidden, 0.0) + hidden + against), inside)


def log_odds(table: Tensor, gain: float, against: float, about: int) -> Tensor:
    """(D, h, w) of a `CrossView` from the table (3, D, h, w) of a sweep."""
    rows = table.permute(2, 3, 1, 0).contiguous()
    height, width, planes = rows.shape[:3]
    out = rows.new_empty((height, width, planes))
    grid = (pieces(height * width, plane_sweep.PIXELS),)
    sizes = {"ABOUT": about, "BP": plane_sweep.PIXELS, "BD": plane_sweep.wide(planes)}
    _log_odds[grid](rows, out, height * width, planes, gain, against, **sizes)
    return out.permute(2, 0, 1)


@kernel("table", "rays", "out")
def _confident_points(table, rays, inverses, origin, out, pixels, planes, least, BP: tl.constexpr, BD: tl.constexpr):
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


def confident_points(table: Tensor, rays: Tensor, inverses: Tensor, origin: Tensor, least: float) -> Tensor:
    """(P, 3) likeliest places along rays (P, 3), not numbers where no depth has more than `least` of the likelihood about it."""
    rows, rays, origin = table.permute(2, 3, 1, 0).contiguous(), rays.contiguous(), origin.contiguous()
    planes = rows.shape[2]
    out = torch.empty_like(rays)
    sizes = {"BP": plane_sweep.PIXELS, "BD": plane_sweep.wide(planes)}
    _confident_points[(pieces(len(rays), plane_sweep.PIXELS),)](rows, rays, inverses, origin, out, len(rays), planes, least, **sizes)
    return out


@kernel("likely", "inverses", "out")
def _table_with_depth(
    likely, inverses, depth, out, tall, wide, height, width, planes, rows, columns, upper, left, down, across, step, noise, trust,
    window: tl.constexpr, BP: tl.constexpr, BD: tl.constexpr,
):  # fmt: skip
    p = tl.program_id(0) * BP + tl.arange(0, BP)
    d = tl.arange(0, BD)
    pixels = height * width
    some, is_plane = p < pixels, d < planes
    inside = some[:, None] & is_plane[None, :]
    y, x = p // width, p % width
    row, column = (upper + (y + 0.5) * down).to(tl.int32), (left + (x + 0.5) * across).to(tl.int32)
    here = tl.load(depth + tl.minimum(row, rows - 1) * columns + tl.minimum(column, columns - 1), some, 0.0)
    known = (here > 0) & (here < float("inf"))
    inverse = 1 / tl.where(known, here, 1.0)
    inverse = tl.minimum(tl.maximum(inverse, tl.load(inverses)), tl.load(inverses + planes - 1))
    apart = (tl.load(inverses + d, is_plane, 0.0)[None, :] - inverse[:, None]) / tl.maximum(noise * inverse, 0.7 * step)[:, None]
    along = tl.where(is_plane[None, :], -0.5 * apart * apart, -float("inf"))
    near = tl.exp(along - tl.max(along, 1)[:, None])
    near = near / tl.sum(near, 1)[:, None]
    one, two, three, four, of_one, of_two, of_three, of_four = corners((x + 0.5) / width * 2 - 1, (y + 0.5) / height * 2 - 1, tall, wide)
    shown = tl.load(likely + one[:, None] * planes + d[None, :], inside, 0.0) * of_one[:, None]
    shown += tl.load(likely + two[:, None] * planes + d[None, :], inside, 0.0) * of_two[:, None]
    shown += tl.load(likely + three[:, None] * planes + d[None, :], inside, 0.0) * of_three[:, None]
    shown += tl.load(likely + four[:, None] * planes + d[None, :], inside, 0.0) * of_four[:, None]
    shown = tl.where(known[:, None], trust * near + (1 - trust) * shown, shown)
    table_of(tl.where(inside, shown, 0.0), out, p.to(tl.int64), d, pixels, planes, step, window, BP, BD)


def table_with_depth(
    likely: Tensor, inverses: Tensor, depth: Tensor, place: tuple[Any, Any], numbers: tuple[float, float, float], peak: int
) -> Tensor:
    """`plane_sweep.table` (3, D, h', w') of what `plane_sweep.measured` gives, in one launch: it is large, at all pixels.

    Args:
        likely: (D, h, w) likelihoods of planes (D,), evenly spaced.
        depth: (H, W).
        place: (h', w'), and from which row of the depth on, and how many of them, are read; and the same of columns.
        numbers: from plane to plane, noise and trust.
    """
    volume, depth = plane_sweep.rows(likely), depth.contiguous()
    tall, wide, planes = volume.shape
    (height, width), ((upper, down), (left, across)) = place
    out = volume.new_empty((height, width, planes, 3))
    _table_with_depth[(pieces(height * width, plane_sweep.PIXELS),)](
        volume, inverses, depth, out, tall, wide, height, width, planes, *depth.shape, float(upper), float(left), down / height,
        across / width, *numbers, window=plane_sweep.window_of(peak, planes), BP=plane_sweep.PIXELS, BD=plane_sweep.wide(planes),
    )  # fmt: skip
    return out.permute(3, 2, 0, 1)
