# mypy: disable-error-code="no-untyped-def,untyped-decorator,misc"
"""The plane sweep on CUDA: costs of planes, semi-global matching, likelihoods and their table, a launch each (`compiled.py` on the CPU).

Volumes are (P, D), pixel by pixel with the planes next to each other in memory, since all that follows goes along planes. Results equal
those of the tensors to rounding.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from toolkit.gpu import kernel

CHANNELS = 21  # of a descriptor, colours first
COLOURS = 3
TILE = (32, 16)  # pixels and planes that are compared at once
PLANES = 256  # of a pixel at least, with those that there are not: more planes are compiled for once more
PIXELS = 4  # whose planes are summed at once


@kernel("total", "least", "count", "out")
def _cost(
    own, rays, inverses, picture, intrinsics, sizes, poses, view, views, total, least, count, out, pixels, planes, height, width, gain,
    unknown, CHANNELS: tl.constexpr, COLOURS: tl.constexpr, BP: tl.constexpr, BD: tl.constexpr,
):  # fmt: skip
    """One other view: what differs at planes, added up; the last one makes the cost of all."""
    p = tl.program_id(0) * BP + tl.arange(0, BP)
    d = tl.program_id(1) * BD + tl.arange(0, BD)
    is_pixel, is_plane = p < pixels, d < planes
    pose = poses + 16 * view
    lens = intrinsics + 4 * view
    across, down = tl.load(sizes + 2 * view), tl.load(sizes + 2 * view + 1)
    rx = tl.load(rays + 3 * p, is_pixel, 0.0)
    ry = tl.load(rays + 3 * p + 1, is_pixel, 0.0)
    rz = tl.load(rays + 3 * p + 2, is_pixel, 1.0)
    r00, r01, r02 = tl.load(pose), tl.load(pose + 1), tl.load(pose + 2)
    r10, r11, r12 = tl.load(pose + 4), tl.load(pose + 5), tl.load(pose + 6)
    r20, r21, r22 = tl.load(pose + 8), tl.load(pose + 9), tl.load(pose + 10)
    gx = tl.load(poses + 3) - tl.load(pose + 3)
    gy = tl.load(poses + 7) - tl.load(pose + 7)
    gz = tl.load(poses + 11) - tl.load(pose + 11)
    inverse = tl.load(inverses + d, is_plane, 1.0)[None, :]
    x = (rx * r00 + ry * r10 + rz * r20)[:, None] + inverse * (gx * r00 + gy * r10 + gz * r20)
    y = (rx * r01 + ry * r11 + rz * r21)[:, None] + inverse * (gx * r01 + gy * r11 + gz * r21)
    z = (rx * r02 + ry * r12 + rz * r22)[:, None] + inverse * (gx * r02 + gy * r12 + gz * r22)
    deep = z > 1e-4
    z = tl.where(deep, z, 1.0)
    u = (x / z * tl.load(lens) + tl.load(lens + 2)) / across * 2 - 1
    v = (y / z * tl.load(lens + 1) + tl.load(lens + 3)) / down * 2 - 1
    seen = deep & (tl.abs(u) <= 1) & (tl.abs(v) <= 1)
    u = tl.minimum(tl.maximum(((tl.minimum(tl.maximum(u, -2.0), 2.0) + 1) * width - 1) * 0.5, 0.0), width - 1.0)
    v = tl.minimum(tl.maximum(((tl.minimum(tl.maximum(v, -2.0), 2.0) + 1) * height - 1) * 0.5, 0.0), height - 1.0)
    left, top = tl.floor(u), tl.floor(v)
    u, v = u - left, v - top
    column, row = left.to(tl.int32), top.to(tl.int32)
    right, below = tl.minimum(column + 1, width - 1), tl.minimum(row + 1, height - 1)
    corner = row * width + column
    corner_right, corner_below, corner_both = row * width + right, below * width + column, below * width + right
    weight, weight_right, weight_below, weight_both = (1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v
    here = seen & is_pixel[:, None] & is_plane[None, :]
    colour = tl.zeros((BP, BD), tl.float32)
    patch = tl.zeros((BP, BD), tl.float32)
    mine = own + (p * CHANNELS)[:, None]
    for c in range(CHANNELS):
        channel = picture + c * height * width
        found = tl.load(channel + corner, here, 0.0) * weight + tl.load(channel + corner_right, here, 0.0) * weight_right
        found += tl.load(channel + corner_below, here, 0.0) * weight_below + tl.load(channel + corner_both, here, 0.0) * weight_both
        apart = found - tl.load(mine + c, is_pixel[:, None], 0.0)
        is_colour = c < COLOURS
        colour += tl.where(is_colour, tl.abs(apart), 0.0)
        patch += tl.where(is_colour, 0.0, apart * apart)
    colour = tl.minimum(colour * (gain / COLOURS), 1.0)
    patch = tl.minimum(patch * (0.5 / (CHANNELS - COLOURS)), 1.0)
    differs = 0.5 * (colour + patch)
    place = p[:, None] * planes + d[None, :]
    inside = is_pixel[:, None] & is_plane[None, :]
    added, lowest, looked = tl.where(seen, differs, 0.0), tl.where(seen, differs, 1.0), seen.to(tl.float32)
    later, last, more = inside & (view > 1), inside & (view + 1 == views), inside & (view + 1 < views)
    added += tl.load(total + place, later, 0.0)
    lowest = tl.minimum(lowest, tl.load(least + place, later, 1.0))
    looked += tl.load(count + place, later, 0.0)
    both = 0.5 * (added / tl.maximum(looked, 1.0) + lowest)
    tl.store(out + place, tl.where(looked > 0, both, unknown), last)
    tl.store(total + place, added, more)
    tl.store(least + place, lowest, more)
    tl.store(count + place, looked, more)


def costs(
    described: list[Tensor], intrinsics: Tensor, sizes: Tensor, poses: Tensor, inverses: Tensor, rays: Tensor, own: Tensor,
    gain: float, unknown: float,
) -> Tensor:  # fmt: skip
    """(P, D) of pixels of the first view.

    Args:
        described: K ≥ 2 times (21, h, w); intrinsics (K, 4), sizes (K, 2) and poses (K, 4, 4) of their cameras.
        inverses: (D,); rays: (P, 3), working axes; own: (P, 21), contiguous.
    """
    pixels, planes = len(rays), len(inverses)
    intrinsics, sizes, poses, rays, own = (values.contiguous() for values in (intrinsics, sizes, poses, rays, own))
    out = rays.new_empty((pixels, planes))
    views = len(described)
    total, least, count = (rays.new_empty((pixels, planes)) if views > 2 else out for _ in range(3))
    if pixels == 0:
        return out
    grid = (triton.cdiv(pixels, TILE[0]), triton.cdiv(planes, TILE[1]))
    for view in range(1, views):
        picture = described[view].contiguous()
        _cost[grid](
            own, rays, inverses, picture, intrinsics, sizes, poses, view, views, total, least, count, out, pixels, planes,
            picture.shape[1], picture.shape[2], gain, unknown, CHANNELS=CHANNELS, COLOURS=COLOURS, BP=TILE[0], BD=TILE[1],
        )  # fmt: skip
    return out


@kernel("cost", "out")
def _path(cost, out, height, width, planes, small, large, BD: tl.constexpr):
    """The cheapest paths along one line of pixels in one of four directions."""
    line, way = tl.program_id(0), tl.program_id(1)
    upright = way < 2
    lines = tl.where(upright, width, height)
    if line < lines:
        length = tl.where(upright, height, width)
        step = tl.where(upright, width, 1)
        first = tl.where(upright, line, line * width)
        back = (way % 2) == 1
        first = tl.where(back, first + (length - 1) * step, first)
        step = tl.where(back, -step, step)
        d = tl.arange(0, BD)
        inside = d < planes
        to_left, to_right = tl.maximum(d - 1, 0), tl.minimum(d + 1, BD - 1)
        never = float("inf")
        before = tl.load(cost + first.to(tl.int64) * planes + d, inside, never)
        out += way.to(tl.int64) * height * width * planes
        tl.store(out + first.to(tl.int64) * planes + d, before, inside)
        place = first.to(tl.int64) + step
        coming = tl.load(cost + place * planes + d, inside & (length > 1), never)
        i = 1
        while i < length:
            now = coming
            coming = tl.load(cost + (place + step) * planes + d, inside & (i + 1 < length), never)  # asked for early: it takes a while
            best = tl.min(before, 0)
            left = tl.where(d > 0, tl.gather(before, to_left, 0), never)
            right = tl.where(d < BD - 1, tl.gather(before, to_right, 0), never)
            near = tl.minimum(left, right) + small
            before = tl.where(inside, now + tl.minimum(tl.minimum(before, near), best + large) - best, never)
            tl.store(out + place * planes + d, before, inside)
            place += step
            i += 1


@kernel("paths", "out")
def _likely(paths, out, pixels, planes, scale, BP: tl.constexpr, BD: tl.constexpr):
    """The four ways' mean, and its softmax along planes."""
    p = (tl.program_id(0) * BP + tl.arange(0, BP)).to(tl.int64)
    d = tl.arange(0, BD)
    inside = (p < pixels)[:, None] & (d < planes)[None, :]
    place = p[:, None] * planes + d[None, :]
    volume = tl.cast(pixels, tl.int64) * planes
    one = tl.load(paths + place, inside, 0.0) + tl.load(paths + volume + place, inside, 0.0)
    other = tl.load(paths + 2 * volume + place, inside, 0.0) + tl.load(paths + 3 * volume + place, inside, 0.0)
    along = tl.where(inside, (one + other) * 0.25 * scale, -float("inf"))
    likely = tl.exp(along - tl.where(p < pixels, tl.max(along, 1), 0.0)[:, None])
    tl.store(out + place, likely / tl.where(p < pixels, tl.sum(likely, 1), 1.0)[:, None], inside)


