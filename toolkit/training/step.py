"""One optimisation step on one batch of rays: render, loss, gradients by hand, lazy Adam."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from fieldfuse.nerfusion.decoder import Deferred
from fieldfuse.render.composite import RAW_MAX, SOLID, STOP, distortion, ray_sum, thickness_gradient, weights
from fieldfuse.render.field import Field, density
from fieldfuse.render.march import BRICK, Samples, march
from fieldfuse.render.rays import OPACITY_FLOOR
from fieldfuse.training.adam import Adam, LazyAdam
from fieldfuse.training.depth import FINE, depth_gradient
from fieldfuse.training.finite import NotFiniteError, check
from fieldfuse.training.near import slowness
from fieldfuse.training.rays import Batch
from fieldfuse.training.view import blind, of_direction
from fieldfuse.volume.lookup import corners, gather, scatter

Tensor = torch.Tensor


@dataclass(frozen=True)
class Rates:
    """Step sizes and loss weights of one step."""

    density: float
    feature: float
    decoder: float
    distortion: float
    opacity: float = 0.0  # weight of the mean of (1 - opacity)², for captures in which every ray ends somewhere
    colour_threshold: float = 3e-3  # samples of smaller weight are neither decoded nor given a gradient
    depth: float = 0.0  # weight of the mean of the depth term (see `depth`), for rays whose surface is known
    depth_noise: float = FINE.noise  # share of its distance by which such a surface may be off
    slow_within: float = 0.0  # working units; samples nearer than this move slowly (see `near`), 0: none


class Optimiser:
    """A field with the optimiser state of its rows, and the largest weight that each voxel was seen with."""

    def __init__(self, field: Field) -> None:
        self.blind = blind(field.decoder)
        self.decoder = Adam(field.decoder.parameters(), (0.9, 0.99), 1e-10)
        self.renew_rows(field)

    def renew_rows(self, field: Field) -> None:
        """Go on with another field of the same decoder: the rows' state starts afresh, the decoder's is kept."""
        self.field = field
        self.density = LazyAdam(field.density_rows)
        self.feature = LazyAdam(field.feature_rows)
        self.seen = torch.zeros(len(field.occupied), device=field.device)
        self.visits = torch.zeros(len(field.occupied), device=field.device)

    def go_on_with(self, field: Field) -> None:
        """Go on with the same rows after pruning; what was seen counts half from now on, so that it is forgotten within a few prunings."""
        self.field = field
        self.seen.mul_(0.5)
        self.visits.mul_(0.5)

    def _mark(self, samples: Samples, weight: Tensor, alive: Tensor, count: int) -> None:
        """Remember how strongly and how often voxels were seen, before the light was spent."""
        self.seen.scatter_reduce_(0, samples.cell, torch.where(alive, weight, 0.0), "amax")
        self.visits.index_add_(0, samples.cell, alive.float())
        # Of a ray that ends somewhere the strongest sample counts as seen fully: on a fine lattice a surface is several voxels thick.
        weight = torch.where(alive, weight, 0.0)
        peak = torch.zeros(count, device=weight.device).scatter_reduce_(0, samples.ray, weight, "amax")
        solid = 1 - ray_sum(weight, samples.ray, count) < SOLID
        self.seen[samples.cell[(weight == peak[samples.ray]) & solid[samples.ray]]] = 1.0

    def _spread(self, weight: Tensor) -> Tensor:
        """Interval of every sample in the units of `Samples.place`."""
        return torch.full_like(weight, BRICK / (self.field.fine * self.field.resolution))

    def _shares(self, batch: Batch) -> Tensor:
        """(B,) what each ray counts in a mean over the batch."""
        count = len(batch.origins)
        return torch.full_like(batch.colour[:, 0], 1 / count) if batch.weight is None else batch.weight / count

    def _mean_error(self, residual: Tensor, shares: Tensor) -> float:
        """The mean squared colour error; each ray's own is kept for whoever draws the next batch."""
        self.errors = residual.square().mean(1)
        return float((self.errors * shares).sum())

    def _depth(self, batch: Batch, samples: Samples, rates: Rates) -> Tensor | float:
        """The depth term's gradient for the samples' weights."""
        if rates.depth <= 0 or batch.distance is None:
            return 0.0
        gradient = depth_gradient(samples.distance, batch.distance[samples.ray], rates.depth_noise)
        return gradient * (rates.depth * self._shares(batch)[samples.ray])

    def _move(self, rows: Tensor, corner_weights: Tensor, g_density: Tensor, g_feature: Tensor, rates: Rates, residual: Tensor) -> None:
        """From gradients of what was looked up to a step of the rows that it was looked up from.

        Raises:
            NotFiniteError: the loss or a gradient is not finite; nothing is moved.
        """
        touched, (density_gradient, feature_gradient) = scatter(rows, corner_weights, (g_density, g_feature))
        if len(touched) and int(touched[-1]) == self.field.topology.zero_row:  # the zero row stays zero
            touched, density_gradient, feature_gradient = touched[:-1], density_gradient[:-1], feature_gradient[:-1]
        weights = ((f"the gradient of the decoder's {name}", value.grad) for name, value in self.field.decoder.named_parameters())
        of_rows = [("the gradient of the densities", density_gradient), ("the gradient of the features", feature_gradient)]
        check([("the colour error", residual), *of_rows, *((name, value) for name, value in weights if value is not None)])
        self.density.step(touched, density_gradient, rates.density)
        self.feature.step(touched, feature_gradient, rates.feature)

    def step(self, batch: Batch, rates: Rates, generator: torch.Generator) -> tuple[float, int]:
        """One step. Returns the mean squared colour error of the batch and the number of samples that were looked at.

        Raises:
            NotFiniteError: the loss or a gradient is not finite; nothing was moved.
        """
        field = self.field
        jitter = torch.rand(len(batch.origins), generator=generator).to(field.device)
        samples = march(field.grid, batch.origins, batch.directions, field.near, field.fine, jitter)
        deferred = isinstance(field.decoder, Deferred)
        try:
            error = (self._deferred if deferred else self._per_sample)(batch, samples, rates)
        except NotFiniteError:
            self.decoder.forget()
            self.seen.nan_to_num_(0.0)
            raise
        self.decoder.step(rates.decoder)
        if self.blind.any():
            of_direction(field.decoder)[:, self.blind] = 0.0
        self.decoder.forget()
        return error, len(samples)

    def _deferred(self, batch: Batch, samples: Samples, rates: Rates) -> float:
        """Features are composited, then decoded once a ray; only the decoder goes through autograd."""
        field, count = self.field, len(batch.origins)
        assert isinstance(field.decoder, Deferred)
        rows, corner_weights = corners(field.topology, samples.cell, samples.inside)
        raw = gather(field.density_rows, rows, corner_weights)
        thickness = density(raw) * samples.length
        weight, transmittance = weights(thickness, samples.first)
        alive = transmittance >= STOP
        self._mark(samples, weight, alive, count)
        chosen = (weight > rates.colour_threshold) & alive
        kept = samples.keep(chosen)
        rows, corner_weights, raw, thickness = rows[chosen], corner_weights[chosen], raw[chosen], thickness[chosen]
        weight, transmittance = weight[chosen], transmittance[chosen]
        features = gather(field.feature_rows, rows, corner_weights)
        opacity = ray_sum(weight, kept.ray, count)
        mean = ray_sum(weight[:, None] * features, kept.ray, count) / opacity.clamp_min(OPACITY_FLOOR)[:, None]

        mean.requires_grad_(True)
        colour = field.decoder(mean, batch.directions)
        mixed = opacity[:, None] * colour + (1 - opacity)[:, None] * field.background
        residual = (mixed - batch.colour).detach()
        # L = mean over rays and channels of the squared error; ∂L/∂mixed in closed form, the rest from the decoder's graph.
        shares = self._shares(batch)
        g_mixed = residual * (2 / 3 * shares)[:, None]
        colour.backward(g_mixed * opacity[:, None])
        g_mean = mean.grad
        assert g_mean is not None
        colour = colour.detach()
        g_opacity = (g_mixed * (colour - field.background)).sum(1) - (1 - opacity) * (2 * rates.opacity * shares)
        # mean = Σ w f / A and A = Σ w: ∂mean/∂w_i = (f_i - mean) / A
        g_sum = g_mean / opacity.clamp_min(OPACITY_FLOOR)[:, None]
        per_ray = torch.cat([g_sum, (g_opacity - (g_sum * mean.detach()).sum(1))[:, None]], 1)[kept.ray]
        g_weight = (features * per_ray[:, :-1]).sum(1) + per_ray[:, -1]
        if rates.distortion > 0:
            _, g_distortion = distortion(weight, kept.place, self._spread(weight), kept.first, kept.ray, count)
            g_weight = g_weight + g_distortion * (rates.distortion * shares[kept.ray])
        g_weight = g_weight + self._depth(batch, kept, rates)
        g_thickness = thickness_gradient(weight, transmittance, thickness, g_weight, kept.first, kept.ray, count)
        slow = slowness(kept.distance, rates.slow_within)
        g_raw = torch.where(raw < RAW_MAX, g_thickness * thickness * slow, torch.zeros_like(raw))  # ∂τ/∂raw = τ
        self._move(rows, corner_weights, g_raw, per_ray[:, :-1] * (weight * slow)[:, None], rates, residual)
        return self._mean_error(residual, shares)

    def _per_sample(self, batch: Batch, samples: Samples, rates: Rates) -> float:
        """The paper's decoder at every sample: autograd from looked-up features to loss, then our scatter and lazy Adam."""
        field, count = self.field, len(batch.origins)
        rows, corner_weights = corners(field.topology, samples.cell, samples.inside)
        features = gather(field.feature_rows, rows, corner_weights).requires_grad_(True)
        base = gather(field.density_rows, rows, corner_weights).requires_grad_(True)
        raw, colour = field.decoder(features, batch.directions[samples.ray])
        thickness = density(raw + base) * samples.length
        # Weights and their gradient as in the deferred step; colours and raw densities hang on the decoder's graph.
        tau = thickness.detach()
        weight, transmittance = weights(tau, samples.first)
        self._mark(samples, weight, transmittance >= STOP, count)
        opacity = ray_sum(weight, samples.ray, count)
        mixed = ray_sum(weight[:, None] * colour.detach(), samples.ray, count) + (1 - opacity)[:, None] * field.background
        residual = mixed - batch.colour
        shares = self._shares(batch)
        g_rays = residual * (2 / 3 * shares)[:, None]
        g_opacity = -(g_rays * field.background).sum(1) - (1 - opacity) * (2 * rates.opacity * shares)
        g_mixed = g_rays[samples.ray]
        g_weight = (g_mixed * colour.detach()).sum(1) + g_opacity[samples.ray]
        if rates.distortion > 0:
            _, g_distortion = distortion(weight, samples.place, self._spread(weight), samples.first, samples.ray, count)
            g_weight = g_weight + g_distortion * (rates.distortion * shares[samples.ray])
        g_weight = g_weight + self._depth(batch, samples, rates)
        g_thickness = thickness_gradient(weight, transmittance, tau, g_weight, samples.first, samples.ray, count)
        slow = slowness(samples.distance, rates.slow_within)
        torch.autograd.backward([thickness, colour], [g_thickness * slow, (weight * slow)[:, None] * g_mixed])
        assert features.grad is not None and base.grad is not None
        self._move(rows, corner_weights, base.grad, features.grad, rates, residual)
        return self._mean_error(residual, shares)
