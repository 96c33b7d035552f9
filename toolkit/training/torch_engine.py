"""The reference engine, on any device: render, loss, gradients by autograd down to what was looked up, lazy Adam on the rows."""

from __future__ import annotations

from dataclasses import replace

import torch

from fieldfuse.backends.constants import BRICK, SOLID, STOP
from fieldfuse.render.composite import distortion, ray_sum
from fieldfuse.render.field import Field
from fieldfuse.render.march import Samples, march
from fieldfuse.render.rays import Shaded, render_rays, shade
from fieldfuse.training.losses import Rates, depth_gradient, near_gradient_scaling
from fieldfuse.training.nonfinite_policy import NotFiniteError, require_finite
from fieldfuse.training.pixels import Batch, PixelPool, TileErrors
from fieldfuse.training.start import direction_weights, unseen_harmonics
from fieldfuse.volume.lookup import gather, scatter

Tensor = torch.Tensor


class LazyAdam:
    """Adam for one (R,) or (R, C) array of rows of which a step touches few. Rows without a gradient keep their moments and are not read.
    (`torch.optim.SparseAdam` costs more than everything else in a step.)

    There is no first moment: of 0 to 0.9 none fits better than another (`docs/measured/performance.md`), and memory is what an update
    costs. The bias correction counts a row's own steps, so a row touched for the first time late takes a first step of full size. A row's
    moments and its count lie side by side.
    """

    def __init__(self, values: Tensor, decay: float = 0.99, epsilon: float = 1e-10) -> None:
        self.values = values
        self.channels = 1 if values.ndim == 1 else values.shape[1]
        self.state = torch.zeros(len(values), self.channels + 1, device=values.device)  # second moment, steps
        self.decay, self.epsilon = decay, epsilon

    def step(self, rows: Tensor, gradient: Tensor, rate: float) -> None:
        """Move `rows` (N,), each listed once, against their `gradient` (N,) or (N, C)."""
        state = self.state.index_select(0, rows)
        gradient = gradient.reshape(-1, self.channels)
        second, count = state[:, :-1], state[:, -1:]
        second.mul_(self.decay).addcmul_(gradient, gradient, value=1 - self.decay)
        count += 1
        self.state.index_copy_(0, rows, state)
        # rate · g / (sqrt(v / (1 - b2^n)) + ε)
        update = (gradient / second.sqrt().add_(self.epsilon)).mul_(torch.sqrt(1 - self.decay**count) * rate)
        old = self.values.index_select(0, rows)
        self.values.index_copy_(0, rows, old - update.view_as(old))


