"""Voxels seen by views: projection with visibility, and what each view shows there (NeRFusion, section 3.1).

A voxel that covers many pixels must read a map of coarse cells, or what it reads is a matter of chance (aliasing), and the variance over
views means nothing. So maps are pyramids, and each lookup names the size that it is for.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from fieldfuse.backends import dispatch
from fieldfuse.nerfusion.aggregate import direction_spread
from fieldfuse.nerfusion.cameras import Cameras
from fieldfuse.nerfusion.extras.plane_sweep import DepthDistribution

MARGIN = 1.0  # voxels
COLOURED = 0.35  # of a voxel's side: with a whole one images of fern and of a living room are 0.7 to 0.9 dB worse


@dataclass(frozen=True)
class Pyramid:
    """Maps of an image at several sizes, each half of the one before, as one table of rows."""

    rows: Tensor  # (R, C), one level after the other, each row by row
    sizes: tuple[tuple[int, int], ...]  # height and width of each level
    stride: int  # pixels of the image a cell of the first level; it doubles from level to level

    def lookup(self, pixels: Tensor, footprint: Tensor) -> Tensor:
        """Bilinear values.

        Args:
            pixels: (N, 2) in the image; beyond the border the border's value is taken.
            footprint: (N,) pixels that the value is for: the level whose cells are nearest to that size (by ratio) is read.

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


def pyramid_rows(images: Tensor, levels: int) -> Tensor:
    """(V, C, h, w), first levels → (V, R, C) rows of pyramids."""
    maps = [images]
    for _ in pyramid_sizes(images.shape[2], images.shape[3], levels)[1:]:
        maps.append(F.avg_pool2d(maps[-1], 2))
    return torch.cat([level.flatten(2).transpose(1, 2) for level in maps], 1)


def pyramid_sizes(height: int, width: int, levels: int) -> tuple[tuple[int, int], ...]:
    """(height, width) of each level."""
    out = [(height, width)]
    while len(out) < levels and out[-1][0] % 2 == 0 and out[-1][1] % 2 == 0:
        out.append((out[-1][0] // 2, out[-1][1] // 2))
    return tuple(out)


@lru_cache(maxsize=8)
def pyramid_pixels(sizes: tuple[tuple[int, int], ...], stride: int, device: torch.device, kind: torch.dtype) -> Tensor:
    """(R, 2) the pixel of the image (centres at +0.5) at the middle of each cell; images of a capture share them."""
    parts = []
    for level, (height, width) in enumerate(sizes):
        v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        parts.append((torch.stack([u, v], -1).view(-1, 2) + 0.5) * stride * 2**level)
    return torch.cat(parts).to(device, kind)


@dataclass(frozen=True)
class EncodedView:
    """What is looked up of a view."""

    features: Pyramid  # image features and direction codes
    colours: Pyramid  # RGB in [−2, 2]
    descriptors: Tensor  # by which it is compared with others (`matching.patch_descriptors`)


@dataclass(frozen=True)
class KeyFrame:
    """A key frame (first) and its K − 1 neighbours."""

    views: Sequence[EncodedView]
    cameras: Cameras
    near: float = 0.0  # depths along z within which views count, working units
    far: float = math.inf
    distribution: DepthDistribution | None = None  # of depth along the key frame's pixels (not in the paper); None: the model makes it


@dataclass(frozen=True)
class Projection:
    """N voxels in K views."""

    pixels: Tensor  # (K, N, 2), finite also where a view does not see the voxel
    visible: Tensor  # (K, N) bool
    footprint: Tensor  # (K, N) pixels that a voxel covers

    def __getitem__(self, kept: Tensor) -> Projection:
        """The voxels at `kept`."""
        return Projection(self.pixels[:, kept], self.visible[:, kept], self.footprint[:, kept])


def project(points: Tensor, size: Tensor, cameras: Cameras, near: float, far: float) -> Projection:
    """Project voxels into all views.

    A view sees a voxel when its depth lies in (near, far] and its pixel inside the image or less than `MARGIN` voxels beside it, so that
    cells that reach over the border are whole. What hides a voxel is not known here.

    Args:
        points: (N, 3) working frame.
        size: (N,) side of each voxel, working units.
    """
    local = cameras.local(points)  # (K, N, 3)
    depth = local[..., 2]
    deep = (depth > max(near, 0.0)) & (depth <= far)
    safe = torch.where(deep, depth, torch.ones_like(depth))
    focal, middle = cameras.intrinsics[:, None, :2], cameras.intrinsics[:, None, 2:]
    pixels = local[..., :2] / safe[..., None] * focal + middle
    footprint = size * focal.mean(2) / safe
    margin = (MARGIN * footprint)[..., None]
    visible = deep & ((pixels >= -margin) & (pixels <= cameras.size[:, None] + margin)).all(2)
    footprint = torch.where(visible, footprint, torch.ones_like(safe))
    return Projection(torch.where(visible[..., None], pixels, torch.zeros_like(pixels)), visible, footprint)


def scales(points: Tensor, projection: Projection, cameras: Cameras) -> tuple[Tensor, Tensor]:
    """(N,) pixels that each voxel covers, a geometric mean over the views that see it, and (N,) pixels by which these disagree about its
    neighbour in depth."""
    visible = projection.visible
    footprint = torch.exp((torch.log(projection.footprint) * visible).sum(0) / visible.sum(0).clamp_min(1))
    return footprint, footprint * direction_spread(points, cameras.positions, visible)


def look_up(views: Sequence[EncodedView], projection: Projection, step: Tensor) -> Tensor:
    """What each view shows at the voxels. Where it does not see one: anything finite.

    Two sizes matter. To tell depths apart, views are compared at the size of `step`: larger cells look the same from voxel to voxel (and a
    voxel is often many pixels wide while its neighbour in depth is less than a pixel away), smaller ones differ by chance. To colour the
    voxel, they are averaged over a part of what it covers: interpolation between voxels blurs once more.

    Args:
        step: (N,) pixels by which views disagree about the voxel's neighbour in depth.

    Returns:
        (K, N, C): features and direction code (F), colour at the size of the step (3), colour for the voxel (3).
    """
    tables = [pyramid.rows for view in views for pyramid in (view.features, view.colours)]
    values = *tables, projection.pixels, step, projection.footprint
    learning = torch.is_grad_enabled() and any(rows.requires_grad for rows in tables)
    if (kernels := dispatch.kernels("feature_lookup", *values)) and not (learning and dispatch.is_cpu(step.device)):
        return kernels.look_up(views, projection.pixels, step, projection.footprint, COLOURED)
    parts = []
    for view, pixels, footprint in zip(views, projection.pixels, projection.footprint, strict=True):
        fine = [view.features.lookup(pixels, step), view.colours.lookup(pixels, step)]
        parts.append(torch.cat([*fine, view.colours.lookup(pixels, COLOURED * footprint)], 1))
    return torch.stack(parts)
