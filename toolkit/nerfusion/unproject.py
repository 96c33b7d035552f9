"""Voxels seen by views: projection with visibility, and what each view shows there (NeRFusion, section 3.1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from fieldfuse.backends import dispatch
from fieldfuse.nerfusion import compiled_lookup
from fieldfuse.nerfusion.aggregate import direction_spread
from fieldfuse.nerfusion.cameras import Cameras
from fieldfuse.nerfusion.extras.plane_sweep import DepthDistribution
from fieldfuse.nerfusion.pyramid import Pyramid

MARGIN = 1.0  # voxels
COLOURED = 0.35  # of a voxel's side: with a whole one pictures of fern and of a living room are 0.7 to 0.9 dB worse


@dataclass(frozen=True)
class EncodedView:
    """What is looked up of a view: `features` (image features and direction codes), `colours` (RGB in [−2, 2]), and what it is compared
    with others by (`matching.patch_descriptors`)."""

    features: Pyramid
    colours: Pyramid
    descriptors: Tensor


@dataclass(frozen=True)
class Projection:
    """N voxels in K views.

    Attributes:
        pixels: (K, N, 2), finite also where a view does not see the voxel.
        visible: (K, N) bool.
        footprint: (K, N) pixels that a voxel covers.
    """

    pixels: Tensor
    visible: Tensor
    footprint: Tensor

    def __getitem__(self, kept: Tensor) -> Projection:
        """The voxels at `kept`."""
        return Projection(self.pixels[:, kept], self.visible[:, kept], self.footprint[:, kept])


@dataclass(frozen=True)
class KeyFrame:
    """A key frame (first) and its K − 1 neighbours.

    Attributes:
        views, cameras: K of each.
        near, far: depths along z within which views count, working units.
        distribution: of depth along the key frame's pixels (not in the paper).
    """

    views: Sequence[EncodedView]
    cameras: Cameras
    near: float
    far: float
    distribution: DepthDistribution


def project(points: Tensor, size: Tensor, cameras: Cameras, near: float, far: float) -> Projection:
    """Project voxels into all views.

    A view sees a voxel when its depth lies in (near, far] and its pixel inside the picture or less than `MARGIN` voxels beside it, so that
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
    if compiled_lookup.fits(tables, projection.pixels, step, projection.footprint):
        return _filled(views, projection, step)
    if dispatch.can_use_triton(*tables, projection.pixels, step, projection.footprint):
        from fieldfuse.backends.triton import feature_lookup as lookup

        return lookup.look_up(views, projection.pixels, step, projection.footprint, COLOURED)
    parts = []
    for view, pixels, footprint in zip(views, projection.pixels, projection.footprint, strict=True):
        fine = [view.features.lookup(pixels, step), view.colours.lookup(pixels, step)]
        parts.append(torch.cat([*fine, view.colours.lookup(pixels, COLOURED * footprint)], 1))
    return torch.stack(parts)


def _filled(views: Sequence[EncodedView], projection: Projection, step: Tensor) -> Tensor:
    """The same without gradients: one tensor, into which kernels write."""
    features, colours = views[0].features.rows.shape[1], views[0].colours.rows.shape[1]
    out = step.new_empty((len(views), len(step), features + 2 * colours))
    for view, pixels, footprint, into in zip(views, projection.pixels, projection.footprint, out, strict=True):
        view.features.lookup_into(pixels, step, into)
        view.colours.lookup_into(pixels, step, into, features)
        view.colours.lookup_into(pixels, COLOURED * footprint, into, features + colours)
    return out