def wide(planes: int) -> int:
    """A power of two that holds the planes, the same for nearly all."""
    return max(PLANES, int(triton.next_power_of_2(planes)))


def _paths(volume: Tensor, small: float, large: float) -> Tensor:
    """(h, w, D), contiguous → (4, h, w, D): down, up, right, left."""
    height, width, planes = volume.shape
    paths = volume.new_empty((4, height, width, planes))
    # One warp a line: what goes from plane to plane stays within it.
    _path[(max(height, width), 4)](volume, paths, height, width, planes, small, large, BD=wide(planes), num_warps=1)
    return paths


def semi_global(cost: Tensor, small: float, large: float) -> Tensor:
    """(D, h, w) → the same smoothed along four directions, see `matching.semi_global`."""
    paths = _paths(cost.permute(1, 2, 0).contiguous(), small, large)
    return ((paths[0] + paths[1]) + (paths[2] + paths[3])).div_(4).permute(2, 0, 1)


def distribution(cost: Tensor, small: float, large: float, temperature: float) -> Tensor:
    """(D, h, w) costs → likelihoods, see `matching.distribution`; planes of a pixel lie next to each other."""
    volume = cost.permute(1, 2, 0).contiguous()
    height, width, planes = volume.shape
    paths, out = _paths(volume, small, large), torch.empty_like(volume)
    grid = (triton.cdiv(height * width, PIXELS),)
    _likely[grid](paths, out, height * width, planes, -1 / temperature, BP=PIXELS, BD=wide(planes))
    return out.permute(2, 0, 1)


