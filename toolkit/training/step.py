"""One optimisation step on one batch of rays: render, loss, gradients by autograd down to what was looked up, lazy Adam on the rows."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from fieldfuse.nerfusion.decoder import Deferred
from fieldfuse.render.composite import SOLID, STOP, distortion, ray_sum, weights
from fieldfuse.render.field import Field, density
from fieldfuse.render.march import BRICK, Samples, march
from fieldfuse.render.rays import OPACITY_FLOOR
from fieldfuse.training.adam import LazyAdam
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
        self.decoder = torch.optim.Adam(field.decoder.parameters(), betas=(0.9, 0.99), eps=1e-10)
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

    def step(self, batch: Batch, rates: Rates, generator: torch.Generator) -> tuple[float, int]:
        """One step. Returns the mean squared colour error of the batch and the number of samples that were looked at.

        Raises:
            NotFiniteError: the loss or a gradient is not finite; nothing was moved.
        """
        field = self.field
        jitter = torch.rand(len(batch.origins), generator=generator).to(field.device)
        samples = march(field.grid, batch.origins, batch.directions, field.near, field.fine, jitter)
        try:
            error = (self._deferred if isinstance(field.decoder, Deferred) else self._per_sample)(batch, samples, rates)
        except NotFiniteError:
            self.decoder.zero_grad()
            self.seen.nan_to_num_(0.0)
            raise
        for group in self.decoder.param_groups:
            group["lr"] = rates.decoder
        self.decoder.step()
        if self.blind.any():
            of_direction(field.decoder)[:, self.blind] = 0.0
        self.decoder.zero_grad()
        return error, len(samples)

    def _deferred(self, batch: Batch, samples: Samples, rates: Rates) -> float:
        """Features are composited, then decoded once a ray."""
        field, count = self.field, len(batch.origins)
        assert isinstance(field.decoder, Deferred)
        rows, corner_weights = corners(field.topology, samples.cell, samples.inside)
        raw = gather(field.density_rows, rows, corner_weights)
        thickness = density(raw) * samples.length
        weight, transmittance = weights(thickness, samples.first)
        alive = transmittance >= STOP
        self._mark(samples, weight, alive, count)
        # Samples of small weight dim those behind them, and get no gradient.
        chosen = (weight > rates.colour_threshold) & alive
        kept, rows, corner_weights = samples.keep(chosen), rows[chosen], corner_weights[chosen]
        raw, slow = raw[chosen].requires_grad_(True), slowness(kept.distance, rates.slow_within)
        features = gather(field.feature_rows, rows, corner_weights).requires_grad_(True)
        thickness = thickness.masked_scatter(chosen, _slowed(density(raw) * kept.length, slow))
        weight = weights(thickness, samples.first)[0][chosen]
        opacity = ray_sum(weight, kept.ray, count)
        mean = ray_sum(weight[:, None] * _slowed(features, slow[:, None]), kept.ray, count) / opacity.clamp_min(OPACITY_FLOOR)[:, None]
        colour = opacity[:, None] * field.decoder(mean, batch.directions)
        return self._learn(batch, kept, rates, (colour, opacity, weight), (rows, corner_weights, raw, features))

    def _per_sample(self, batch: Batch, samples: Samples, rates: Rates) -> float:
        """The paper's decoder, at every sample."""
        field, count = self.field, len(batch.origins)
        rows, corner_weights = corners(field.topology, samples.cell, samples.inside)
        features = gather(field.feature_rows, rows, corner_weights).requires_grad_(True)
        base = gather(field.density_rows, rows, corner_weights).requires_grad_(True)
        raw, own = field.decoder(features, batch.directions[samples.ray])
        slow = slowness(samples.distance, rates.slow_within)
        weight, transmittance = weights(_slowed(density(raw + base) * samples.length, slow), samples.first)
        self._mark(samples, weight.detach(), transmittance.detach() >= STOP, count)
        colour = ray_sum(weight[:, None] * _slowed(own, slow[:, None]), samples.ray, count)
        opacity = ray_sum(weight, samples.ray, count)
        return self._learn(batch, samples, rates, (colour, opacity, weight), (rows, corner_weights, base, features))

    def _learn(
        self,
        batch: Batch,
        samples: Samples,
        rates: Rates,
        seen: tuple[Tensor, Tensor, Tensor],
        looked_up: tuple[Tensor, Tensor, Tensor, Tensor],
    ) -> float:
        """The loss, its gradients, and a step of the rows. Returns the mean squared colour error.

        Args:
            samples: (S,) that have gradients.
            seen: (B, 3) colours without what is behind, (B,) opacities, (S,) weights.
            looked_up: (S, 8) rows and their weights, and what they gave: (S,) raw densities and (S, C) features.

        Raises:
            NotFiniteError: the loss or a gradient is not finite; nothing is moved.
        """
        field, count = self.field, len(batch.origins)
        (colour, opacity, weight), (rows, corner_weights, raw, features) = seen, looked_up
        residual = colour + (1 - opacity)[:, None] * field.background - batch.colour
        each = residual.square().mean(1) + rates.opacity * (1 - opacity).square()
        if rates.distortion > 0:
            spread = torch.full_like(weight, BRICK / (field.fine * field.resolution))  # an interval, in the units of `place`
            each = each + rates.distortion * distortion(weight, samples.place, spread, samples.first, samples.ray, count)
        if rates.depth > 0 and batch.distance is not None:
            pull = depth_gradient(samples.distance, batch.distance[samples.ray], rates.depth_noise)
            each = each + rates.depth * ray_sum(weight * pull, samples.ray, count)
        shares = torch.full_like(each, 1 / count) if batch.weight is None else batch.weight / count
        (shares * each).sum().backward()
        self._move(rows, corner_weights, raw, features, rates, residual.detach())
        self.errors = residual.detach().square().mean(1)  # decides which pixels the next batch draws
        return float((self.errors * shares).sum())

    def _move(self, rows: Tensor, corner_weights: Tensor, raw: Tensor, features: Tensor, rates: Rates, residual: Tensor) -> None:
        """From gradients of what was looked up to a step of the rows that it was looked up from."""
        g_raw, g_feature = (torch.zeros_like(of) if of.grad is None else of.grad for of in (raw, features))
        touched, (density_gradient, feature_gradient) = scatter(rows, corner_weights, (g_raw, g_feature))
        if len(touched) and int(touched[-1]) == self.field.topology.zero_row:  # the zero row stays zero
            touched, density_gradient, feature_gradient = touched[:-1], density_gradient[:-1], feature_gradient[:-1]
        of_decoder = ((f"the gradient of the decoder's {name}", value.grad) for name, value in self.field.decoder.named_parameters())
        of_rows = [("the gradient of the densities", density_gradient), ("the gradient of the features", feature_gradient)]
        check([("the colour error", residual), *of_rows, *((name, value) for name, value in of_decoder if value is not None)])
        self.density.step(touched, density_gradient, rates.density)
        self.feature.step(touched, feature_gradient, rates.feature)

    def _mark(self, samples: Samples, weight: Tensor, alive: Tensor, count: int) -> None:
        """Remember how strongly and how often voxels were seen, before the light was spent."""
        weight = torch.where(alive, weight, 0.0)
        self.seen.scatter_reduce_(0, samples.cell, weight, "amax")
        self.visits.index_add_(0, samples.cell, alive.float())
        # Of a ray that ends somewhere the strongest sample counts as seen fully: on a fine lattice a surface is several voxels thick.
        peak = torch.zeros(count, device=weight.device).scatter_reduce_(0, samples.ray, weight, "amax")
        solid = 1 - ray_sum(weight, samples.ray, count) < SOLID
        self.seen[samples.cell[(weight == peak[samples.ray]) & solid[samples.ray]]] = 1.0


def _slowed(values: Tensor, factor: Tensor) -> Tensor:
    """The same values; their gradients are multiplied by `factor`."""
    if values.requires_grad:
        values.register_hook(lambda gradient: gradient * factor)
    return values
