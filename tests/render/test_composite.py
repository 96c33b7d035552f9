"""Compositing against slow float64 loops."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldfuse.render.composite import distortion, exclusive_sum, ray_sum, weights
from fieldfuse.render.march import first_of_ray


def loop_weights(thickness: list[float], ray: list[int]) -> list[float]:
    out, light = [], {}
    for tau, r in zip(thickness, ray, strict=True):
        before = light.get(r, 1.0)
        out.append(before * -math.expm1(-tau))
        light[r] = before * math.exp(-tau)
    return out


def random_rays(seed: int, count: int = 40, rays: int = 7) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    ray = torch.randint(rays, (count,), generator=generator).sort().values
    thickness = torch.rand(count, generator=generator) * 2
    return thickness, ray, first_of_ray(ray)


@given(st.lists(st.floats(0, 50, width=32), min_size=1, max_size=60), st.integers(1, 6))
@settings(deadline=None, max_examples=60)
def test_weights_match_the_loop_and_sum_with_the_rest_to_one(thickness: list[float], rays: int) -> None:
    ray = sorted(i % rays for i in range(len(thickness)))
    tau, index = torch.tensor(thickness), torch.tensor(ray)
    weight, transmittance = weights(tau, first_of_ray(index))
    assert torch.allclose(weight.double(), torch.tensor(loop_weights(thickness, ray), dtype=torch.float64), atol=1e-6, rtol=1e-5)
    last = transmittance * torch.exp(-tau)
    ends = torch.tensor([i + 1 == len(ray) or ray[i + 1] != ray[i] for i in range(len(ray))])
    total = ray_sum(weight, index, rays)[index[ends]] + last[ends]
    assert torch.allclose(total, torch.ones_like(total), atol=1e-5)


def test_thin_media_keep_their_digits() -> None:
    tau = torch.full((4096,), 1e-9)
    weight, _ = weights(tau, torch.zeros(4096, dtype=torch.int64))
    assert float(weight.double().sum()) == pytest.approx(-math.expm1(-4096e-9), rel=1e-5)


def test_exclusive_sum_of_nothing() -> None:
    assert len(exclusive_sum(torch.zeros(0), torch.zeros(0, dtype=torch.int64))) == 0


@pytest.mark.parametrize("seed", range(5))
def test_thickness_gradient_matches_autograd_of_the_loop(seed: int) -> None:
    thickness, ray, first = random_rays(seed)
    wanted = torch.randn(len(ray), generator=torch.Generator().manual_seed(seed + 100))
    tau = thickness.double().requires_grad_(True)
    light: dict[int, torch.Tensor] = {}
    parts = []
    for i in range(len(ray)):
        before = light.get(int(ray[i]), torch.ones((), dtype=torch.float64))
        parts.append(before * (1 - torch.exp(-tau[i])))
        light[int(ray[i])] = before * torch.exp(-tau[i])
    (torch.stack(parts) * wanted.double()).sum().backward()
    own = thickness.clone().requires_grad_(True)
    weights(own, first)[0].backward(wanted)
    assert tau.grad is not None and own.grad is not None
    assert torch.allclose(own.grad.double(), tau.grad, atol=2e-6)


@pytest.mark.parametrize("seed", range(5))
def test_distortion_matches_the_double_sum_and_its_gradient(seed: int) -> None:
    thickness, ray, first = random_rays(seed)
    generator = torch.Generator().manual_seed(seed)
    place = torch.rand(len(ray), generator=generator)
    place = torch.cat([place[ray == r].sort().values for r in range(7)])
    length = torch.rand(len(ray), generator=generator) * 0.1
    w = (thickness * 0.1).double().requires_grad_(True)
    loops = []
    for r in range(7):
        mask = ray == r
        wr, sr = w[mask], place[mask].double()
        loops.append((wr[:, None] * wr[None] * (sr[:, None] - sr[None]).abs()).sum() + (wr**2 * length[mask].double()).sum() / 3)
    total = torch.stack(loops)
    total.sum().backward()
    own = (thickness * 0.1).requires_grad_(True)
    loss = distortion(own, place, length, first, ray, 7)
    loss.sum().backward()
    assert w.grad is not None and own.grad is not None
    assert torch.allclose(loss.double(), total, atol=1e-6)
    assert torch.allclose(own.grad.double(), w.grad, atol=1e-6)
