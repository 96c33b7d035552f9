"""Pixels of a sample's targets that a step renders: rays, true colours and true depths."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from fieldfuse.backends.dispatch import to_device_async
from fieldfuse.nerfusion.training.samples import Pictures

Tensor = torch.Tensor
HIDDEN = 0.05  # relative: what lies this much behind what a picture shows is not shown by it


@dataclass(frozen=True)
class TargetRays:
    """Rays of random pixels.

    Attributes:
        origins, directions: (R, 3), directions of unit length.
        colour: (R, 3) true colour.
        distance: (R,) true distance along the ray, 0 = unknown or nothing there.
        cosine: (R,) depth along z = distance · cosine.
        solid: (R,) bool, the ray meets something for certain.
    """

    origins: Tensor
    directions: Tensor
    colour: Tensor
    distance: Tensor
    cosine: Tensor
    solid: Tensor

    def __len__(self) -> int:
        return len(self.origins)

    def __getitem__(self, kept: Tensor) -> TargetRays:
        """The rays at `kept` (indices or bool)."""
        return TargetRays(*(getattr(self, name)[kept] for name in self.__dataclass_fields__))


def rays_through(pictures: Pictures, view: Tensor, row: Tensor, column: Tensor) -> TargetRays:
    """Rays through pixel centres; `view`, `row`, `column` (R,) int64 into `pictures`."""
    fx, fy, cx, cy = pictures.intrinsics[view].unbind(1)
    local = torch.stack([(column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy, torch.ones_like(fx)], 1)
    cosine = 1 / local.norm(dim=1)
    pose = pictures.world_from_camera[view]
    directions = (pose[:, :3, :3] @ (local * cosine[:, None])[:, :, None])[:, :, 0]
    depth = pictures.depths[view, row, column]
    solid = torch.ones_like(depth, dtype=torch.bool) if pictures.background is None else depth > 0
    return TargetRays(pose[:, :3, 3], directions, pictures.images[view, :, row, column], depth / cosine, cosine, solid)


def random_rays(pictures: Pictures, targets: Tensor, count: int, generator: torch.Generator) -> TargetRays:
    """`count` random pixels, evenly over the pictures at `targets` (any shape). The generator is a CPU one, on every device."""
    height, width = pictures.images.shape[2:]
    flat = targets.reshape(-1).cpu()
    view = flat[torch.arange(count) % len(flat)]
    pixel = torch.randint(height * width, (count,), generator=generator)
    chosen = torch.stack([view, pixel // width, pixel % width]).numpy()
    return rays_through(pictures, *to_device_async(chosen, pictures.images.device).unbind())


def in_sight(rays: TargetRays, pictures: Pictures, references: Tensor) -> Tensor:
    """(R,) bool: at least one of the pictures at `references` (any shape) shows where a ray ends, or nobody knows where it ends.

    What no reference shows cannot be predicted; such rays would only add noise to the gradient. Where a reference's depth is not known,
    what hides the end is not asked.
    """
    points = rays.origins + rays.directions * rays.distance[:, None]
    height, width = pictures.images.shape[2:]
    seen = rays.distance == 0
    views = references.reshape(-1)
    pose, lens = pictures.world_from_camera[views], pictures.intrinsics[views]
    fx, fy, cx, cy = (value[:, None] for value in lens.unbind(1))
    local = (points - pose[:, None, :3, 3]) @ pose[:, :3, :3]  # (V, R, 3)
    depth = local[..., 2].clamp_min(1e-9)
    u, v = local[..., 0] / depth * fx + cx, local[..., 1] / depth * fy + cy
    inside = (local[..., 2] > 0) & (u >= 0) & (u <= width) & (v >= 0) & (v <= height)
    there = pictures.depths[views[:, None], v.long().clamp(0, height - 1), u.long().clamp(0, width - 1)]
    return seen | (inside & ((there == 0) | (depth <= (1 + HIDDEN) * there))).any(0)


def picture_rays(pictures: Pictures, view: int) -> TargetRays:
    """All pixels of one picture, row by row."""
    height, width = pictures.images.shape[2:]
    pixel = torch.arange(height * width, device=pictures.images.device)
    return rays_through(pictures, torch.full_like(pixel, view), pixel // width, pixel % width)
