# mypy: disable-error-code="no-untyped-def,untyped-decorator,misc"
"""What views show at voxels on CUDA, a launch a view (`Pyramid.lookup` and `unproject.look_up` in tensors)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from fieldfuse.backends.triton.launch import kernel, pieces, power_of_two

BLOCK = 64  # voxels at a time


@triton.jit
def corners(x, y, footprint, height, width, levels, STRIDE: tl.constexpr):
    """Rows of the four cells about pixels in the level whose cells are nearest to a footprint, and their weights."""
    level = tl.minimum(tl.floor(tl.log2(tl.maximum(footprint / STRIDE, 1.0)) + 0.5), levels - 1.0).to(tl.int32)
    first = tl.zeros_like(level)
    for k in range(6):  # more levels than there are
        first += tl.where(level > k, (height >> k) * (width >> k), 0)
    tall, wide = height >> level, width >> level
    scale = 1.0 / (STRIDE * (1 << level).to(tl.float32))
    x = tl.minimum(tl.maximum(x * scale - 0.5, 0.0), (wide - 1).to(tl.float32))
    y = tl.minimum(tl.maximum(y * scale - 0.5, 0.0), (tall - 1).to(tl.float32))
    left, top = tl.floor(x), tl.floor(y)
    fx, fy = x - left, y - top
    column, row = left.to(tl.int32), top.to(tl.int32)
    right, below = tl.where(column + 1 < wide, 1, 0), tl.where(row + 1 < tall, wide, 0)
    corner = first + row * wide + column
    return corner, right, below, (1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy


@triton.jit
def _read(table, out, stride, column, n, some, corner, right, below, w0, w1, w2, w3, CHANNELS: tl.constexpr, WIDE: tl.constexpr):
    """Write the weighted mean of four rows into columns of `out`."""
    c = tl.arange(0, WIDE)[None, :]
    mask = some[:, None] & (c < CHANNELS)
    at = table + corner[:, None] * CHANNELS + c
    value = tl.load(at, mask, 0.0) * w0[:, None]
    value += tl.load(at + right[:, None] * CHANNELS, mask, 0.0) * w1[:, None]
    value += tl.load(at + below[:, None] * CHANNELS, mask, 0.0) * w2[:, None]
    value += tl.load(at + (right + below)[:, None] * CHANNELS, mask, 0.0) * w3[:, None]
    tl.store(out + n[:, None] * stride + column + c, value, mask)


@kernel("features")
def _shown(
    pixels, step, footprint, features, colours, out, count, height, width, levels, down, across, fine_levels, part,
    CHANNELS: tl.constexpr, WIDE: tl.constexpr, COLOURS: tl.constexpr, FINE: tl.constexpr, STRIDE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    n = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    some = n < count
    x, y = tl.load(pixels + 2 * n, some, 0.0), tl.load(pixels + 2 * n + 1, some, 0.0)
    size, cell = tl.load(step + n, some, 1.0), tl.load(footprint + n, some, 1.0)
    stride: tl.constexpr = CHANNELS + 2 * COLOURS
    corner, right, below, w0, w1, w2, w3 = corners(x, y, size, height, width, levels, STRIDE)
    _read(features, out, stride, 0, n, some, corner, right, below, w0, w1, w2, w3, CHANNELS, WIDE)
    corner, right, below, w0, w1, w2, w3 = corners(x, y, size, down, across, fine_levels, FINE)
    _read(colours, out, stride, CHANNELS, n, some, corner, right, below, w0, w1, w2, w3, COLOURS, 4)
    corner, right, below, w0, w1, w2, w3 = corners(x, y, part * cell, down, across, fine_levels, FINE)
    _read(colours, out, stride, CHANNELS + COLOURS, n, some, corner, right, below, w0, w1, w2, w3, COLOURS, 4)


@kernel("total")
def _spread(
    pixels, step, slopes, total, count, height, width, levels, stride,
    CHANNELS: tl.constexpr, WIDE: tl.constexpr, STRIDE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Add the gradients of what was read to the rows that it was read from."""
    n = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    some = n < count
    x, y, size = tl.load(pixels + 2 * n, some, 0.0), tl.load(pixels + 2 * n + 1, some, 0.0), tl.load(step + n, some, 1.0)
    corner, right, below, w0, w1, w2, w3 = corners(x, y, size, height, width, levels, STRIDE)
    c = tl.arange(0, WIDE)[None, :]
    mask = some[:, None] & (c < CHANNELS)
    slope = tl.load(slopes + n[:, None] * stride + c, mask, 0.0)
    at = total + corner[:, None] * CHANNELS + c
    tl.atomic_add(at, slope * w0[:, None], mask)
    tl.atomic_add(at + right[:, None] * CHANNELS, slope * w1[:, None], mask)
    tl.atomic_add(at + below[:, None] * CHANNELS, slope * w2[:, None], mask)
    tl.atomic_add(at + (right + below)[:, None] * CHANNELS, slope * w3[:, None], mask)


class _Shown(torch.autograd.Function):
    """`_look_up` with gradients for the features' rows, which are summed in no fixed order."""

    @staticmethod
    def forward(ctx: Any, views: Sequence[Any], pixels: Tensor, step: Tensor, footprint: Tensor, part: float, *rows: Tensor) -> Tensor:
        ctx.save_for_backward(pixels, step)
        ctx.shapes = [(one.features.rows.shape, one.features.sizes, one.features.stride) for one in views]
        return _look_up(views, pixels, step, footprint, part)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        pixels, step = ctx.saved_tensors
        gradient, pixels, step = gradient.contiguous(), pixels.contiguous(), step.contiguous()
        totals: list[Tensor] = []
        for number, (shape, sizes, stride) in enumerate(ctx.shapes):
            total = gradient.new_zeros(shape)
            if len(step):
                _spread[(pieces(len(step), BLOCK),)](
                    pixels[number], step, gradient[number], total, len(step), *sizes[0], len(sizes), gradient.shape[2],
                    CHANNELS=shape[1], WIDE=power_of_two(shape[1]), STRIDE=stride, BLOCK=BLOCK,
                )  # fmt: skip
            totals.append(total)
        return None, None, None, None, None, *totals


def look_up(views: Sequence[Any], pixels: Tensor, step: Tensor, footprint: Tensor, part: float) -> Tensor:
    """(K, N, C) as `unproject.look_up`, of K views at pixels (K, N, 2), with steps (N,) and footprints (K, N)."""
    rows = [one.features.rows for one in views]
    if torch.is_grad_enabled() and any(one.requires_grad for one in rows):
        found: Tensor = _Shown.apply(views, pixels, step, footprint, part, *rows)
        return found
    return _look_up(views, pixels, step, footprint, part)


def _look_up(views: Sequence[Any], pixels: Tensor, step: Tensor, footprint: Tensor, part: float) -> Tensor:
    count = len(step)
    channels, colours = views[0].features.rows.shape[1], views[0].colours.rows.shape[1]
    out = step.new_empty((len(views), count, channels + 2 * colours))
    if count == 0:
        return out
    pixels, step, footprint = pixels.contiguous(), step.contiguous(), footprint.contiguous()
    for number, view in enumerate(views):
        fine = view.colours
        _shown[(pieces(count, BLOCK),)](
            pixels[number], step, footprint[number], view.features.rows, fine.rows, out[number], count,
            *view.features.sizes[0], len(view.features.sizes), *fine.sizes[0], len(fine.sizes), part,
            CHANNELS=channels, WIDE=power_of_two(channels), COLOURS=colours, FINE=fine.stride, STRIDE=view.features.stride,
            BLOCK=BLOCK,
        )  # fmt: skip
    return out
