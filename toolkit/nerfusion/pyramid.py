"""Maps of a picture at several sizes as one table of rows, and bilinear lookup in it at places of its own size each.

A voxel that covers many pixels must read a map of coarse cells, or what it reads is a matter of chance (aliasing), and the variance
over views says nothing. So each lookup names its level.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from fieldfuse.nerfusion import compiled_lookup


@dataclass(frozen=True)
class Pyramid:
    """Maps of halving size, rows of all levels one after the other.

    Attributes:
        rows: (R, C), each level row by row.
        sizes: (height, width) of each level.
        stride: pixels of the picture a cell of the first level; it doubles from level to level.
    """

    rows: Tensor
    sizes: tuple[tuple[int, int], ...]
    stride: int

    @classmethod
    def of(cls, image: Tensor, stride: int, levels: int) -> Pyramid:
        """(C, h, w), the first level → a pyramid by averaging 2×2 cells, as long as both sides are even."""
        return pyramids(image[None], stride, levels)[0]

    def lookup(self, pixels: Tensor, footprint: Tensor) -> Tensor:
        """Bilinear values.

        Args:
            pixels: (N, 2) in the picture; beyond the border the border's value is taken.
            footprint: (N,) pixels that what is looked for covers: the level whose cells are nearest to that size (by ratio) is read.

        Returns:
            (N, C); differentiable in `rows`.
        """
        level = torch.log2((footprint / self.stride).clamp_min(1)).round_().clamp_max_(len(self.sizes) - 1).long()
        table = torch.tensor(self.sizes, device=pixels.device)
        starts = torch.cat([table.new_zeros(1), table.prod(1).cumsum(0)[:-1]])
        height, width = table[level].unbind(1)
        place = pixels / (self.stride * 2.0**level)[:, None] - 0.5
        place = torch.minimum(place.clamp_min(0), torch.stack([width - 1, height - 1], 1).to(place))
        low = place.floor()
        fx, fy = (place - low).unbind(1)
        x, y = low.long().unbind(1)
        right, below = (x + 1 < width).long(), (y + 1 < height).long() * width
        first = starts[level] + y * width + x
        rows = torch.stack([first, first + right, first + below, first + below + right], 1)
        weights = torch.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy], 1)
        found: Tensor = _Lookup.apply(self.rows, rows, weights)
        return found

    def lookup_into(self, pixels: Tensor, footprint: Tensor, out: Tensor, first: int = 0) -> None:
        """`lookup` into columns `first` … of `out` (N, C'), where `compiled_lookup.fits`; nothing of it is differentiable."""
        compiled_lookup.look_up(self.rows, self.sizes, self.stride, pixels, footprint, out, first)


def pyramids(images: Tensor, stride: int, levels: int) -> list[Pyramid]:
    """(V, C, h, w), first levels → pyramids by averaging 2×2 cells, as long as both sides are even."""
    rows = levelled(images, levels)
    sizes = sizes_of(images.shape[2], images.shape[3], levels)
    return [Pyramid(one, sizes, stride) for one in rows.contiguous()]


def levelled(images: Tensor, levels: int) -> Tensor:
    """(V, C, h, w), first levels → (V, R, C) rows of pyramids."""
    maps = [images]
    for _ in sizes_of(images.shape[2], images.shape[3], levels)[1:]:
        maps.append(F.avg_pool2d(maps[-1], 2))
    return torch.cat([level.flatten(2).transpose(1, 2) for level in maps], 1)


def sizes_of(height: int, width: int, levels: int) -> tuple[tuple[int, int], ...]:
    """(height, width) of each level."""
    out = [(height, width)]
    while len(out) < levels and out[-1][0] % 2 == 0 and out[-1][1] % 2 == 0:
        out.append((out[-1][0] // 2, out[-1][1] // 2))
    return tuple(out)


@lru_cache(maxsize=8)
def middles(sizes: tuple[tuple[int, int], ...], stride: int, device: torch.device, kind: torch.dtype) -> Tensor:
    """(R, 2) the pixel of the picture (centres at +0.5) at the middle of each cell; pictures of a capture share them."""
    parts = []
    for level, (height, width) in enumerate(sizes):
        v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        parts.append((torch.stack([u, v], -1).view(-1, 2) + 0.5) * stride * 2**level)
    return torch.cat(parts).to(device, kind)


class _Lookup(torch.autograd.Function):
    """Weighted sums of four rows; the gradient goes back by four additions (that of `embedding_bag` is much dearer)."""

    @staticmethod
    def forward(ctx: Any, table: Tensor, rows: Tensor, weights: Tensor) -> Tensor:
        ctx.save_for_backward(rows, weights)
        ctx.size = len(table)
        return F.embedding_bag(rows, table, mode="sum", per_sample_weights=weights.to(table.dtype))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, None, None]:
        rows, weights = ctx.saved_tensors
        total = gradient.new_zeros((ctx.size, gradient.shape[1]))
        for corner in range(4):
            total.index_add_(0, rows[:, corner], gradient * weights[:, corner, None].to(gradient.dtype))
        return total, None, None
