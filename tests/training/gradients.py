"""Gradients of one step of the torch engine, in the precision of the rays: in float64 they are what both engines are held against."""

from __future__ import annotations

import copy
from dataclasses import replace

import pytest
import torch

from fieldfuse.nerfusion.decoder import PerSample
from fieldfuse.render.field import Field
from fieldfuse.render.march import march
from fieldfuse.training import step as step_module
from fieldfuse.training.rays import Batch, PixelPool
from fieldfuse.training.step import Optimiser, Rates
from fieldfuse.volume.lookup import corners, gather
from tests.render.test_differentiable import double


def some_weights(count: int) -> torch.Tensor:
    """(count,) what rays count, some of them twice as much as others."""
    return 0.7 + 0.7 * torch.rand(count, generator=torch.Generator().manual_seed(5))


def weighed(pool: PixelPool, picks: torch.Tensor) -> Batch:
    """The rays of `picks` with `some_weights`."""
    return replace(pool.take(picks), weight=some_weights(len(picks)))


def torch_gradients(field: Field, batch: Batch, rates: Rates) -> tuple[torch.Tensor, ...]:
    """Dense gradients for densities, features, and the decoder's weights in their order; the field stays as it is."""
    field = replace(field, decoder=copy.deepcopy(field.decoder))
    kind = field.density_rows.dtype
    density, feature = torch.zeros_like(field.density_rows), torch.zeros_like(field.feature_rows)
    held: list[torch.Tensor] = []
    optimiser = Optimiser(field)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(step_module.LazyAdam, "step", lambda _, rows, g, rate: (density if g.ndim == 1 else feature).index_add_(0, rows, g))
        patch.setattr(torch, "rand", lambda *size, generator=None: torch.zeros(*size, dtype=kind))  # no jitter
        patch.setattr(optimiser, "_mark", lambda *_: None)
        patch.setattr(optimiser.decoder, "step", lambda: held.extend(p.grad.clone() for p in field.decoder.parameters()))  # type: ignore[misc]
        optimiser.step(batch, rates, torch.Generator())
    return density, feature, *held


def exact_gradients(field: Field, batch: Batch, rates: Rates) -> tuple[torch.Tensor, ...]:
    """The same with rays, places, field and decoder in float64."""
    return torch_gradients(doubled(field), doubled_rays(batch), rates)


def doubled(field: Field) -> Field:
    return double(replace(field, decoder=copy.deepcopy(field.decoder)))


def doubled_rays(batch: Batch) -> Batch:
    distance = None if batch.distance is None else batch.distance.double()
    weight = None if batch.weight is None else batch.weight.double()
    return Batch(batch.origins.double(), batch.directions.double(), batch.colour.double(), batch.view, distance, weight)


def clear_of_zero(field: Field, batch: Batch, margin: float) -> torch.Tensor:
    """(B,) bool, which rays have no sample with a hidden unit whose input lies within `margin` of zero, in float64."""
    field, batch = doubled(field), doubled_rays(batch)
    decoder = field.decoder
    assert isinstance(decoder, PerSample)
    samples = march(field.grid, batch.origins, batch.directions, field.near, field.fine)
    least = torch.full((len(samples),), torch.inf, dtype=torch.float64)

    def look(_layer: object, _given: object, out: torch.Tensor) -> None:
        torch.minimum(least, out.abs().amin(1), out=least)

    hooks = [layer.register_forward_hook(look) for layer in (decoder.body[0], decoder.body[2], decoder.colour[0])]
    with torch.no_grad():
        decoder(gather(field.feature_rows, *corners(field.topology, samples.cell, samples.inside)), batch.directions[samples.ray])
    for hook in hooks:
        hook.remove()
    nearest = torch.full((len(batch.origins),), torch.inf, dtype=torch.float64)
    return nearest.scatter_reduce_(0, samples.ray, least, "amin") > margin
