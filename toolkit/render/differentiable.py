"""Rendering with gradients by autograd, for training the networks: through a field's rows to whatever made them.

The same march, the same compositing and the same decoders as everywhere else. Slower than the step of a per-scene fit, whose gradients
end at what was looked up, but everything in front of the rows can be learned.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from fieldfuse.nerfusion.decoder import Deferred
from fieldfuse.render.composite import weights
from fieldfuse.render.field import Field, density
from fieldfuse.render.march import Samples, march
from fieldfuse.render.rays import OPACITY_FLOOR
from fieldfuse.volume.lookup import corners, gather, scatter


@dataclass(frozen=True)
class Rendering:
    """B rays, differentiable.

    Attributes:
        colour: (B, 3), what is behind the field included; not clamped.
        distance: (B,) mean distance along the unit direction, weighted by `weight`; 0 where nothing is met.
        opacity: (B,) in [0, 1].
        weight: (samples,) T · α of each sample.
        samples: where they are (`samples.ray`, `samples.distance`, …).
    """

    colour: Tensor
    distance: Tensor
    opacity: Tensor
    weight: Tensor
    samples: Samples


def render_with_gradients(
    field: Field, origins: Tensor, directions: Tensor, jitter: Tensor | None = None, behind: Tensor | None = None, threshold: float = 0.0
) -> Rendering:
    """Render (B, 3) rays; differentiable in the field's rows, its decoder and `behind` (not in the rays).

    Args:
        jitter: (B,) in [0, 1): moves the samples of a ray along it.
        behind: (3,) or (B, 3) colour behind everything; None: the field's own.
        threshold: of the deferred decoder, samples of smaller weight have no colour. 0 is exact; 1e-3 is faster where most of a field is
            thin, and leaves these samples only the gradient that they have as obstacles in front of others.
    """
    count = len(origins)
    samples = march(field.grid, origins.float(), directions.float(), field.near, field.fine, jitter)
    rows, corner_weights = corners(field.topology, samples.cell, samples.inside)
    raw = look_up(field.density_rows, rows, corner_weights)
    kind = raw.dtype
    length = samples.length.to(kind)
    behind = field.background if behind is None else behind
    if isinstance(field.decoder, Deferred):
        weight, _ = weights(density(raw) * length, samples.first)
        kept = (weight > threshold).nonzero().view(-1) if threshold > 0 else torch.arange(len(samples), device=raw.device)
        features = look_up(field.feature_rows, rows[kept], corner_weights[kept])
        w, ray = weight[kept], samples.ray[kept]
        opacity = _ray_sum(w[:, None], ray, count).squeeze(1)
        mean = _ray_sum(w[:, None] * features, ray, count) / opacity.clamp_min(OPACITY_FLOOR)[:, None]
        colour = field.decoder(mean, directions.to(kind)) * opacity[:, None]
    else:
        features = look_up(field.feature_rows, rows, corner_weights)
        more, sample_colour = field.decoder(features, directions.to(kind)[samples.ray])
        weight, _ = weights(density(raw + more) * length, samples.first)
        w, ray, kept = weight, samples.ray, torch.arange(len(samples), device=raw.device)
        opacity = _ray_sum(w[:, None], ray, count).squeeze(1)
        colour = _ray_sum(w[:, None] * sample_colour, ray, count)
    colour = colour + (1 - opacity)[:, None] * behind.to(kind)
    distance = _ray_sum((w * samples.distance.to(kind)[kept])[:, None], ray, count).squeeze(1) / opacity.clamp_min(OPACITY_FLOOR)
    return Rendering(colour, distance, opacity, weight, samples)


def _ray_sum(values: Tensor, ray: Tensor, rays: int) -> Tensor:
    """(samples, C) → (rays, C), a new tensor."""
    return torch.zeros((rays, values.shape[1]), dtype=values.dtype, device=values.device).index_add(0, ray, values)


def look_up(values: Tensor, rows: Tensor, corner_weights: Tensor) -> Tensor:
    """(R,) or (R, C) → (N,) or (N, C) weighted sums over eight rows each (`fieldfuse.volume.lookup`), differentiable in `values`."""
    found: Tensor = _LookUp.apply(values, rows, corner_weights.to(values.dtype))
    return found


class _LookUp(torch.autograd.Function):
    """`gather`, with the sorted `scatter` as its gradient: an order of magnitude cheaper than that of `embedding_bag`."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, rows: Tensor, corner_weights: Tensor) -> Tensor:
        ctx.save_for_backward(rows, corner_weights)
        ctx.shape = values.shape
        return gather(values, rows, corner_weights)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, None, None]:
        rows, corner_weights = ctx.saved_tensors
        total = gradient.new_zeros(ctx.shape)
        if len(rows):
            touched, (share,) = scatter(rows, corner_weights, (gradient.contiguous(),))
            total[touched] = share
        return total, None, None
