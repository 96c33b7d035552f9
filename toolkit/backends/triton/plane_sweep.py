# mypy: disable-error-code="no-untyped-def,untyped-decorator,misc"
"""The plane sweep on CUDA: descriptors, costs of planes, semi-global matching, likelihoods and their table, a launch each.

Volumes are (P, D), pixel by pixel with the planes next to each other in memory, since all that follows goes along planes. Results equal
those of the tensors to rounding.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
import triton
import triton.language as tl
from torch import Tensor

from fieldfuse.backends.dispatch import to_device_async
from fieldfuse.backends.triton.launch import kernel, pieces, power_of_two

CHANNELS = 21  # of a descriptor, colours first
COLOURS = 3
TILE = (32, 16)  # pixels and planes that are compared at once
PLANES = 256  # of a pixel at least, with those that there are not: more planes are compiled for once more
PIXELS = 4  # whose planes are summed at once
BLOCK = 32  # pixels whose neighbours or channels are read together
GROUPS = (CHANNELS - COLOURS) // 9  # of 3×3 neighbours, the n-th of them n pixels apart


@triton.jit
def picture_at(pictures, view):
    """Where a picture lies, its height and its width, of `noted`."""
    row = pictures + 3 * view
    return tl.load(row).to(tl.pointer_type(tl.float32)), tl.load(row + 1).to(tl.int32), tl.load(row + 2).to(tl.int32)


@triton.jit
def corners(u, v, height, width):
    """The four pixels about places in [−1, 1] of a picture, and their shares; beyond its border the border counts."""
    u = tl.minimum(tl.maximum(((u + 1) * width - 1) * 0.5, 0.0), width - 1.0)
    v = tl.minimum(tl.maximum(((v + 1) * height - 1) * 0.5, 0.0), height - 1.0)
    left, top = tl.floor(u), tl.floor(v)
    u, v = u - left, v - top
    column, row = left.to(tl.int32), top.to(tl.int32)
    right, below = tl.minimum(column + 1, width - 1), tl.minimum(row + 1, height - 1)
    upper, lower = row * width, below * width
    return upper + column, upper + right, lower + column, lower + right, (1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v


@kernel("own", "rays", "inverses", "out")
def _cost(
    own, rays, inverses, pictures, poses, intrinsics, sizes, views, out, pixels, planes, gain, unknown, CHANNELS: tl.constexpr,
    COLOURS: tl.constexpr, BP: tl.constexpr, BD: tl.constexpr,
):  # fmt: skip
    """What all other views differ by at planes, and the cost of it."""
    p = tl.program_id(0) * BP + tl.arange(0, BP)
    d = tl.program_id(1) * BD + tl.arange(0, BD)
    is_pixel, is_plane = p < pixels, d < planes
    inside = is_pixel[:, None] & is_plane[None, :]
    rx = tl.load(rays + 3 * p, is_pixel, 0.0)
    ry = tl.load(rays + 3 * p + 1, is_pixel, 0.0)
    rz = tl.load(rays + 3 * p + 2, is_pixel, 1.0)
    inverse = tl.load(inverses + d, is_plane, 1.0)[None, :]
    mine = own + (p * CHANNELS)[:, None]
    total, looked = tl.zeros((BP, BD), tl.float32), tl.zeros((BP, BD), tl.float32)
    least = total + 1.0
    view = 1
    while view < views:
        picture, height, width = picture_at(pictures, view)
        pose, lens = poses + 16 * view, intrinsics + 4 * view
        across, down = tl.load(sizes + 2 * view), tl.load(sizes + 2 * view + 1)
        r00, r01, r02 = tl.load(pose), tl.load(pose + 1), tl.load(pose + 2)
        r10, r11, r12 = tl.load(pose + 4), tl.load(pose + 5), tl.load(pose + 6)
        r20, r21, r22 = tl.load(pose + 8), tl.load(pose + 9), tl.load(pose + 10)
        gx = tl.load(poses + 3) - tl.load(pose + 3)
        gy = tl.load(poses + 7) - tl.load(pose + 7)
        gz = tl.load(poses + 11) - tl.load(pose + 11)
        x = (rx * r00 + ry * r10 + rz * r20)[:, None] + inverse * (gx * r00 + gy * r10 + gz * r20)
        y = (rx * r01 + ry * r11 + rz * r21)[:, None] + inverse * (gx * r01 + gy * r11 + gz * r21)
        z = (rx * r02 + ry * r12 + rz * r22)[:, None] + inverse * (gx * r02 + gy * r12 + gz * r22)
        deep = z > 1e-4
        z = tl.where(deep, z, 1.0)
        u = (x / z * tl.load(lens) + tl.load(lens + 2)) / across * 2 - 1
        v = (y / z * tl.load(lens + 1) + tl.load(lens + 3)) / down * 2 - 1
        seen = deep & (tl.abs(u) <= 1) & (tl.abs(v) <= 1)
        u, v = tl.minimum(tl.maximum(u, -2.0), 2.0), tl.minimum(tl.maximum(v, -2.0), 2.0)
        one, two, three, four, of_one, of_two, of_three, of_four = corners(u, v, height, width)
        here = seen & inside
        colour, patch = tl.zeros((BP, BD), tl.float32), tl.zeros((BP, BD), tl.float32)
        for c in range(CHANNELS):
            channel = picture + c * height * width
            found = tl.load(channel + one, here, 0.0) * of_one + tl.load(channel + two, here, 0.0) * of_two
            found += tl.load(channel + three, here, 0.0) * of_three + tl.load(channel + four, here, 0.0) * of_four
            apart = found - tl.load(mine + c, is_pixel[:, None], 0.0)
            is_colour = c < COLOURS
            colour += tl.where(is_colour, tl.abs(apart), 0.0)
            patch += tl.where(is_colour, 0.0, apart * apart)
        colour = tl.minimum(colour * (gain / COLOURS), 1.0)
        patch = tl.minimum(patch * (0.5 / (CHANNELS - COLOURS)), 1.0)
        differs = 0.5 * (colour + patch)
        total += tl.where(seen, differs, 0.0)
        least = tl.minimum(least, tl.where(seen, differs, 1.0))
        looked += seen.to(tl.float32)
        view += 1
    both = 0.5 * (total / tl.maximum(looked, 1.0) + least)
    tl.store(out + p[:, None] * planes + d[None, :], tl.where(looked > 0, both, unknown), inside)


def noted(pictures: Sequence[Tensor]) -> Tensor:
    """(K, 3) int64 on the device of (C, h, w) pictures, contiguous: where each lies, its height and its width."""
    rows = [(picture.data_ptr(), *picture.shape[1:]) for picture in pictures]
    return to_device_async(np.array(rows, np.int64), pictures[0].device)


def costs(descriptors: Sequence[Tensor], cameras: Any, inverses: Tensor, rays: Tensor, own: Tensor, gain: float, unknown: float) -> Tensor:
    """(P, D) of pixels of the first view.

    Args:
        descriptors: K ≥ 2 times (21, h, w), of any sizes; cameras: K.
        inverses: (D,); rays: (P, 3), working axes; own: (P, 21); all contiguous.
    """
    pixels, planes = len(rays), len(inverses)
    descriptors = [picture.contiguous() for picture in descriptors]
    out = rays.new_empty((pixels, planes))
    if pixels:
        grid = (pieces(pixels, TILE[0]), pieces(planes, TILE[1]))
        _cost[grid](
            own, rays, inverses, noted(descriptors), *lens(cameras), len(descriptors), out, pixels, planes, gain, unknown,
            CHANNELS=CHANNELS, COLOURS=COLOURS, BP=TILE[0], BD=TILE[1],
        )  # fmt: skip
    return out


@kernel("cost", "correction", "out")
def _path(cost, correction, corrects, out, height, width, planes, small, large, BD: tl.constexpr):
    """The cheapest paths along one line of pixels in one of four directions, of the cost less the correction where there is one."""
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
        corrected = inside & (corrects > 0)
        to_left, to_right = tl.maximum(d - 1, 0), tl.minimum(d + 1, BD - 1)
        never = float("inf")
        place = first.to(tl.int64)
        before = tl.load(cost + place * planes + d, inside, never) - tl.load(correction + place * planes + d, corrected, 0.0)
        out += way.to(tl.int64) * height * width * planes
        tl.store(out + place * planes + d, before, inside)
        place += step
        coming = tl.load(cost + place * planes + d, inside & (length > 1), never)
        less = tl.load(correction + place * planes + d, corrected & (length > 1), 0.0)
        i = 1
        while i < length:
            now = coming - less
            coming = tl.load(cost + (place + step) * planes + d, inside & (i + 1 < length), never)  # loaded early: it takes a while
            less = tl.load(correction + (place + step) * planes + d, corrected & (i + 1 < length), 0.0)
            best = tl.min(before, 0)
            left = tl.where(d > 0, tl.gather(before, to_left, 0), never)
            right = tl.where(d < BD - 1, tl.gather(before, to_right, 0), never)
            near = tl.minimum(left, right) + small
            before = tl.where(inside, now + tl.minimum(tl.minimum(before, near), best + large) - best, never)
            tl.store(out + place * planes + d, before, inside)
            place += step
            i += 1


@triton.jit
def likelihood(paths, p, d, pixels, planes, scale):
    """The four ways' mean, and its softmax along planes; nothing where there are no pixels or planes."""
    inside = (p < pixels)[:, None] & (d < planes)[None, :]
    place = p[:, None] * planes + d[None, :]
    volume = tl.cast(pixels, tl.int64) * planes
    one = tl.load(paths + place, inside, 0.0) + tl.load(paths + volume + place, inside, 0.0)
    other = tl.load(paths + 2 * volume + place, inside, 0.0) + tl.load(paths + 3 * volume + place, inside, 0.0)
    along = tl.where(inside, (one + other) * 0.25 * scale, -float("inf"))
    likely = tl.exp(along - tl.where(p < pixels, tl.max(along, 1), 0.0)[:, None])
    return likely / tl.where(p < pixels, tl.sum(likely, 1), 1.0)[:, None]