class TorchEngine:
    """A field under optimisation; see `engine.Engine`."""

    def __init__(self, field: Field, pool: PixelPool, seed: int = 0) -> None:
        self.pool, self.generator, self.tile_errors = pool, torch.Generator().manual_seed(seed), TileErrors(pool)
        self.unseen = unseen_harmonics(field.decoder)
        self.decoder = torch.optim.Adam(field.decoder.parameters(), betas=(0.9, 0.99), eps=1e-10)
        self.renew_rows(field)

    def renew_rows(self, field: Field) -> None:
        self.field = field
        self.density, self.feature = LazyAdam(field.density_rows), LazyAdam(field.feature_rows)
        self.seen, self.visits = (torch.zeros(len(field.occupied), device=field.device) for _ in range(2))

    def release(self) -> None:
        nothing = torch.zeros(0)
        self.density, self.feature = LazyAdam(nothing), LazyAdam(nothing)
        self.seen = self.visits = nothing

    def go_on_with(self, field: Field) -> None:
        self.field = field
        self.seen.mul_(0.5)
        self.visits.mul_(0.5)

    def colours(self, origins: Tensor, directions: Tensor) -> Tensor:
        return render_rays(self.field, origins, directions).colour

    def sync(self) -> Field:
        return self.field

    def step(self, rays: int, rates: Rates) -> tuple[float, int]:
        picks, weight = self.tile_errors.draw(rays, self.generator)
        jitter = torch.rand(rays, generator=self.generator).to(self.field.device)
        out = self.step_on(replace(self.pool.take(picks), weight=weight), rates, jitter)
        self.tile_errors.remember(picks, self.errors)
        return out

    def step_on(self, batch: Batch, rates: Rates, jitter: Tensor) -> tuple[float, int]:
        """One step on rays that are given, their lattices moved by `jitter` (B,) → as `step`.

        Raises:
            NotFiniteError: the loss or a gradient is not finite; nothing was moved.
        """
        field = self.field
        samples = march(field.grid, batch.origins, batch.directions, field.near, field.fine, jitter)
        try:
            error = self._learn(batch, samples, rates)
        except NotFiniteError:
            self.decoder.zero_grad()
            self.seen.nan_to_num_(0.0)
            raise
        for group in self.decoder.param_groups:
            group["lr"] = rates.decoder
        self.decoder.step()
        if self.unseen.any():
            direction_weights(field.decoder)[:, self.unseen] = 0.0
        self.decoder.zero_grad()
        return error, len(samples)

    def _learn(self, batch: Batch, samples: Samples, rates: Rates) -> float:
        """The loss, its gradients, and a step of the rows. Returns the mean squared colour error."""
        field, count = self.field, len(batch.origins)
        looked_up: list[tuple[Tensor, Tensor, Tensor]] = []

        def look_up(values: Tensor, rows: Tensor, corner_weights: Tensor) -> Tensor:
            """Where gradients end."""
            looked_up.append((rows, corner_weights, gather(values, rows, corner_weights).requires_grad_(True)))
            return looked_up[-1][2]

        near = near_gradient_scaling(samples.distance, rates.slow_within)
        shown = shade(field, samples, batch.directions, look_up, rates.colour_threshold, near=near)
        self._mark(samples, shown, count)
        kept, weight = samples.take(shown.kept), shown.weight[shown.kept]
        residual = shown.colour + (1 - shown.opacity)[:, None] * field.background - batch.colour
        each = residual.square().mean(1) + rates.opacity * (1 - shown.opacity).square()
        if rates.distortion > 0:
            spread = torch.full_like(weight, BRICK / (field.fine * field.resolution))  # an interval, in the units of `place`
            each = each + rates.distortion * distortion(weight, kept.place, spread, kept.first, kept.ray, count)
        if rates.depth > 0 and batch.distance is not None:
            pull = depth_gradient(kept.distance, batch.distance[kept.ray], rates.depth_noise)
            each = each + rates.depth * ray_sum(weight * pull, kept.ray, count)
        shares = torch.full_like(each, 1 / count) if batch.weight is None else batch.weight / count
        (shares * each).sum().backward()
        (_, _, raw), (rows, corner_weights, features) = looked_up
        gradients = [torch.zeros_like(of) if of.grad is None else of.grad for of in (raw, features)]
        self._move(*scatter(rows, corner_weights, (gradients[0][shown.kept], gradients[1])), rates, residual.detach())
        self.errors = residual.detach().square().mean(1)  # decides which pixels the next batch draws
        return float((self.errors * shares).sum())

    def _move(self, touched: Tensor, gradients: list[Tensor], rates: Rates, residual: Tensor) -> None:
        """Gradients of the rows `touched` → a step of them, when all is finite."""
        if len(touched) and int(touched[-1]) == self.field.topology.zero_row:  # the zero row stays zero
            touched, gradients = touched[:-1], [gradient[:-1] for gradient in gradients]
        of_rows = zip(("the gradient of the densities", "the gradient of the features"), gradients, strict=True)
        of_decoder = ((f"the gradient of the decoder's {name}", value.grad) for name, value in self.field.decoder.named_parameters())
        require_finite([("the colour error", residual), *of_rows, *((name, value) for name, value in of_decoder if value is not None)])
        self.density.step(touched, gradients[0], rates.density)
        self.feature.step(touched, gradients[1], rates.feature)

    def _mark(self, samples: Samples, shown: Shaded, count: int) -> None:
        """Store how strongly and how often voxels were seen, before the light was spent."""
        alive = shown.transmittance.detach() >= STOP
        weight = torch.where(alive, shown.weight.detach(), 0.0)
        self.seen.scatter_reduce_(0, samples.cell, weight, "amax")
        self.visits.index_add_(0, samples.cell, alive.float())
        # Of a ray that ends somewhere the strongest sample counts as seen fully: on a fine lattice a surface is several voxels thick.
        peak = torch.zeros(count, device=weight.device).scatter_reduce_(0, samples.ray, weight, "amax")
        solid = 1 - ray_sum(weight, samples.ray, count) < SOLID
        self.seen[samples.cell[(weight == peak[samples.ray]) & solid[samples.ray]]] = 1.0