@kernel("likely", "out")
def _tabled(likely, out, pixels, planes, step, window: tl.constexpr, BP: tl.constexpr, BD: tl.constexpr):
    """How likely the surface is nearer, the integral of that, and the most that lies about one depth."""
    p = (tl.program_id(0) * BP + tl.arange(0, BP)).to(tl.int64)
    d = tl.arange(0, BD)
    is_pixel = (p < pixels)[:, None]
    inside = is_pixel & (d < planes)[None, :]
    row = p[:, None] * planes + d[None, :]
    here = tl.load(likely + row, inside, 0.0)
    before = tl.load(likely + row - 1, inside & (d > 0)[None, :], 0.0)
    rest = tl.cumsum(here, 1, reverse=True)
    nearer = rest - 0.5 * here
    middle = tl.where((d > 0)[None, :], 0.5 * (nearer + (rest + 0.5 * before)) * step, 0.0)
    peak = tl.zeros((BP, BD), tl.float32)
    for k in range(window):
        peak += tl.load(likely + row + k, is_pixel & (d + k < planes)[None, :], 0.0)
    sure = tl.max(tl.where((d <= planes - window)[None, :], peak, 0.0), 1)[:, None] + tl.zeros((BP, BD), tl.float32)
    tl.store(out + 3 * row, nearer, inside)
    tl.store(out + 3 * row + 1, tl.cumsum(middle, 1), inside)
    tl.store(out + 3 * row + 2, sure, inside)


def table(likely: Tensor, step: float, peak: int) -> Tensor:
    """(D, h, w) likelihoods, farthest first → (3, D, h, w) of `Sweep`; a voxel's three numbers lie next to each other."""
    volume = likely.permute(1, 2, 0).contiguous()
    height, width, planes = volume.shape
    out = volume.new_empty((height, width, planes, 3))
    grid = (triton.cdiv(height * width, PIXELS),)
    _tabled[grid](volume, out, height * width, planes, step, min(2 * peak + 1, planes), BP=PIXELS, BD=wide(planes))
    return out.permute(3, 2, 0, 1)