@triton.jit
def beside(values, by, other, BP: tl.constexpr, BD: tl.constexpr):
    """Of each plane what another one has that lies `by` farther on, `other` where there is none."""
    to = tl.arange(0, BD)[None, :] + by + tl.zeros((BP, BD), tl.int32)
    return tl.where((to >= 0) & (to < BD), tl.gather(values, tl.minimum(tl.maximum(to, 0), BD - 1), 1), other)


@triton.jit
def peak(likely, d, planes, window: tl.constexpr, BP: tl.constexpr, BD: tl.constexpr):
    """The most of each pixel that lies about one depth."""
    about = likely
    for k in tl.static_range(1, window):
        about += beside(likely, k, 0.0, BP, BD)
    return tl.max(tl.where((d <= planes - window)[None, :], about, 0.0), 1)


@kernel("paths", "out")
def _likely(paths, out, pixels, planes, scale, BP: tl.constexpr, BD: tl.constexpr):
    p = (tl.program_id(0) * BP + tl.arange(0, BP)).to(tl.int64)
    d = tl.arange(0, BD)
    inside = (p < pixels)[:, None] & (d < planes)[None, :]
    tl.store(out + p[:, None] * planes + d[None, :], likelihood(paths, p, d, pixels, planes, scale), inside)


def wide(planes: int) -> int:
    """A power of two that holds the planes, the same for nearly all."""
    return max(PLANES, power_of_two(planes))


