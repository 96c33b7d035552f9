"""Whole renders of a field: colour, depth along z and opacity at a camera."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Protocol

import numpy as np
import torch

from fieldfuse.backends.dispatch import choose_engine
from fieldfuse.camera import Array, Intrinsics, pixel_grid, rays
from fieldfuse.nerfusion.decoder import Deferred
from fieldfuse.render.field import Field
from fieldfuse.render.rays import RayValues, render_rays
from fieldfuse.render.sky import on_sky

CHUNK = 8192  # rays that torch renders at a time
SOLID = 0.5  # depth is given where at least this much of the light is stopped


@dataclass(frozen=True)
class Rendered:
    """A render: `rgb` (H, W, 3) float32 in [0, 1], `depth` (H, W) float32 along z in working units (0 = none), `opacity` (H, W)
    float32."""

    rgb: Array
    depth: Array
    opacity: Array


class View(Protocol):
    """What gives colours, distances and opacities for rays, on their device or on one that it has as `device`."""

    def __call__(self, origins: torch.Tensor, directions: torch.Tensor) -> RayValues: ...


def make_renderer(field: Field, engine: str = "auto", threads: int | None = None) -> View:
    """What renders rays of `field`, for many renders: compiled on the CPU and, where a ray is decoded once, on CUDA; torch elsewhere.

    Args:
        engine: auto | numba | triton | torch. Numba runs on the CPU alone, Triton on CUDA alone.
        threads: of Numba; None: as many as torch has.
    """
    if field.outer is not None:
        raise ValueError("a cell's field is rendered by the engine that fits it; merge the cells first")
    chosen = choose_engine(engine, "deferred" if isinstance(field.decoder, Deferred) else "per_sample", field.device)
    if chosen == "triton":
        from fieldfuse.render.triton_renderer import TritonRenderer

        return TritonRenderer(field)
    if chosen == "torch":
        return partial(_in_chunks, field)
    from fieldfuse.render.numba_renderer import NumbaRenderer

    compiled = NumbaRenderer(field, threads)

    def render(origins: torch.Tensor, directions: torch.Tensor) -> RayValues:
        values = compiled.render(origins, directions)
        return RayValues(values[:, :3], values[:, 3], values[:, 4])

    return render


def _in_chunks(field: Field, origins: torch.Tensor, directions: torch.Tensor) -> RayValues:
    """Torch keeps every sample of a batch in memory, so a render is made piece by piece."""
    parts = [
        render_rays(field, o.to(field.device), d.to(field.device))
        for o, d in zip(origins.split(CHUNK), directions.split(CHUNK), strict=True)
    ]
    return RayValues(*(torch.cat([getattr(part, name).cpu() for part in parts]) for name in ("colour", "distance", "opacity")))


def render_view(field: Field, intrinsics: Intrinsics, world_from_camera: Array, view: View | None = None) -> Rendered:
    """The field as a pinhole camera at `world_from_camera` (4, 4), working frame, sees it. `view`: see `make_renderer`."""
    view = view or make_renderer(field)
    device = getattr(view, "device", torch.device("cpu"))
    origins, directions, cosine = _rays_on(device, intrinsics, world_from_camera)
    values = view(origins, directions)
    depth = torch.where(values.opacity >= SOLID, values.distance * cosine, torch.zeros(1, device=device))
    sky = None if field.sky is None else field.sky.to(device)
    colour = on_sky(values.colour, values.opacity, directions, field.background.to(device), sky)
    shape = (intrinsics.height, intrinsics.width)
    return Rendered(
        colour.reshape(*shape, 3).cpu().numpy().astype(np.float32),
        depth.view(shape).cpu().numpy().astype(np.float32),
        values.opacity.reshape(shape).cpu().numpy().astype(np.float32),
    )


def _rays_on(device: torch.device, intrinsics: Intrinsics, world_from_camera: Array) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Rays through all pixels, as `camera.rays` makes them, on `device`: it takes longer to send them than to make them there."""
    height, width = intrinsics.height, intrinsics.width
    if device.type == "cpu":
        return rays(intrinsics, world_from_camera, pixel_grid(width, height))
    pose = torch.from_numpy(np.ascontiguousarray(world_from_camera, dtype=np.float64)).to(device)
    x = (torch.arange(width, device=device, dtype=torch.float64) + 0.5 - intrinsics.cx) / intrinsics.fx
    y = (torch.arange(height, device=device, dtype=torch.float64) + 0.5 - intrinsics.cy) / intrinsics.fy
    camera = torch.stack([x.expand(height, width), y[:, None].expand(height, width), torch.ones_like(x).expand(height, width)], 2).view(
        -1, 3
    )
    cosine = 1 / camera.norm(dim=1)
    directions = (camera * cosine[:, None]) @ pose[:3, :3].T
    return pose[:3, 3].expand_as(directions).float(), directions.float(), cosine.float()
