"""Colour, distance and opacity along a batch of rays through a field (forward only; training has its own step with gradients)."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from fieldfuse.nerfusion.decoder import Deferred
from fieldfuse.render.composite import STOP, ray_sum, weights
from fieldfuse.render.field import Field, density
from fieldfuse.render.march import Samples, march
from fieldfuse.volume.lookup import corners, gather

Tensor = torch.Tensor
OPACITY_FLOOR = 1e-6


@dataclass(frozen=True)
class RayValues:
    """Per ray: `colour` (B, 3), `distance` (B,) along the unit direction where half of the light is stopped (0 if none is), `opacity`
    (B,)."""

    colour: Tensor
    distance: Tensor
    opacity: Tensor


@torch.no_grad()
def render_rays(field: Field, origins: Tensor, directions: Tensor, threshold: float = 1e-3) -> RayValues:
    """Render (B, 3) rays. The deferred decoder leaves out samples whose weight is at most `threshold`."""
    count = len(origins)
    samples = march(field.grid, origins, directions, field.near, field.fine)
    if isinstance(field.decoder, Deferred):
        rows, corner_weights = corners(field.topology, samples.cell, samples.inside)
        thickness = density(gather(field.density_rows, rows, corner_weights)) * samples.length
        weight, transmittance = weights(thickness, samples.first)
        seen = (weight > threshold) & (transmittance >= STOP)
        kept = samples.keep(seen)
        w = weight[seen]
        features = gather(field.feature_rows, rows[seen], corner_weights[seen])
        summed = ray_sum(torch.cat([w[:, None] * features, w[:, None]], 1), kept.ray, count)
        opacity = summed[:, -1]
        colour = field.decoder(summed[:, :-1] / opacity.clamp_min(OPACITY_FLOOR)[:, None], directions)
        colour = colour * opacity[:, None]
    else:
        rows, corner_weights = corners(field.topology, samples.cell, samples.inside)
        raw, sample_colour = field.decoder(gather(field.feature_rows, rows, corner_weights), directions[samples.ray])
        thickness = density(raw + gather(field.density_rows, rows, corner_weights)) * samples.length
        weight, transmittance = weights(thickness, samples.first)
        opacity = ray_sum(weight, samples.ray, count)
        colour = ray_sum(weight[:, None] * sample_colour, samples.ray, count)
    colour = colour + (1 - opacity)[:, None] * field.background
    distance = median_distance(samples, transmittance, thickness, count)
    return RayValues(colour.clamp(0, 1), distance, opacity)


def median_distance(samples: Samples, transmittance: Tensor, thickness: Tensor, count: int) -> Tensor:
    """(B,) distance at which the transmittance falls through ½; 0 where it never does.

    Within a sample's interval its weight counts as spread evenly: where exactly a surface lies that stops nearly all light within one
    interval is not known from its one density, and the middle is off by as much to either side. T e^{-p τ} = ½ would put it at the front.
    """
    after = transmittance * torch.exp(-thickness)
    crossing = ((transmittance > 0.5) & (after <= 0.5)).nonzero().squeeze(1)
    part = (transmittance[crossing] - 0.5) / (transmittance[crossing] - after[crossing])
    out = torch.zeros(count, device=transmittance.device)
    out[samples.ray[crossing]] = samples.distance[crossing] + (part - 0.5) * samples.span[crossing]
    return out