def _paths(volume: Tensor, small: float, large: float, correction: Tensor | None = None) -> Tensor:
    """(h, w, D), contiguous → (4, h, w, D): down, up, right, left; of costs less the correction, as large."""
    height, width, planes = volume.shape
    paths = volume.new_empty((4, height, width, planes))
    # One warp a line: what goes from plane to plane stays within it.
    _path[(max(height, width), 4)](
        volume, volume if correction is None else correction, int(correction is not None), paths, height, width, planes, small, large,
        BD=wide(planes), num_warps=1,
    )  # fmt: skip
    return paths


def lens(camera: Any) -> tuple[Tensor, Tensor, Tensor]:
    """A camera's pose, intrinsics and size as kernels read them."""
    return camera.world_from_camera.contiguous(), camera.intrinsics.contiguous(), camera.size.contiguous()


def rows(volume: Tensor) -> Tensor:
    """(D, h, w) → (h, w, D), planes of a pixel next to each other, as they are wherever kernels made them."""
    return volume.permute(1, 2, 0).contiguous()


def smoothed_softmax(cost: Tensor, small: float, large: float, temperature: float) -> Tensor:
    """(D, h, w) costs → likelihoods, see `matching.smoothed_softmax`; planes of a pixel lie next to each other."""
    volume = rows(cost)
    height, width, planes = volume.shape
    paths, out = _paths(volume, small, large), torch.empty_like(volume)
    grid = (pieces(height * width, PIXELS),)
    _likely[grid](paths, out, height * width, planes, -1 / temperature, BP=PIXELS, BD=wide(planes))
    return out.permute(2, 0, 1)


