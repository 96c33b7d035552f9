"""The depth term and the scaling of gradients near cameras: distances, gradients, and a fit that finds a surface where colours cannot."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldfuse.backends.numba.train_batch import near_scale
from fieldfuse.camera import Intrinsics, Similarity
from fieldfuse.capture.types import Views
from fieldfuse.config import FitSettings
from fieldfuse.poses.scene import Scene
from fieldfuse.render.image import render_view
from fieldfuse.training.fit import fit_field
from fieldfuse.training.losses import FINE, REACH, ROUGH, Rates, Trust, depth_gradient, near_gradient_scaling
from fieldfuse.training.pixels import PixelPool, ray_distances
from fieldfuse.training.schedule import Schedule
from tests.poses.textured import arc, render
from tests.render.made import random_field
from tests.training.gradients import made_views, torch_gradients
from tests.training.test_fit import ticking, wanted
from tests.training.test_numba import RATES


def test_distances_along_rays_are_those_of_the_pools_directions() -> None:
    views = made_views()
    pool = PixelPool(views, depth=True)
    batch = pool.take(torch.arange(len(pool)))
    assert batch.distance is not None
    for index, depth in enumerate(views.depths):
        mine = batch.view == index
        if depth is None:
            assert not bool(batch.distance[mine].any())
            continue
        along = (batch.directions[mine] @ torch.from_numpy(views.world_from_camera[index][:3, 2]).float()) * batch.distance[mine]
        np.testing.assert_allclose(along.numpy(), depth.reshape(-1), atol=1e-5)


def test_what_is_no_depth_stays_unknown() -> None:
    depth = np.array([[np.nan, -1.0, 0.0, np.inf, 2.0]], np.float32)
    found = ray_distances(depth, Intrinsics(5, 1, 5, 5, 2.5, 0.5))
    assert (found[0, :4] == 0).all() and found[0, 4] > 2


@pytest.mark.parametrize("noise", [FINE.noise, ROUGH.noise])
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_weight_is_drawn_to_the_surface_alike_at_any_scale(scale: float, noise: float) -> None:
    away = torch.tensor([0.0, 0.5, 1.0, 5.0, -0.5, -0.9])
    target = torch.full((6,), 2.0 * scale)
    got = depth_gradient(target * (1 + noise * away.sign() + REACH * away), target, noise)
    torch.testing.assert_close(got, torch.tensor([-1.0, -0.5, 0.0, 0.0, -0.5, -0.1]), atol=1e-3, rtol=0)
    assert not bool(depth_gradient(target, torch.zeros(6), noise).any())


@pytest.mark.parametrize("noise", [FINE.noise, ROUGH.noise])
def test_within_its_noise_a_depth_says_nothing(noise: float) -> None:
    target = torch.full((3,), 2.0)
    got = depth_gradient(target * (1 + noise * torch.tensor([-0.99, 0.3, 0.99])), target, noise)
    assert bool((got == -1).all())  # the same for all: no sample is drawn away from another


@pytest.mark.parametrize("trust", [FINE, ROUGH])
def test_the_schedule_believes_depth_as_far_as_it_is_told(trust: Trust) -> None:
    plan = Schedule([32], 1.0, FitSettings(depth=0.06), True, trust=trust)
    first, last = plan.rates(0.0, 0), plan.rates(1.0, 0)
    assert first.depth_noise == last.depth_noise == trust.noise
    assert first.depth == pytest.approx(0.06 * trust.weight) and last.depth == pytest.approx(first.depth * trust.last)


@pytest.mark.parametrize("trust", [FINE, ROUGH])
def test_depth_is_believed_no_longer_in_a_longer_fit(trust: Trust) -> None:
    def believed(budget: float, seconds: float) -> float:
        plan = Schedule([32], budget, FitSettings(depth=0.06), True, trust=trust)
        return plan.rates(plan.position(seconds), round(seconds * trust.rays / 50)).depth

    fits = [[believed(budget, seconds) for seconds in np.linspace(0, budget, 9)] for budget in (20, 60, 300)]
    assert all(np.diff(fit).max() <= 0 for fit in fits)
    assert {fit[0] for fit in fits} == {0.06 * trust.weight}
    assert [fit[-1] for fit in fits] == pytest.approx([0.06 * trust.weight * trust.last] * 3)
    assert [believed(budget, 25) for budget in (60, 300)] == pytest.approx([0.06 * trust.weight * trust.last**0.5] * 2)
    assert believed(300, 50) == believed(300, 200) == pytest.approx(fits[2][-1])


@pytest.mark.parametrize("rough", [True, False])
def test_a_fit_knows_where_depth_comes_from(rough: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[float] = []

    class Told(Schedule):
        def rates(self, done: float, rays: int) -> Rates:
            rates = super().rates(done, rays)
            asked.append(rates.depth_noise)
            return rates

    monkeypatch.setattr("fieldfuse.training.fit.Schedule", Told)
    ticking(monkeypatch, 0.05)
    views = replace(blank_views(), rough=rough)
    scene = Scene(Similarity.identity(), np.array([0.0, -1.5, 1.0]), np.full(3, 4.5), 3.4, 1.0, 8.0, 0.0, False, False)
    fit_field(views, scene, wanted("fit.depth=0.05"))
    assert asked and set(asked) == {(ROUGH if rough else FINE).noise}


def blank_views() -> Views:
    """The corner of walls, painted all grey, with its exact depth."""
    camera = Intrinsics(48, 36, 45, 45, 24, 18)
    poses = arc(9, 44.0)
    depths = [render(pose, camera)[1].astype(np.float32) for pose in poses]
    grey = np.full((36, 48, 3), 90, np.uint8)
    return Views([f"{i}" for i in range(9)], [grey] * 9, [camera] * 9, poses, np.arange(9) == 4, depths=list(depths))


@pytest.mark.parametrize(("weight", "found"), [("fit.depth=0.05", True), ("fit.depth=0", False)])
def test_a_wall_without_texture_is_found_by_its_depth(weight: str, found: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """At a held-out view. The start, which depth empties too, is taken away from both, so that the term alone decides."""
    ticking(monkeypatch, 0.015)
    monkeypatch.setattr("fieldfuse.training.fit.possible", lambda _space, _resolution, places, _views: places)
    views = blank_views()
    scene = Scene(Similarity.identity(), np.array([0.0, -1.5, 1.0]), np.full(3, 4.5), 3.4, 1.0, 8.0, 0.0, False, False)
    field = fit_field(views, scene, wanted(weight)).field
    rendered = render_view(field, views.intrinsics[4], views.world_from_camera[4])
    depth = views.depths[4]
    assert depth is not None
    known = depth > 0
    error = np.where(rendered.depth > 0, np.abs(rendered.depth - depth) / np.maximum(depth, 1e-6), 1.0)[known]
    assert (float(np.median(error)) < 0.04) is found, float(np.median(error))


BOUNDS = st.floats(0.0625, 100, width=32)
DISTANCES = st.floats(-1, 1000, width=32)


@settings(deadline=None)
@given(distance=DISTANCES, within=BOUNDS)
def test_both_engines_slow_a_sample_by_its_distance(distance, within):
    factor = float(near_gradient_scaling(torch.tensor([distance]), within)[0])
    assert factor == pytest.approx(min(max(distance, 0) / within, 1) ** 2, abs=1e-6)
    assert float(near_scale(np.float32(distance), np.float32(within))) == pytest.approx(factor, abs=1e-6)


@pytest.mark.parametrize("decoder", ["deferred", "per_sample"])
def test_far_away_gradients_are_what_they_were(decoder):
    """Cameras stand 3 before a box of half a side 1: a bound below the nearest corner changes nothing, one far beyond makes all gradients
    of rows smaller."""
    field = random_field(0.0, 32, decoder, keep=0.5, raw=-2.5)
    batch = PixelPool(made_views(), depth=True).take(torch.arange(0, 2000, 7))
    plain, below, beyond = (torch_gradients(field, batch, replace(RATES, slow_within=bound)) for bound in (0.0, 0.5, 20.0))
    for one, other in zip(plain, below, strict=True):
        assert torch.equal(one, other)
    for one, other in zip(plain[:2], beyond[:2], strict=True):
        assert 0 < float(other.norm()) < 0.1 * float(one.norm())
