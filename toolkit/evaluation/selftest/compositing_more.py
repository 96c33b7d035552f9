"""Compositing, continued: the distortion loss, the density activation, and lower precision."""

from __future__ import annotations

import math
from pathlib import Path

import torch

from fieldfuse.evaluation.selftest import reference
from fieldfuse.evaluation.selftest.case import Measure, absolute, by_size, case, not_finite, relative
from fieldfuse.evaluation.selftest.compositing import GROUP, flatten, spread
from fieldfuse.render.composite import distortion, ray_sum, weights
from fieldfuse.render.field import density
from fieldfuse.render.march import first_of_ray

# What comes to less, of weights and places of about 1, is told by the double sums to some 1e-16, not to a share of itself.
LEAST = 1e-9


def distortion_errors(rays: list[tuple[list[float], list[float], list[float]]]) -> dict[str, float]:
    """Errors of the distortion loss and its gradient, by the largest entry; rays are (weights, places ascending, lengths)."""
    ray = torch.tensor([index for index, (w, _, _) in enumerate(rays) for _ in w], dtype=torch.int64)
    weight, place, length = (torch.tensor([value for parts in rays for value in parts[part]], dtype=torch.float32) for part in range(3))
    sizes = [len(w) for w, _, _ in rays]
    exact = [
        reference.distortion(*(values.tolist() for values in parts))
        for parts in zip(*(values.double().split(sizes) for values in (weight, place, length)), strict=True)
    ]
    leaf = weight.clone().requires_grad_(True)
    loss = distortion(leaf, place, length, first_of_ray(ray), ray, len(rays))
    loss.sum().backward()
    loss, gradient = loss.detach(), leaf.grad if leaf.grad is not None else torch.zeros(0)
    losses = [one for one, _ in exact]
    return {
        "loss": absolute(loss, losses) / LEAST if max(losses, default=0.0) < LEAST else by_size(loss, losses),
        "gradient": by_size(gradient, [value for _, values in exact for value in values]),
        "values that are not finite": not_finite(loss, gradient),
        "negative losses": float((loss < 0).sum()),
    }


def _along(count: int, seed: int) -> tuple[list[float], list[float], list[float]]:
    generator = torch.Generator().manual_seed(seed)
    places = torch.rand(count, generator=generator, dtype=torch.float64).sort().values
    lengths = torch.rand(count, generator=generator, dtype=torch.float64) / count
    return [value / count for value in spread(count, 1e-8, 1, seed)], places.tolist(), lengths.tolist()


@case(GROUP, "distortion loss: 1 to 1,024 samples, equal places, no weight, one spike")
def distortion_cases(folder: Path) -> list[Measure]:
    rays = [_along(count, count) for count in (1, 2, 50, 1024)]
    rays += [([0.2] * 5, [0.5] * 5, [0.1] * 5), ([0.0] * 9, _along(9, 1)[1], [0.1] * 9)]
    rays += [([0.0] * 20 + [1.0] + [0.0] * 20, [i / 41 for i in range(41)], [1 / 41] * 41)]
    errors = distortion_errors(rays)
    bounds = {"loss": 1e-6, "gradient": 1e-6, "values that are not finite": 0.0, "negative losses": 0.0}
    return [Measure(name, error, bounds[name]) for name, error in errors.items()]


@case(GROUP, "density activation from -1e30 to 1e30, over no length too")
def activation(folder: Path) -> list[Measure]:
    raw = torch.tensor([-1e30, -1e4, -104.0, -20.0, -1.0, 0.0, 1.0, 11.999, 12.0, 12.001, 1e4, 1e30, 3.4e38], requires_grad=True)
    sigma = density(raw)
    unit, highest = (float(density(torch.tensor(value)).double()) for value in (0.0, 1e30))
    exact = [min(math.exp(max(min(value, 80.0), -800.0)) * unit, highest) for value in raw.detach().double().tolist()]
    out = [Measure("density, relative", relative(sigma, exact, 1e-36), 2e-6)]
    for length in (0.0, 1e-12, 1e-3, 1.0):
        raw.grad = None
        thickness = density(raw) * length
        weight, _ = weights(thickness, torch.zeros(len(raw), dtype=torch.int64))
        weight.sum().backward()
        assert raw.grad is not None
        out.append(Measure(f"not finite over a length of {length:g}", not_finite(thickness, weight, raw.grad), 0.0))
        if length == 0:
            out.append(Measure("gradient over no length", float(raw.grad.abs().max()), 0.0))
    return out


@case(GROUP, "thickness in bfloat16 and float16, and under autocast")
def half_types(folder: Path) -> list[Measure]:
    """Sums are kept in double whatever comes in, so only the rounding of inputs and outputs is left."""
    rays = [spread(count, 1e-4, 3, count) for count in (1, 64, 1024)]
    full, ray, first = flatten(rays)
    sizes = [1, 64, 1024]
    out = []
    for kind in (torch.bfloat16, torch.float16):
        thickness = full.to(kind)
        exact = [w for part in thickness.double().split(sizes) for w in reference.composite(part.tolist())[0]]
        leaf = thickness.clone().requires_grad_(True)
        weight, light = weights(leaf, first)
        weight.float().sum().backward()
        assert leaf.grad is not None
        parts = [part.tolist() for part in thickness.double().split(sizes)]
        gradient = [g for part in parts for g in reference.composite_gradient(part, [1.0] * len(part))]
        step = float(torch.finfo(kind).eps)
        name = str(kind).removeprefix("torch.")
        out.append(Measure(f"weight in {name}, by the largest", by_size(weight, exact), 2 * step))
        out.append(Measure(f"gradient in {name}, by the largest", by_size(leaf.grad, gradient), 4 * step))
        out.append(Measure(f"not finite in {name}", not_finite(weight, light, leaf.grad), 0.0))
        with torch.autocast("cpu", dtype=kind):
            same, _ = weights(full, first)
            opacity = ray_sum(same, ray, 3)
        plain, _ = weights(full, first)
        out.append(Measure(f"weight under {name} autocast", absolute(same, plain), 0.0))
        out.append(Measure(f"opacity under {name} autocast", absolute(opacity, ray_sum(plain, ray, 3)), 0.0))
    return out