@triton.jit
def table_of(likely, out, p, d, pixels, planes, step, window: tl.constexpr, BP: tl.constexpr, BD: tl.constexpr):
    """How likely the surface is nearer, the integral of that, and the most that lies about one depth."""
    inside = (p < pixels)[:, None] & (d < planes)[None, :]
    row = p[:, None] * planes + d[None, :]
    rest = tl.cumsum(likely, 1, reverse=True)
    nearer = rest - 0.5 * likely
    middle = tl.where((d > 0)[None, :], 0.5 * (nearer + (rest + 0.5 * beside(likely, -1, 0.0, BP, BD))) * step, 0.0)
    sure = peak(likely, d, planes, window, BP, BD)[:, None] + tl.zeros((BP, BD), tl.float32)
    tl.store(out + 3 * row, nearer, inside)
    tl.store(out + 3 * row + 1, tl.cumsum(middle, 1), inside)
    tl.store(out + 3 * row + 2, sure, inside)


@kernel("likely", "out")
def _tabled(likely, out, pixels, planes, step, window: tl.constexpr, BP: tl.constexpr, BD: tl.constexpr):
    p = (tl.program_id(0) * BP + tl.arange(0, BP)).to(tl.int64)
    d = tl.arange(0, BD)
    inside = (p < pixels)[:, None] & (d < planes)[None, :]
    table_of(tl.load(likely + p[:, None] * planes + d[None, :], inside, 0.0), out, p, d, pixels, planes, step, window, BP, BD)


@kernel("paths", "out")
def _table_of_costs(paths, out, pixels, planes, scale, step, window: tl.constexpr, BP: tl.constexpr, BD: tl.constexpr):
    p = (tl.program_id(0) * BP + tl.arange(0, BP)).to(tl.int64)
    d = tl.arange(0, BD)
    table_of(likelihood(paths, p, d, pixels, planes, scale), out, p, d, pixels, planes, step, window, BP, BD)


def window_of(peak: int, planes: int) -> int:
    """Planes that count as one depth."""
    return min(2 * peak + 1, planes)


def table(likely: Tensor, step: float, peak: int) -> Tensor:
    """(D, h, w) likelihoods, farthest first → (3, D, h, w) of `DepthDistribution`; a voxel's three numbers lie next to each other."""
    volume = rows(likely)
    height, width, planes = volume.shape
    out = volume.new_empty((height, width, planes, 3))
    grid = (pieces(height * width, PIXELS),)
    _tabled[grid](volume, out, height * width, planes, step, window=window_of(peak, planes), BP=PIXELS, BD=wide(planes))
    return out.permute(3, 2, 0, 1)


def table_of_costs(cost: Tensor, correction: Tensor | None, smoothing: tuple[float, float, float], step: float, peak: int) -> Tensor:
    """`table` of the `smoothed_softmax` of (D, h, w) costs less a correction, as large, in two launches.

    Args:
        smoothing: penalties and temperature.
    """
    volume, (small, large, temperature) = rows(cost), smoothing
    height, width, planes = volume.shape
    paths = _paths(volume, small, large, None if correction is None else rows(correction))
    out = volume.new_empty((height, width, planes, 3))
    grid, sizes = (pieces(height * width, PIXELS),), {"window": window_of(peak, planes), "BP": PIXELS, "BD": wide(planes)}
    _table_of_costs[grid](paths, out, height * width, planes, -1 / temperature, step, **sizes)
    return out.permute(3, 2, 0, 1)


