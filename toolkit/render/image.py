"""Whole pictures of a field: colour, depth along z and opacity at a camera."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Protocol

import numpy as np
import torch

from toolkit.camera import Array, Intrinsics, pixel_grid, rays
from toolkit.networks.decoder import Deferred
from toolkit.render.field import Field
from toolkit.render.rays import RayValues, render_rays
from toolkit.render.sky import on_sky

CHUNK = 8192  # rays that torch renders at a time
SOLID = 0.5  # depth is given where at least this much of the light is stopped


@dataclass(frozen=True)
class Rendered:
    """A picture: `rgb` (H, W, 3) float32 in [0, 1], `depth` (H, W) float32 along z in working units (0 = none), `opacity` (H, W)
    float32."""

    rgb: Array
    depth: Array
    opacity: Array


class View(Protocol):
    """What gives colours, distances and opacities for rays."""

    def __call__(self, origins: torch.Tensor, directions: torch.Tensor) -> RayValues: ...


def make_renderer(field: Field, engine: str = "auto") -> View:
    """What renders rays of `field`, for many pictures: compiled on the CPU, torch elsewhere.

    Args:
        engine: auto | numba | torch. The compiled one runs on the CPU alone.
    """
    if engine == "torch" or field.device.type != "cpu":
        return partial(_in_chunks, field)
    from toolkit.render.compiled import CompiledRenderer
    from toolkit.render.compiled_per_sample import PerSampleRenderer

    compiled = CompiledRenderer(field) if isinstance(field.decoder, Deferred) else PerSampleRenderer(field)

    def render(origins: torch.Tensor, directions: torch.Tensor) -> RayValues:
        values = compiled.render(origins, directions)
        return RayValues(values[:, :3], values[:, 3], values[:, 4])

    return render


def _in_chunks(field: Field, origins: torch.Tensor, directions: torch.Tensor) -> RayValues:
    """Torch keeps every sample of a batch in memory, so a picture is taken piece by piece."""
    parts = [
        render_rays(field, o.to(field.device), d.to(field.device))
        for o, d in zip(origins.split(CHUNK), directions.split(CHUNK), strict=True)
    ]
    return RayValues(*(torch.cat([getattr(part, name).cpu() for part in parts]) for name in ("colour", "distance", "opacity")))


def render_view(field: Field, intrinsics: Intrinsics, world_from_camera: Array, view: View | None = None) -> Rendered:
    """The field as a pinhole camera at `world_from_camera` (4, 4), working frame, sees it. `view`: see `make_renderer`."""
    height, width = intrinsics.height, intrinsics.width
    origins, directions, cosine = rays(intrinsics, world_from_camera, pixel_grid(width, height))
    view = view or make_renderer(field)
    values = view(origins, directions)
    depth = torch.where(values.opacity >= SOLID, values.distance * cosine, torch.zeros(1))
    colour = on_sky(values.colour, values.opacity, directions, field.background.cpu(), field.sky)
    shape = (height, width)
    return Rendered(
        colour.reshape(*shape, 3).numpy().astype(np.float32),
        depth.view(shape).numpy().astype(np.float32),
        values.opacity.reshape(shape).numpy().astype(np.float32),
    )
