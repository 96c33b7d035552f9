# mypy: disable-error-code="no-untyped-def,untyped-decorator,misc"
"""What pictures are compared by on CUDA, and the grid of pixels that ask, a launch each (`matching.describe`, `sweep._pixels`)."""

from __future__ import annotations

from typing import Any

import torch
import triton.language as tl
from torch import Tensor

from fieldfuse.backends.triton.launch import kernel, pieces
from fieldfuse.networks.gpu.matching import CHANNELS, COLOURS, corners, lens

BLOCK = 32  # pixels whose neighbours or channels are looked at together
GROUPS = (CHANNELS - COLOURS) // 9  # of 3×3 neighbours, the n-th of them n pixels apart


@kernel("out")
def _describe(
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


def describe(images: Tensor, grey: tuple[float, float, float], contrast: float) -> Tensor:
    """(V, 3, H, W), in any order in memory → (V, 21, H, W) of `matching.describe` at this size."""
    views, _, height, width = images.shape
    out = torch.empty((views, CHANNELS, height, width), dtype=images.dtype, device=images.device)
    _describe[(pieces(height * width, BLOCK), views)](
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


def pixels(described: Tensor, camera: Any, shape: tuple[int, int], planes: int, first: float, last: float) -> tuple[Tensor, Tensor, Tensor]:
    """What asks of a sweep.

    Args:
        described: (21, H, W) of the first view.
        camera: its camera is the first.
        shape: rows and columns of pixels that ask, P in all, spread evenly over the picture.
        planes: how many inverse depths D ≥ 2, evenly from `first` to `last`.

    Returns:
        Rays (P, 3) of unit depth in working axes, their descriptors (P, 21), and inverse depths (D,).
    """
    described, count = described.contiguous(), shape[0] * shape[1]
    rays, own, inverses = (described.new_empty(size) for size in ((count, 3), (count, CHANNELS), (planes,)))
    _grid[(pieces(max(count, planes), BLOCK),)](
        described, *lens(camera), rays, own, inverses, *described.shape[1:], *shape, planes,
        first, last, (last - first) / (planes - 1), BLOCK=BLOCK, CHANNELS=CHANNELS,
    )  # fmt: skip
    return rays, own, inverses
