"""Rays through a field in torch, on any device: the reference of all renderers, with gradients by autograd.

`render_rays` is forward only. `render_with_gradients` is for training the networks: gradients flow through a field's rows to whatever made
them. The per-scene fit uses `shade`, and ends its gradients at what was looked up.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from fieldfuse.nerfusion.decoder import Deferred
from fieldfuse.render.composite import STOP, THRESHOLD, ray_sum, weights
from fieldfuse.render.field import Field, density
from fieldfuse.render.march import Samples, march
from fieldfuse.volume.lookup import corners, gather, scatter

OPACITY_FLOOR = 1e-6


@dataclass(frozen=True)
class RayValues:
    """Per ray: `colour` (B, 3), `distance` (B,) along the unit direction where half of the light is stopped (0 if none is), `opacity`
    (B,)."""

    colour: Tensor
    distance: Tensor
    opacity: Tensor


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


@dataclass(frozen=True)
class Shaded:
    """B rays: `colour` (B, 3) without what is behind, `opacity` (B,); of their samples `weight` T · α, `transmittance` T in front and
    optical `thickness` (samples,), and `kept`, the indices of those that have a colour."""

    colour: Tensor
    opacity: Tensor
    weight: Tensor
    transmittance: Tensor
    thickness: Tensor
    kept: Tensor


LookUp = Callable[[Tensor, Tensor, Tensor], Tensor]


def shade(
    field: Field,
    samples: Samples,
    directions: Tensor,
    look_up: LookUp = gather,
    threshold: float = THRESHOLD,
    stop: float = STOP,
    near: Tensor | None = None,
) -> Shaded:
    """Decode and composite the samples of rays with `directions` (B, 3).

    Args:
        look_up: values, (N, 8) rows and their weights → (N,) or (N, C) weighted sums.
        threshold: of the deferred decoder: samples of smaller weight, or with less light than `stop` in front, have no colour.
        near: (samples,) factors of the samples' gradients; with them, samples without a colour get none. None: gradients as they are.
    """
    rows, corner_weights = corners(field.topology, samples.cell, samples.inside)
    raw, count = look_up(field.density_rows, rows, corner_weights), len(directions)
    length, directions = samples.length.to(raw.dtype), directions.to(raw.dtype)
    kept = torch.arange(len(samples), device=raw.device)
    if isinstance(field.decoder, Deferred):
        thickness = density(raw) * length
        weight, transmittance = weights(thickness, samples.first)
        kept = ((weight > threshold) & (transmittance >= stop)).nonzero().view(-1)
        features = look_up(field.feature_rows, rows[kept], corner_weights[kept])
        if near is not None:
            scale_gradients(thickness, torch.zeros_like(near).index_copy_(0, kept, near[kept]))
            scale_gradients(features, near[kept, None])
        w, ray = weight[kept], samples.ray[kept]
        opacity = ray_sum(w, ray, count)
        mean = ray_sum(w[:, None] * features, ray, count) / opacity.clamp_min(OPACITY_FLOOR)[:, None]
        return Shaded(field.decoder(mean, directions) * opacity[:, None], opacity, weight, transmittance, thickness, kept)
    more, own = field.decoder(look_up(field.feature_rows, rows, corner_weights), directions[samples.ray])
    thickness = density(raw + more) * length
    if near is not None:
        scale_gradients(thickness, near)
        scale_gradients(own, near[:, None])
    weight, transmittance = weights(thickness, samples.first)
    colour = ray_sum(weight[:, None] * own, samples.ray, count)
    return Shaded(colour, ray_sum(weight, samples.ray, count), weight, transmittance, thickness, kept)


def scale_gradients(values: Tensor, factor: Tensor) -> None:
    """Have the gradients of `values` multiplied by `factor`."""
    if values.requires_grad:
        values.register_hook(lambda gradient: gradient * factor)


@torch.no_grad()
def render_rays(field: Field, origins: Tensor, directions: Tensor, threshold: float = THRESHOLD) -> RayValues:
    """Render (B, 3) rays. The deferred decoder leaves out samples whose weight is at most `threshold`."""
    samples = march(field.grid, origins, directions, field.near, field.fine)
    shown = shade(field, samples, directions, threshold=threshold)
    colour = shown.colour + (1 - shown.opacity)[:, None] * field.background
    return RayValues(colour.clamp(0, 1), _median_distance(samples, shown, len(origins)), shown.opacity)


def _median_distance(samples: Samples, shown: Shaded, count: int) -> Tensor:
    """(B,) distance at which the transmittance falls through ½; 0 where it never does.

    Within a sample's interval its weight counts as spread evenly: where exactly a surface lies that stops nearly all light within one
    interval is not known from its one density, and the middle is off by as much to either side. T e^{-p τ} = ½ would put it at the front.
    """
    before = shown.transmittance
    after = before * torch.exp(-shown.thickness)
    crossing = ((before > 0.5) & (after <= 0.5)).nonzero().squeeze(1)
    part = (before[crossing] - 0.5) / (before[crossing] - after[crossing])
    out = torch.zeros(count, device=before.device)
    out[samples.ray[crossing]] = samples.distance[crossing] + (part - 0.5) * samples.span[crossing]
    return out


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
    samples = march(field.grid, origins.float(), directions.float(), field.near, field.fine, jitter)
    shown = shade(field, samples, directions, differentiable_gather, threshold if threshold > 0 else -1.0, stop=0.0)
    behind = field.background if behind is None else behind
    colour = shown.colour + (1 - shown.opacity)[:, None] * behind.to(shown.colour.dtype)
    weight, kept = shown.weight[shown.kept], samples.take(shown.kept)
    distance = ray_sum(weight * kept.distance.to(weight.dtype), kept.ray, len(origins)) / shown.opacity.clamp_min(OPACITY_FLOOR)
    return Rendering(colour, distance, shown.opacity, shown.weight, samples)


def differentiable_gather(values: Tensor, rows: Tensor, corner_weights: Tensor) -> Tensor:
    """(R,) or (R, C) → (N,) or (N, C) weighted sums over eight rows each (`fieldfuse.volume.lookup`), differentiable in `values`."""
    found: Tensor = _Gather.apply(values, rows, corner_weights.to(values.dtype))
    return found


class _Gather(torch.autograd.Function):
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
