"""Bilinear lookup in pyramids, place by place (`Pyramid.lookup` in tensors)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numba import njit
from torch import Tensor

from fieldfuse.backends.numba.tensors import OPTIONS, F, array, spread


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


def look_up(views: Sequence[Any], pixels: Tensor, step: Tensor, footprint: Tensor, part: float) -> Tensor:
    """(K, N, C) as `unproject.look_up`, of K views at pixels (K, N, 2), with steps (N,) and footprints (K, N)."""
    features, colours = views[0].features.rows.shape[1], views[0].colours.rows.shape[1]
    out = step.new_empty((len(views), len(step), features + 2 * colours))
    for view, places, cells, into in zip(views, pixels, footprint, out, strict=True):
        _into(view.features, places, step, into, 0)
        _into(view.colours, places, step, into, features)
        _into(view.colours, places, part * cells, into, features + colours)
    return out


def _into(pyramid: Any, pixels: Tensor, footprint: Tensor, out: Tensor, first: int) -> None:
    """`pyramid.lookup` into columns `first` … of `out` (N, C')."""
    ends = np.cumsum([height * width for height, width in pyramid.sizes])
    levels = np.array([(end - height * width, height, width) for end, (height, width) in zip(ends, pyramid.sizes, strict=True)], np.int64)
    bounds = np.array([pyramid.stride * math.sqrt(2) * 2**level for level in range(len(levels) - 1)], np.float32)  # nearest by ratio
    given = array(pyramid.rows), levels, F(pyramid.stride), bounds
    places, sides, into = array(pixels), array(footprint), out.numpy()
    spread(lambda n: _look_up(*given, places[n], sides[n], first, into[n]), len(places))
