"""The step in torch against autograd in float64, a loop over rays and samples, and the lazy Adam against torch's."""

from __future__ import annotations

import copy
from dataclasses import replace
from functools import partial

import pytest
import torch

from fieldfuse.nerfusion.decoder import Deferred
from fieldfuse.render.field import Field, density
from fieldfuse.render.march import Samples, march
from fieldfuse.render.rays import shade
from fieldfuse.training import torch_engine
from fieldfuse.training.losses import REACH, Rates
from fieldfuse.training.pixels import Batch, PixelPool
from fieldfuse.training.torch_engine import LazyAdam, TorchEngine
from fieldfuse.volume.lookup import corners
from tests.render.made import random_field, random_rays
from tests.training.gradients import made_views

Tensor = torch.Tensor


def reference_loss(field: Field, samples: Samples, batch: Batch, rates: Rates, raw_rows: Tensor, feature_rows: Tensor) -> Tensor:
    """The loss written down as in the paper, one ray at a time, in float64."""
    rows, corner_weights = corners(field.topology, samples.cell, samples.inside)
    corner_weights = corner_weights.double()
    raw = (raw_rows[rows.long()] * corner_weights).sum(1)
    features = (feature_rows[rows.long()] * corner_weights[..., None]).sum(1)
    count, total = len(batch.origins), torch.zeros(()).double()
    distance, places = samples.distance.double(), samples.place.double()
    slow = (distance / rates.slow_within).clamp_max(1) ** 2 if rates.slow_within else torch.ones(len(samples)).double()
    if isinstance(field.decoder, Deferred):
        colours = None
        features.register_hook(lambda gradient: gradient * slow[:, None])
    else:
        extra, colours = field.decoder(features, batch.directions[samples.ray].double())
        raw = raw + extra
        colours.register_hook(lambda gradient: gradient * slow[:, None])
    tau = density(raw) * samples.length
    tau.register_hook(lambda gradient: gradient * slow)
    for ray in range(count):
        mine = (samples.ray == ray).nonzero().squeeze(1)
        light, weights = torch.ones(()).double(), []
        for i in mine:
            weights.append(light * (1 - torch.exp(-tau[i])))
            light = light * torch.exp(-tau[i])
        w = torch.stack(weights) if weights else torch.zeros(0).double()
        opacity = w.sum()
        if colours is None:
            mean = (w[:, None] * features[mine]).sum(0) / opacity.clamp_min(1e-6)
            colour = opacity * field.decoder(mean[None], batch.directions[ray][None].double())[0]  # type: ignore[operator]
        else:
            colour = (w[:, None] * colours[mine]).sum(0)
        mixed = colour + (1 - opacity) * field.background
        place = places[mine]
        spread = (w[:, None] * w[None] * (place[:, None] - place[None]).abs()).sum() + (w**2).sum() * field.grid.voxel * 4 / field.fine / (
            2 * field.space.extent
        ) / 3
        own = ((mixed - batch.colour[ray]) ** 2).sum() / 3 + rates.distortion * spread + rates.opacity * (1 - opacity) ** 2
        if batch.distance is not None and batch.distance[ray] > 0:
            away = ((distance[mine] - batch.distance[ray]).abs() / batch.distance[ray].double() - rates.depth_noise) / REACH
            own = own + rates.depth * (w * (away.clamp(0, 1) - 1)).sum()
        total = total + own * (1.0 if batch.weight is None else batch.weight[ray]) / count
    return total


