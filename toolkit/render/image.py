"""Whole pictures of a field: colour, depth along z and opacity at a camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from toolkit.camera import Array, Intrinsics, pixel_grid, rays
from toolkit.render.field import Field
from toolkit.render.rays import render_rays

CHUNK = 8192
SOLID = 0.5  # depth is given where at least this much of the light is stopped


@dataclass(frozen=True)
class Rendered:
    """A picture: `rgb` (H, W, 3) float32 in [0, 1], `depth` (H, W) float32 along z in working units (0 = none), `opacity` (H, W)
    float32."""

    rgb: Array
    depth: Array
    opacity: Array


def render_view(field: Field, intrinsics: Intrinsics, world_from_camera: Array, chunk: int = CHUNK) -> Rendered:
    """The field as a pinhole camera at `world_from_camera` (4, 4), working frame, sees it."""
    height, width = intrinsics.height, intrinsics.width
    origins, directions, cosine = rays(intrinsics, world_from_camera, pixel_grid(width, height))
    colour, depth, opacity = [], [], []
    for start in range(0, len(origins), chunk):
        part = slice(start, start + chunk)
        values = render_rays(field, origins[part].to(field.device), directions[part].to(field.device))
        colour.append(values.colour.cpu())
        opacity.append(values.opacity.cpu())
        depth.append(torch.where(values.opacity.cpu() >= SOLID, values.distance.cpu() * cosine[part], torch.zeros(1)))
    return Rendered(
        torch.cat(colour).view(height, width, 3).numpy().astype(np.float32),
        torch.cat(depth).view(height, width).numpy().astype(np.float32),
        torch.cat(opacity).view(height, width).numpy().astype(np.float32),
    )
