"""Bilinear lookup in pyramids on the CPU, compiled: what `Pyramid.lookup` does with a dozen whole tensors, place by place."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

from fieldfuse.nerfusion.compiled import OPTIONS, F, spread


@njit(**OPTIONS)
def _look_up(rows: Any, levels: Any, stride: Any, bounds: Any, pixels: Any, footprint: Any, first: int, out: Any) -> None:
    """Into columns `first` … of `out` (N, C'); `levels` (L, 3) start, height and width of each, `bounds` (L − 1,) of footprints."""
    channels = rows.shape[1]
    for n in range(len(pixels)):
        level = 0
        while level < len(bounds) and footprint[n] > bounds[level]:
            level += 1
        start, height, width = levels[level, 0], levels[level, 1], levels[level, 2]
        cell = stride * F(1 << level)
        x = min(max(pixels[n, 0] / cell - F(0.5), F(0)), F(width - 1))
        y = min(max(pixels[n, 1] / cell - F(0.5), F(0)), F(height - 1))
        # Whole numbers are bounded once more: what is no number must not be read at.
        left, upper = min(max(int(x), 0), width - 1), min(max(int(y), 0), height - 1)
        right, lower = min(left + 1, width - 1), min(upper + 1, height - 1)
        sx, sy = x - F(left), y - F(upper)
        w00, w01, w10, w11 = (F(1) - sx) * (F(1) - sy), sx * (F(1) - sy), (F(1) - sx) * sy, sx * sy
        a, b = rows[start + upper * width + left], rows[start + upper * width + right]
        c, d = rows[start + lower * width + left], rows[start + lower * width + right]
        own = out[n]
        for k in range(channels):
            own[first + k] = w00 * a[k] + w01 * b[k] + w10 * c[k] + w11 * d[k]


def look_up(
    rows: Tensor, sizes: Sequence[tuple[int, int]], stride: int, pixels: Tensor, footprint: Tensor, out: Tensor, first: int = 0
) -> None:
    """`Pyramid.lookup` of float32 values on the CPU into columns `first` … of `out` (N, C'), which lies in memory row by row."""
    ends = np.cumsum([height * width for height, width in sizes])
    levels = np.array([(end - height * width, height, width) for end, (height, width) in zip(ends, sizes, strict=True)], np.int64)
    bounds = np.array([stride * math.sqrt(2) * 2**level for level in range(len(sizes) - 1)], np.float32)  # nearest by ratio
    given = rows.detach().contiguous().numpy(), levels, F(stride), bounds
    places, sides, into = pixels.contiguous().numpy(), footprint.contiguous().numpy(), out.numpy()
    spread(lambda n: _look_up(*given, places[n], sides[n], first, into[n]), len(places))


def fits(out_of: Sequence[Tensor], *values: Tensor) -> bool:
    """Whether the kernel can take these: float32 on the CPU, and nobody asks for gradients."""
    if torch.is_grad_enabled() and any(rows.requires_grad for rows in out_of):
        return False
    return all(value.device.type == "cpu" and value.dtype == torch.float32 for value in (*out_of, *values))
