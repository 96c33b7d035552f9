"""Compositing: weights, transmittance, their sums and gradients, from 1e-12 to 1e6 of optical thickness."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from fieldfuse.evaluation.selftest import reference
from fieldfuse.evaluation.selftest.case import Measure, absolute, by_size, case, not_finite, relative
from fieldfuse.render.composite import ray_sum, weights
from fieldfuse.render.march import first_of_ray

GROUP = "compositing"
EXACT = 2e-6  # a weight is a product of two float32 factors, each with an exponential in it
SUM = 1e-6


def flatten(rays: Sequence[Sequence[float]]) -> tuple[Tensor, Tensor, Tensor]:
    """Optical thickness (samples,) float32, ray (samples,) and first sample of each sample's ray."""
    ray = torch.tensor([index for index, samples in enumerate(rays) for _ in samples], dtype=torch.int64)
    return torch.tensor([tau for samples in rays for tau in samples], dtype=torch.float32), ray, first_of_ray(ray)


def gradient_of_sum(thickness: Tensor, first: Tensor) -> Tensor:
    """(samples,) gradient of the sum of all weights."""
    leaf = thickness.detach().clone().requires_grad_(True)
    weights(leaf, first)[0].sum().backward()
    assert leaf.grad is not None
    return leaf.grad


def compositing_errors(rays: Sequence[Sequence[float]], seed: int = 0) -> dict[str, float]:
    """Errors of weights, sums and gradients over whole rays of any thickness."""
    thickness, ray, first = flatten(rays)
    rays = [samples.tolist() for samples in thickness.double().split([len(samples) for samples in rays])]  # as float32 holds them
    generator = torch.Generator().manual_seed(seed)
    pull = torch.randn(len(thickness), generator=generator)
    parts = [reference.composite(samples) for samples in rays]
    wanted_weight = [w for part in parts for w in part[0]]
    wanted_light = [t for part in parts for t in part[1]]
    pulls = [part.tolist() for part in pull.double().split([len(samples) for samples in rays])]
    wanted_gradient = [g for samples, by in zip(rays, pulls, strict=True) for g in reference.composite_gradient(samples, by)]

    leaf = thickness.clone().requires_grad_(True)
    weight, light = weights(leaf, first)
    (weight * pull).sum().backward()
    assert leaf.grad is not None
    weight, light = weight.detach(), light.detach()
    total = ray_sum(weight.double(), ray, len(rays)) + torch.tensor([part[2] for part in parts], dtype=torch.float64)
    return {
        "weight": absolute(weight, wanted_weight),
        "weight, relative": relative(weight, wanted_weight, 1e-30),
        "transmittance": absolute(light, wanted_light),
        "sum with what passes through": absolute(total, torch.ones(len(rays))),
        "gradient": absolute(leaf.grad, wanted_gradient),
        "values that are not finite": not_finite(weight, light, leaf.grad),
    }


def measures(errors: dict[str, float], **bounds: float) -> list[Measure]:
    """The errors with this module's bounds; relative errors of weights are looked at only where a bound is given."""
    usual = {
        "weight": SUM,
        "transmittance": SUM,
        "sum with what passes through": SUM,
        "gradient": EXACT,
        "values that are not finite": 0.0,
        **{name.replace("_", " "): bound for name, bound in bounds.items()},
    }
    if "relative" in bounds:
        usual["weight, relative"] = bounds["relative"]
    return [Measure(name, error, usual[name]) for name, error in errors.items() if name in usual]


def spread(count: int, low: float, high: float, seed: int) -> list[float]:
    """`count` values evenly random in their logarithm."""
    generator = torch.Generator().manual_seed(seed)
    part = torch.rand(count, generator=generator, dtype=torch.float64)
    return (10 ** (math.log10(low) + (math.log10(high) - math.log10(low)) * part)).tolist()


@case(GROUP, "one sample, τ from 1e-12 to 1e6")
def one_sample(folder: Path) -> list[Measure]:
    return measures(compositing_errors([[10.0**power] for power in range(-12, 7)]), relative=3e-7)


@case(GROUP, "1 to 8,192 samples a ray, τ over 18 orders")
def many_samples(folder: Path) -> list[Measure]:
    return measures(compositing_errors([spread(count, 1e-12, 1e6, count) for count in (1, 2, 3, 64, 511, 4096, 8192)]))


