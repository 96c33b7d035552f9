"""Losses and health numbers against slow, obvious references."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldfuse.nerfusion.training.curve import saturation
from fieldfuse.nerfusion.training.rendering import (
    FLOOR,
    WIDTH,
    TargetRays,
    Traced,
    annealed,
    depth_likelihood,
    feature_deviation,
    picture_rays,
    random_rays,
    relative_depth_error,
    rendering_health,
    rendering_loss,
)
from fieldfuse.nerfusion.training.samples import Pictures
from fieldfuse.nerfusion.training.step import Outcome


def traced(seed: int, rays: int = 7, samples: int = 9) -> Traced:
    rng = np.random.default_rng(seed)
    weight = rng.dirichlet(np.ones(samples + 1), rays)[:, :samples]
    distance = np.sort(rng.uniform(0.5, 4, (rays, samples)), axis=1)
    return Traced(
        colour=torch.from_numpy(rng.uniform(0, 1, (rays, 3))),
        opacity=torch.from_numpy(weight.sum(1)),
        weight=torch.from_numpy(weight.ravel()),
        distance=torch.from_numpy(distance.ravel()),
        ray=torch.arange(rays).repeat_interleave(samples),
    )


def some_rays(distance: torch.Tensor, colour: torch.Tensor, solid: torch.Tensor) -> TargetRays:
    zero = torch.zeros(len(distance), 3)
    return TargetRays(zero, zero, colour, distance, torch.ones(len(distance)), solid)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 1000))
def test_depth_likelihood_is_the_windowed_weight(seed: int) -> None:
    seen = traced(seed)
    truth = torch.from_numpy(np.random.default_rng(seed + 1).uniform(0.5, 4, 7)) * torch.tensor([1, 1, 0, 1, 1, 0, 1.0])
    found = depth_likelihood(seen, truth)
    assert found.isnan().tolist() == [False, False, True, False, False, True, False]
    found = found[~found.isnan()]
    expected = []
    for ray in range(7):
        if truth[ray] > 0:
            mass = 0.0
            for i in range(len(seen.ray)):
                if int(seen.ray[i]) == ray:
                    off = (float(seen.distance[i]) - float(truth[ray])) / (WIDTH * float(truth[ray]))
                    mass += float(seen.weight[i]) * math.exp(-0.5 * off * off)
            expected.append(math.log(min(mass, 1.0) + FLOOR))
    assert found.tolist() == pytest.approx(expected, abs=1e-9)


def test_likelihood_is_best_with_all_weight_at_the_surface_and_its_gradient_points_there() -> None:
    weight = torch.tensor([0.3, 0.3, 0.3], requires_grad=True)
    seen = Traced(torch.zeros(1, 3), weight.sum()[None], weight, torch.tensor([1.0, 2.0, 3.0]), torch.zeros(3, dtype=torch.int64))
    found = depth_likelihood(seen, torch.tensor([2.0]))
    found.sum().backward()
    assert weight.grad is not None
    assert float(weight.grad[1]) > 1 > 1e-3 > abs(float(weight.grad[0]))


def test_distances_where_half_the_light_is_stopped() -> None:
    seen = Traced(
        torch.zeros(3, 3),
        torch.tensor([0.9, 0.0, 0.4]),
        torch.tensor([0.1, 0.5, 0.3, 0.4]),
        torch.tensor([1.0, 2.0, 3.0, 5.0]),
        torch.tensor([0, 0, 0, 2]),
    )
    assert seen.median_distance().tolist() == [2.0, 0.0, 5.0]


def test_rendering_loss_is_its_three_terms() -> None:
    seen = traced(4)
    colour = torch.rand(7, 3, dtype=torch.float64)
    solid = torch.tensor([True, False, True, True, False, True, True])
    truth = torch.linspace(0.6, 3, 7).double()
    parts = rendering_loss(seen, some_rays(truth, colour, solid), 0.5, 0.25)
    error = ((seen.colour - colour) ** 2).mean()
    opacity = ((1 - seen.opacity[solid]) ** 2).mean()
    depth = -depth_likelihood(seen, truth).mean()
    assert float(parts.total) == pytest.approx(float(error + 0.5 * opacity + 0.25 * depth))
    without = rendering_loss(seen, some_rays(truth, colour, torch.zeros(7, dtype=torch.bool)), 0.5, 0.0)
    assert float(without.total) == pytest.approx(float(error)) and float(without.depth) == 0 and float(without.opacity) == 0


def test_means_are_over_what_is_known() -> None:
    blank = torch.zeros(7)
    assert rendering_health(traced(5), some_rays(blank, torch.zeros(7, 3), blank > 0))["depth_likelihood"].isnan()
    outcome = Outcome()
    assert outcome.means() == {}
    outcome.note({"some": torch.tensor(1.0), "none": torch.tensor(torch.nan)})
    outcome.note({"some": torch.tensor(torch.nan)})
    outcome.note({"some": torch.tensor(4.0, dtype=torch.float64)})
    assert outcome.means() == {"some": 2.5}


def test_the_depth_weight_falls_to_exactly_zero() -> None:
    values = [annealed(0.2, step, 100) for step in range(120)]
    assert values[0] == 0.2 and all(a >= b for a, b in pairwise(values))
    assert values[99] > 0 and values[100:] == [0.0] * 20
    assert annealed(0.2, 0, 0) == 0.0


def test_health_numbers() -> None:
    flat, lively = torch.full((2, 4, 8, 8), 3.0), torch.randn(2, 4, 8, 8, generator=torch.Generator().manual_seed(0))
    assert float(feature_deviation(flat)) == 0.0
    assert float(feature_deviation(lively)) == pytest.approx(1.0, abs=0.1)
    assert saturation(torch.tensor([0.001, 0.5, 0.995, 0.5])) == 0.5 and saturation(torch.zeros(0)) == 0.0
    weight, none = torch.tensor([0.1, 0.2, 0.5, 0.9]), torch.zeros(4)
    seen = Traced(torch.zeros(4, 3), weight, weight, torch.ones(4), torch.arange(4))
    health = {name: float(value) for name, value in rendering_health(seen, some_rays(none, torch.full((4, 3), 0.1), none > 0)).items()}
    assert (health["opacity_low"], health["opacity_middle"], health["opacity_high"]) == pytest.approx((0.5, 0.25, 0.25))
    assert health["psnr"] == pytest.approx(20.0)
    assert relative_depth_error(torch.tensor([1.1, 0.0, 4.0]), torch.tensor([1.0, 2.0, 0.0])).item() == pytest.approx(0.1)
    assert relative_depth_error(torch.zeros(2), torch.ones(2)).isnan()


def test_rays_go_through_their_pixels() -> None:
    """A point at each pixel's true depth projects back to the pixel's centre, and carries its colour."""
    generator = torch.Generator().manual_seed(0)
    pose = torch.eye(4)
    pose[:3, :3] = torch.linalg.qr(torch.randn(3, 3, generator=generator))[0]
    pose[:3, 3] = torch.tensor([1.0, -2.0, 0.5])
    poses = torch.stack([pose, torch.eye(4)])
    pictures = Pictures(
        torch.rand(2, 3, 6, 8, generator=generator),
        torch.tensor([[7.0, 8.0, 4.2, 2.9], [7.0, 8.0, 4.0, 3.0]]),
        poses,
        1 + torch.rand(2, 6, 8, generator=generator),
    )
    rays = picture_rays(pictures, 0)
    points = rays.origins + rays.directions * rays.distance[:, None]
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    assert torch.allclose(local[:, 2], pictures.depths[0].reshape(-1), atol=1e-5)
    pixels = local[:, :2] / local[:, 2:] * pictures.intrinsics[0, :2] + pictures.intrinsics[0, 2:]
    v, u = torch.meshgrid(torch.arange(6), torch.arange(8), indexing="ij")
    assert torch.allclose(pixels, torch.stack([u, v], -1).reshape(-1, 2) + 0.5, atol=1e-4)
    assert torch.equal(rays.colour, pictures.images[0].permute(1, 2, 0).reshape(-1, 3))
    assert torch.allclose(rays.distance * rays.cosine, pictures.depths[0].reshape(-1))
    some = random_rays(pictures, torch.tensor([1]), 50, generator)
    assert len(some) == 50 and torch.equal(some.origins, torch.zeros(50, 3))
    assert bool((some.colour[:, None] == pictures.images[1].permute(1, 2, 0).reshape(1, -1, 3)).all(2).any(1).all())


def test_pictures_with_nothing_behind_tell_which_rays_are_solid() -> None:
    depths = torch.tensor([[[0.0, 2.0]]])
    open_ = Pictures(torch.zeros(1, 3, 1, 2), torch.ones(1, 4), torch.eye(4)[None], depths, background=(1.0, 1.0, 1.0))
    assert picture_rays(open_, 0).solid.tolist() == [False, True]
    closed = Pictures(torch.zeros(1, 3, 1, 2), torch.ones(1, 4), torch.eye(4)[None], depths)
    assert picture_rays(closed, 0).solid.tolist() == [True, True]