@pytest.mark.parametrize("decoder", ["deferred", "per_sample"])
@pytest.mark.parametrize(("shell", "slow"), [(0.0, False), (1.0, False), (1.0, True)])
def test_gradients_match_autograd(decoder: str, shell: float, slow: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    field = random_field(background=shell, resolution=16, decoder=decoder, raw=-2.0)
    monkeypatch.setattr(torch_engine, "shade", partial(shade, stop=-1.0))
    origins, directions = random_rays(24)
    samples = march(field.grid, origins, directions, field.near, field.fine)
    generator = torch.Generator().manual_seed(1)
    distance = torch.zeros(24)
    distance[samples.ray] = samples.distance  # the last one of each ray …
    distance *= torch.rand(24, generator=generator) > 0.4  # … and of some nothing is known
    assert bool((distance > 0).any()) and bool((distance == 0).any())
    weight = torch.rand(24, generator=generator) + 0.5
    batch = Batch(origins, directions, torch.rand(24, 3, generator=generator), torch.zeros(24, dtype=torch.int64), distance, weight)
    within = float(samples.distance.median()) if slow else 0.0
    rates = Rates(0.0, 0.0, 0.0, 0.01, 0.03, colour_threshold=-1.0, depth=0.05, slow_within=within)
    monkeypatch.setattr(torch_engine, "march", lambda *arguments: samples)  # the same samples for both, without jitter
    raw_rows = field.density_rows.double().requires_grad_(True)
    feature_rows = field.feature_rows.double().requires_grad_(True)
    exact = replace(field, decoder=copy.deepcopy(field.decoder).double())
    reference_loss(exact, samples, batch, rates, raw_rows, feature_rows).backward()
    expected = [parameter.grad for parameter in exact.decoder.parameters() if parameter.grad is not None]

    caught: dict[str, tuple[Tensor, Tensor]] = {}
    optimiser = TorchEngine(field, PixelPool(made_views()))
    monkeypatch.setattr(optimiser.density, "step", lambda rows, gradient, rate: caught.__setitem__("density", (rows, gradient)))
    monkeypatch.setattr(optimiser.feature, "step", lambda rows, gradient, rate: caught.__setitem__("feature", (rows, gradient)))
    monkeypatch.setattr(optimiser.decoder, "zero_grad", lambda: None)
    optimiser.step_on(batch, rates, torch.zeros(24))
    for name, reference in (("density", raw_rows.grad), ("feature", feature_rows.grad)):
        rows, gradient = caught[name]
        full = torch.zeros_like(field.density_rows if name == "density" else field.feature_rows)
        full[rows] = gradient
        assert reference is not None and float(reference.norm()) > 0
        reference[-1] = 0
        assert float((full - reference).norm() / reference.norm()) < 1e-5, name
    for parameter, reference in zip(field.decoder.parameters(), expected, strict=True):
        assert parameter.grad is not None
        assert torch.allclose(parameter.grad.double(), reference, rtol=1e-3, atol=1e-7)


def test_lazy_adam_equals_adam_without_a_first_moment_where_every_row_moves() -> None:
    generator = torch.Generator().manual_seed(0)
    values = torch.randn(20, 4, generator=generator)
    twin = values.clone().requires_grad_(True)
    lazy, adam = LazyAdam(values), torch.optim.Adam([twin], lr=0.1, betas=(0.0, 0.99), eps=1e-10)
    for _ in range(25):
        gradient = torch.randn(20, 4, generator=generator)
        lazy.step(torch.arange(20), gradient, 0.1)
        twin.grad = gradient.clone()
        adam.step()
    assert torch.allclose(values, twin.detach(), atol=1e-5)


def test_rows_that_are_not_touched_stay_bit_identical() -> None:
    values = torch.randn(50)
    before = values.clone()
    LazyAdam(values).step(torch.tensor([3, 7]), torch.tensor([1.0, -1.0]), 0.1)
    assert torch.equal(values[[0, 1, 2, 4, 5, 6, *range(8, 50)]], before[[0, 1, 2, 4, 5, 6, *range(8, 50)]])
    assert float(values[3]) == pytest.approx(float(before[3]) - 0.1, abs=1e-5)


def test_a_step_lowers_the_error() -> None:
    field = random_field(background=1.0, resolution=16, raw=-3.0)
    origins, directions = random_rays(256)
    batch = Batch(origins, directions, torch.full((256, 3), 0.7), torch.zeros(256, dtype=torch.int64))
    engine, generator = TorchEngine(field, PixelPool(made_views())), torch.Generator().manual_seed(0)
    errors = [engine.step_on(batch, Rates(0.1, 0.1, 3e-3, 0.001), torch.rand(256, generator=generator))[0] for _ in range(40)]
    assert errors[-1] < 0.1 * errors[0]
