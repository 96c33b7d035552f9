"""Three engines, one field: what a fit asks of each, and which one it gets.

`torch` is the reference and runs everywhere; `numba` is the fast path of the CPU, `triton` that of CUDA. They agree in values and gradients
(tests compare them), not in the random numbers that they draw.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

import torch

from fieldfuse.backends.dispatch import choose_engine
from fieldfuse.config import Settings
from fieldfuse.nerfusion.decoder import Deferred
from fieldfuse.progress import Progress
from fieldfuse.render.field import Field
from fieldfuse.render.rays import render_rays
from fieldfuse.training.adam import LazyAdam
from fieldfuse.training.importance import Errors
from fieldfuse.training.rays import PixelPool
from fieldfuse.training.step import Optimiser, Rates

Tensor = torch.Tensor


class Engine(Protocol):
    """A field under optimisation."""

    @property
    def field(self) -> Field:
        """The field; its decoder is up to date after `sync` only."""
        ...

    @property
    def seen(self) -> Tensor:
        """(M · 512,) largest weight that each voxel was seen with since the last pruning."""
        ...

    @property
    def visits(self) -> Tensor:
        """(M · 512,) samples that fell into each voxel since then."""
        ...

    def step(self, rays: int, rates: Rates) -> tuple[float, int]:
        """One step on `rays` random pixels → mean squared colour error, samples looked up."""
        ...

    def renew_rows(self, field: Field) -> None:
        """Go on with another field of the same decoder; the rows' state starts afresh."""
        ...

    def let_go(self) -> None:
        """Free what belongs to the rows, before finer ones are made beside them; `renew_rows` must follow."""
        ...

    def go_on_with(self, field: Field) -> None:
        """Go on with the same rows after pruning."""
        ...

    def colours(self, origins: Tensor, directions: Tensor) -> Tensor:
        """(B, 3) colours that the field has now."""
        ...

    def sync(self) -> Field:
        """The field with everything that was learnt written into it."""
        ...


class TorchEngine(Optimiser):
    """The reference, on any device."""

    def __init__(self, field: Field, pool: PixelPool, seed: int) -> None:
        self.pool, self.generator, self.drawn_by = pool, torch.Generator().manual_seed(seed), Errors(pool)
        super().__init__(field)

    def step(self, rays: int, rates: Rates) -> tuple[float, int]:  # type: ignore[override]
        picks, weight = self.drawn_by.draw(rays, self.generator)
        out = super().step(replace(self.pool.take(picks), weight=weight), rates, self.generator)
        self.drawn_by.remember(picks, self.errors)
        return out

    def colours(self, origins: Tensor, directions: Tensor) -> Tensor:
        return render_rays(self.field, origins, directions).colour

    def let_go(self) -> None:
        nothing = torch.zeros(0)
        self.density, self.feature = LazyAdam(nothing), LazyAdam(nothing)
        self.seen = self.visits = nothing

    def sync(self) -> Field:
        return self.field


def chosen_engine(settings: Settings, device: torch.device) -> str:
    """numba, triton or torch: the backend of a fit with these settings on `device`."""
    return choose_engine(settings.engine, settings.field.decoder, device)


def make_engine(settings: Settings, field: Field, pool: PixelPool) -> Engine:
    """The engine that the settings ask for, or for `auto` the fastest that there is."""
    chosen = chosen_engine(settings, field.device)
    if chosen == "torch":
        return TorchEngine(field, pool, settings.seed)
    if chosen == "triton":
        from fieldfuse.training.triton_engine import TritonOptimiser

        return TritonOptimiser(field, pool, settings.seed)
    if isinstance(field.decoder, Deferred):
        from fieldfuse.training.fused import FusedOptimiser

        return FusedOptimiser(field, pool, settings.seed)
    from fieldfuse.training.fused_per_sample import FusedPerSampleOptimiser

    return FusedPerSampleOptimiser(field, pool, settings.seed)


def fit_device(settings: Settings) -> torch.device:
    """Where a fit with these settings computes."""
    return torch.device(settings.device if settings.device != "auto" else "cuda" if torch.cuda.is_available() else "cpu")


def warm_up(settings: Settings, progress: Progress) -> None:
    """Have the kernels compiled (once a machine: they are kept on disk) or loaded, before any clock runs."""
    chosen = chosen_engine(settings, device := fit_device(settings))
    if chosen == "torch":
        return
    if chosen == "triton":
        from fieldfuse.training import triton_warm

        triton_warm.run(settings.field.channels, settings.field.width, device, progress)
        return
    from fieldfuse.training import warm

    kind = (settings.field.decoder, settings.field.channels, settings.field.width)
    if not warm.ready(*kind):
        progress.update(0, 1, "compiling the fast engine, once on this machine, about half a minute")
        warm.run(*kind)