@kernel("paths", "rays", "inverses", "odds", "places", "row")
def _own_estimate(
    paths, rays, inverses, pose, lens, size, odds, places, row, height, width, planes, scale, lowest, step, gain, against, least,
    window: tl.constexpr, ABOUT: tl.constexpr, BP: tl.constexpr, BD: tl.constexpr,
):  # fmt: skip
    """Log odds of surface, the likeliest places where one depth stands out, and the numbers by which other key frames read them."""
    pixels = height * width
    p = (tl.program_id(0) * BP + tl.arange(0, BP)).to(tl.int64)
    d = tl.arange(0, BD)
    some = p < pixels
    likely = likelihood(paths, p, d, pixels, planes, scale)
    nearer = tl.cumsum(likely, 1, reverse=True) - 0.5 * likely
    hidden, not_free = beside(nearer, ABOUT, 0.0, BP, BD), beside(nearer, -ABOUT, 1.0, BP, BD)
    ratio = tl.log(gain * tl.maximum(not_free - hidden, 0.0) + hidden + against)
    tl.store(odds + p[:, None] * planes + d[None, :], ratio, some[:, None] & (d < planes)[None, :])
    between = nearer - beside(nearer, 1, 0.0, BP, BD)
    best = tl.argmax(tl.where((d + 1 < planes)[None, :], between, -1.0), 1)
    middle = 0.5 * (tl.load(inverses + best) + tl.load(inverses + best + 1))
    sure = peak(likely, d, planes, window, BP, BD) > least
    for axis in range(3):
        place = tl.load(rays + 3 * p + axis, some, 0.0) / middle + tl.load(pose + 4 * axis + 3)
        tl.store(places + 3 * p + axis, tl.where(sure, place, float("nan")), some)
    if tl.program_id(0) == 0:
        k = tl.arange(0, 32)
        seen_by = tl.load(pose + k, k < 12, 0.0) + tl.load(lens + k - 12, (k >= 12) & (k < 16), 0.0)
        seen_by += tl.load(size + k - 16, (k >= 16) & (k < 18), 0.0)
        spaced = tl.where(k == 18, lowest, tl.where(k == 19, step, seen_by))
        shape = tl.where(k == 20, height, tl.where(k == 21, width, planes)).to(tl.float32)
        tl.store(row + k, tl.where(k < 20, spaced, shape), k < 23)


def own_estimate(
    costs: Any, smoothing: tuple[float, float, float], peak: int, weights: tuple[float, float, int], least: float
) -> tuple[Tensor, Tensor, Tensor]:
    """What a key frame's images show alone, without the table that nobody reads.

    Args:
        costs: `CostVolume` at planes (D,) along rays (h · w, 3).
        smoothing: penalties and temperature.
        weights: of `depth_reading.log_odds`; least: of `depth_reading.confident_points`.

    Returns:
        (D, h, w) of `log_odds`, (h · w, 3) of `confident_points`, and (23,) of `numbers`, all of `depth_reading`.
    """
    volume, rays = rows(costs.cost), costs.rays
    height, width, planes = volume.shape
    paths = _paths(volume, *smoothing[:2])
    odds, places, row = torch.empty_like(volume), rays.new_empty((height * width, 3)), rays.new_empty(23)
    _own_estimate[(pieces(height * width, PIXELS),)](
        paths, rays.contiguous(), costs.inverses, *lens(costs.camera), odds, places, row, height, width, planes, -1 / smoothing[2],
        costs.lowest, costs.step, *weights[:2], least, window=window_of(peak, planes), ABOUT=weights[2], BP=PIXELS, BD=wide(planes),
    )  # fmt: skip
    return odds.permute(2, 0, 1), places, row


