"""The differentiable renderer's answer in the terms of the losses."""

from __future__ import annotations

import torch

from fieldfuse.backends.dispatch import to_device_async
from fieldfuse.nerfusion.losses import Traced
from fieldfuse.nerfusion.training.rays import TargetRays
from fieldfuse.render.field import Field
from fieldfuse.render.rays import render_with_gradients

Tensor = torch.Tensor
THRESHOLD = 1e-3  # samples of smaller weight are not decoded; they keep their gradient as obstacles


def trace(field: Field, rays: TargetRays, behind: Tensor, generator: torch.Generator | None) -> Traced:
    """Render rays over `behind` (3,) or (R, 3); samples are moved along the rays by chance where there is a generator."""
    jitter = None if generator is None else to_device_async(torch.rand(len(rays), generator=generator).numpy(), rays.origins.device)
    seen = render_with_gradients(field, rays.origins, rays.directions, jitter, behind, THRESHOLD)
    return Traced(seen.colour, seen.opacity, seen.weight, seen.samples.distance, seen.samples.ray)