@case(GROUP, "8,192 even samples of a translucent ray")
def even_samples(folder: Path) -> list[Measure]:
    return measures(compositing_errors([[total / 8192] * 8192 for total in (0.1, 1.0, 5.0, 30.0)]), relative=1e-5)


@case(GROUP, "thin haze over 4,096 steps")
def haze(folder: Path) -> list[Measure]:
    errors = compositing_errors([[tau] * 4096 for tau in (1e-12, 1e-9, 1e-7, 1e-6)])
    out = measures(errors, relative=1e-6)
    for tau in (1e-12, 1e-9, 1e-7):
        thickness, ray, first = flatten([[tau] * 4096])
        opacity = ray_sum(weights(thickness, first)[0].double(), ray, 1)
        exact = -math.expm1(-4096 * float(thickness[0].double()))
        out.append(Measure(f"opacity at τ = {tau:g}, relative", relative(opacity, [exact]), 1e-6))
    return out


@case(GROUP, "intervals of no length between others")
def no_length(folder: Path) -> list[Measure]:
    rays = [[0.0], [0.0] * 50, [0.0, 1.0, 0.0, 0.0, 2.0, 0.0], [1e6, 0.0, 0.0], [0.0, 1e-12, 0.0]]
    thickness, _, first = flatten(rays)
    weight = weights(thickness, first)[0]
    stopped = float(weight[thickness == 0].abs().max())
    return [*measures(compositing_errors(rays), relative=3e-7), Measure("light stopped by no length", stopped, 0.0)]


@case(GROUP, "a fully opaque first sample")
def opaque_first(folder: Path) -> list[Measure]:
    rays = [[tau, *spread(500, 1e-6, 10, 3)] for tau in (200.0, 1e4, 1e6)]
    thickness, _, first = flatten(rays)
    light = weights(thickness, first)[1]
    behind = torch.arange(len(thickness)) != first
    gradient = gradient_of_sum(thickness, first)
    return [
        *measures(compositing_errors(rays)),
        Measure("light behind it", float(light[behind].max()), 0.0),
        Measure("gradient behind it", float(gradient[behind].abs().max()), 0.0),
    ]


@case(GROUP, "empty rays between full ones, and no ray at all")
def empty_rays(folder: Path) -> list[Measure]:
    rays = [[], [0.5, 1.0], [], [], spread(100, 1e-3, 1, 1), []]
    out = measures(compositing_errors(rays))
    thickness, ray, first = flatten(rays)
    opacity = ray_sum(weights(thickness, first)[0], ray, len(rays))
    out.append(Measure("opacity of empty rays", float(opacity[[0, 2, 3, 5]].abs().max()), 0.0))
    nothing = torch.zeros(0)
    none = torch.zeros(0, dtype=torch.int64)
    weight, light = weights(nothing, first_of_ray(none))
    gradient = gradient_of_sum(nothing, first_of_ray(none))
    out.append(Measure("samples made of nothing", float(len(weight) + len(light) + len(gradient)), 0.0))
    return out


@case(GROUP, "thin rays behind 400 fully opaque ones in one list")
def neighbours_in_a_list(folder: Path) -> list[Measure]:
    """One running sum serves all rays of a list: what came before must not take digits from what follows."""
    rays = [[1e6] * 2048] * 400 + [[1e-9] * 64, [1e-3] * 64, spread(64, 1e-9, 1, 7)]
    thickness, ray, first = flatten(rays)
    weight, light = weights(thickness, first)
    thin = ray >= 400
    parts = [reference.composite(samples.tolist()) for samples in thickness.double()[thin].split(64)]
    wanted = torch.tensor([w for part in parts for w in part[0]], dtype=torch.float64)
    gradient = gradient_of_sum(thickness, first)[thin]
    exact = [g for samples in thickness.double()[thin].split(64) for g in reference.composite_gradient(samples.tolist(), [1.0] * 64)]
    total = ray_sum(weight.double(), ray, len(rays))[400:] + torch.tensor([part[2] for part in parts], dtype=torch.float64)
    return [
        Measure("weight of the thin rays, relative", relative(weight[thin], wanted), 1e-6),
        Measure("sum with what passes through", absolute(total, torch.ones(3)), SUM),
        Measure("gradient", by_size(gradient, exact), EXACT),
        Measure("values that are not finite", not_finite(weight, light, gradient), 0.0),
    ]