@kernel("out")
def _descriptors(
    images, out, height, width, per_view, per_channel, per_row, per_pixel, red, green, blue, contrast, BLOCK: tl.constexpr,
    COLOURS: tl.constexpr, GROUPS: tl.constexpr,
):  # fmt: skip
    """Colours, and the neighbours' grey without its mean, divided by its contrast."""
    p = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)[:, None]
    view = tl.program_id(1)
    k = tl.arange(0, 16)[None, :]
    y, x = p // width, p % width
    picture = images + view * per_view
    made = out + view * (COLOURS + 9 * GROUPS) * height * width + p
    some = p < height * width
    is_colour = some & (k < COLOURS)
    colour = tl.load(picture + k * per_channel + y * per_row + x * per_pixel, is_colour, 0.0)
    tl.store(made + k * height * width, colour, is_colour)
    inside = some & (k < 9)
    for group in tl.static_range(GROUPS):
        row = tl.minimum(tl.maximum(y + (k // 3 - 1) * (group + 1), 0), height - 1)
        column = tl.minimum(tl.maximum(x + (k % 3 - 1) * (group + 1), 0), width - 1)
        place = picture + row * per_row + column * per_pixel
        grey = red * tl.load(place, inside, 0.0) + green * tl.load(place + per_channel, inside, 0.0)
        grey += blue * tl.load(place + 2 * per_channel, inside, 0.0)
        apart = tl.where(inside, grey - (tl.sum(grey, 1) / 9)[:, None], 0.0)
        strength = tl.sqrt(tl.sum(apart * apart, 1) / 9) + contrast
        tl.store(made + (COLOURS + 9 * group + k) * height * width, apart / strength[:, None], inside)


def patch_descriptors(images: Tensor, grey: tuple[float, float, float], contrast: float) -> Tensor:
    """(V, 3, H, W), in any order in memory → (V, 21, H, W) of `matching.patch_descriptors` at this size."""
    views, _, height, width = images.shape
    out = torch.empty((views, CHANNELS, height, width), dtype=images.dtype, device=images.device)
    _descriptors[(pieces(height * width, BLOCK), views)](
        images, out, height, width, *images.stride(), *grey, contrast, BLOCK=BLOCK, COLOURS=COLOURS, GROUPS=GROUPS
    )
    return out


@kernel("rays", "own", "inverses")
def _grid(
    picture, pose, focal, size, rays, own, inverses, tall, wide, height, width, planes, first, last, step, BLOCK: tl.constexpr,
    CHANNELS: tl.constexpr,
):  # fmt: skip
    """Rays and descriptors of a grid's pixels, and planes from the first to the last as `torch.linspace` steps from both ends."""
    p = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    some = p < height * width
    u, v = (p % width + 0.5) / width * 2 - 1, (p // width + 0.5) / height * 2 - 1
    one, two, three, four, of_one, of_two, of_three, of_four = corners(u, v, tall, wide)
    c = tl.arange(0, 32)[None, :]
    inside = some[:, None] & (c < CHANNELS)
    channel = picture + c * tall * wide
    found = tl.load(channel + one[:, None], inside, 0.0) * of_one[:, None] + tl.load(channel + two[:, None], inside, 0.0) * of_two[:, None]
    found += tl.load(channel + three[:, None], inside, 0.0) * of_three[:, None]
    found += tl.load(channel + four[:, None], inside, 0.0) * of_four[:, None]
    tl.store(own + p[:, None] * CHANNELS + c, found, inside)
    x = ((u + 1) / 2 * tl.load(size) - tl.load(focal + 2)) / tl.load(focal)
    y = ((v + 1) / 2 * tl.load(size + 1) - tl.load(focal + 3)) / tl.load(focal + 1)
    for axis in tl.static_range(3):
        turn = pose + 4 * axis
        tl.store(rays + 3 * p + axis, x * tl.load(turn) + y * tl.load(turn + 1) + tl.load(turn + 2), some)
    inverse = tl.where(p < planes // 2, first + p * step, last - (planes - 1 - p) * step)
    tl.store(inverses + p, inverse, p < planes)


def pixels(
    descriptors: Tensor, camera: Any, shape: tuple[int, int], planes: int, first: float, last: float
) -> tuple[Tensor, Tensor, Tensor]:
    """A grid of pixels of the first view, and planes.

    Args:
        descriptors: (21, H, W) of the first view.
        camera: its camera is the first.
        shape: rows and columns of pixels, P in all, spread evenly over the image.
        planes: how many inverse depths D ≥ 2, evenly from `first` to `last`.

    Returns:
        Rays (P, 3) of unit depth in working axes, their descriptors (P, 21), and inverse depths (D,).
    """
    descriptors, count = descriptors.contiguous(), shape[0] * shape[1]
    rays, own, inverses = (descriptors.new_empty(size) for size in ((count, 3), (count, CHANNELS), (planes,)))
    _grid[(pieces(max(count, planes), BLOCK),)](
        descriptors, *lens(camera), rays, own, inverses, *descriptors.shape[1:], *shape, planes,
        first, last, (last - first) / (planes - 1), BLOCK=BLOCK, CHANNELS=CHANNELS,
    )  # fmt: skip
    return rays, own, inverses
