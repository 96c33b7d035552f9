"""Compositing: weights, transmittance, sums, gradients, distortion and densities, from 1e-12 to 1e6 of optical thickness."""

from __future__ import annotations

import math
from collections.abc import Sequence

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from fieldfuse.render.composite import distortion, exclusive_sum, ray_sum, weights
from fieldfuse.render.field import density
from fieldfuse.render.march import first_of_ray
from tests.stability.hard import reference
from tests.stability.hard.errors import absolute, by_size, not_finite, relative
from tests.stability.hard.ranges import QUICK
from tests.stability.hard.within import Within

GROUP = "compositing"
EXACT = 2e-6  # a weight is a product of two float32 factors, each with an exponential in it
SUM = 1e-6
BOUNDS = {
    "weight": SUM,
    "transmittance": SUM,
    "sum with what passes through": SUM,
    "gradient": EXACT,
    "values that are not finite": 0.0,
}


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


def hold(within: Within, errors: dict[str, float], relative: float = math.inf) -> None:
    """Hold the errors to this module's bounds; relative errors of weights only where their bound is given."""
    within.each(
        {name: errors[name] for name in errors if name != "weight, relative" or relative < math.inf},
        others={**BOUNDS, "weight, relative": relative},
    )


def spread(count: int, low: float, high: float, seed: int) -> list[float]:
    """`count` values evenly random in their logarithm."""
    generator = torch.Generator().manual_seed(seed)
    part = torch.rand(count, generator=generator, dtype=torch.float64)
    return (10 ** (math.log10(low) + (math.log10(high) - math.log10(low)) * part)).tolist()


def test_one_sample(within: Within) -> None:
    """One sample, τ from 1e-12 to 1e6."""
    hold(within, compositing_errors([[10.0**power] for power in range(-12, 7)]), relative=3e-7)


def test_many_samples(within: Within) -> None:
    """1 to 8,192 samples a ray, τ over 18 orders."""
    hold(within, compositing_errors([spread(count, 1e-12, 1e6, count) for count in (1, 2, 3, 64, 511, 4096, 8192)]))


def test_haze(within: Within) -> None:
    """Thin haze over 4,096 steps."""
    errors = compositing_errors([[tau] * 4096 for tau in (1e-12, 1e-9, 1e-7, 1e-6)])
    hold(within, errors, relative=1e-6)
    for tau in (1e-12, 1e-9, 1e-7):
        thickness, ray, first = flatten([[tau] * 4096])
        opacity = ray_sum(weights(thickness, first)[0].double(), ray, 1)
        exact = -math.expm1(-4096 * float(thickness[0].double()))
        within(f"opacity at τ = {tau:g}, relative", relative(opacity, [exact]), 1e-6)


def test_opaque_first(within: Within) -> None:
    """A fully opaque first sample."""
    rays = [[tau, *spread(500, 1e-6, 10, 3)] for tau in (200.0, 1e4, 1e6)]
    thickness, _, first = flatten(rays)
    light = weights(thickness, first)[1]
    behind = torch.arange(len(thickness)) != first
    gradient = gradient_of_sum(thickness, first)
    hold(within, compositing_errors(rays))
    within("light behind it", float(light[behind].max()), 0.0)
    within("gradient behind it", float(gradient[behind].abs().max()), 0.0)


def test_neighbours_in_a_list(within: Within) -> None:
    """Thin rays behind 400 fully opaque ones in one list.

    One running sum serves all rays of a list: what came before must not take digits from what follows.
    """
    rays = [[1e6] * 2048] * 400 + [[1e-9] * 64, [1e-3] * 64, spread(64, 1e-9, 1, 7)]
    thickness, ray, first = flatten(rays)
    weight, light = weights(thickness, first)
    thin = ray >= 400
    parts = [reference.composite(samples.tolist()) for samples in thickness.double()[thin].split(64)]
    wanted = torch.tensor([w for part in parts for w in part[0]], dtype=torch.float64)
    gradient = gradient_of_sum(thickness, first)[thin]
    exact = [g for samples in thickness.double()[thin].split(64) for g in reference.composite_gradient(samples.tolist(), [1.0] * 64)]
    total = ray_sum(weight.double(), ray, len(rays))[400:] + torch.tensor([part[2] for part in parts], dtype=torch.float64)
    within("weight of the thin rays, relative", relative(weight[thin], wanted), 1e-6)
    within("sum with what passes through", absolute(total, torch.ones(3)), SUM)
    within("gradient", by_size(gradient, exact), EXACT)
    within("values that are not finite", not_finite(weight, light, gradient), 0.0)


# Losses below this are differences of sums of about 1, so in double they are right to about 1e-16, not to a share of their size.
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


def test_distortion_cases(within: Within) -> None:
    """Distortion loss: 1 to 1,024 samples, equal places, no weight, one spike."""
    rays = [_along(count, count) for count in (1, 2, 50, 1024)]
    rays += [([0.2] * 5, [0.5] * 5, [0.1] * 5), ([0.0] * 9, _along(9, 1)[1], [0.1] * 9)]
    rays += [([0.0] * 20 + [1.0] + [0.0] * 20, [i / 41 for i in range(41)], [1 / 41] * 41)]
    errors = distortion_errors(rays)
    bounds = {"loss": 1e-6, "gradient": 1e-6, "values that are not finite": 0.0, "negative losses": 0.0}
    for name, error in errors.items():
        within(name, error, bounds[name])


def test_activation(within: Within) -> None:
    """Density activation from -1e30 to 1e30, over no length too."""
    raw = torch.tensor([-1e30, -1e4, -104.0, -20.0, -1.0, 0.0, 1.0, 11.999, 12.0, 12.001, 1e4, 1e30, 3.4e38], requires_grad=True)
    sigma = density(raw)
    unit, highest = (float(density(torch.tensor(value)).double()) for value in (0.0, 1e30))
    exact = [min(math.exp(max(min(value, 80.0), -800.0)) * unit, highest) for value in raw.detach().double().tolist()]
    within("density, relative", relative(sigma, exact, 1e-36), 2e-6)
    for length in (0.0, 1e-12, 1e-3, 1.0):
        raw.grad = None
        thickness = density(raw) * length
        weight, _ = weights(thickness, torch.zeros(len(raw), dtype=torch.int64))
        weight.sum().backward()
        assert raw.grad is not None
        within(f"not finite over a length of {length:g}", not_finite(thickness, weight, raw.grad), 0.0)
        if length == 0:
            within("gradient over no length", float(raw.grad.abs().max()), 0.0)


def test_half_types(within: Within) -> None:
    """Thickness in bfloat16 and float16, and under autocast.

    Sums are kept in double whatever comes in, so only the rounding of inputs and outputs is left.
    """
    rays = [spread(count, 1e-4, 3, count) for count in (1, 64, 1024)]
    full, ray, first = flatten(rays)
    sizes = [1, 64, 1024]
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
        within(f"weight in {name}, by the largest", by_size(weight, exact), 2 * step)
        within(f"gradient in {name}, by the largest", by_size(leaf.grad, gradient), 4 * step)
        within(f"not finite in {name}", not_finite(weight, light, leaf.grad), 0.0)
        with torch.autocast("cpu", dtype=kind):
            same, _ = weights(full, first)
            opacity = ray_sum(same, ray, 3)
        plain, _ = weights(full, first)
        within(f"weight under {name} autocast", absolute(same, plain), 0.0)
        within(f"opacity under {name} autocast", absolute(opacity, ray_sum(plain, ray, 3)), 0.0)


THICKNESS = st.one_of(st.just(0.0), st.floats(-12, 6).map(lambda power: 10.0**power))


@QUICK
@given(st.lists(st.lists(THICKNESS, max_size=40), min_size=1, max_size=6), st.integers(0, 100))
def test_compositing(parts: list[list[float]], seed: int) -> None:
    within = Within()
    hold(within, compositing_errors(parts, seed))
    within.check()


@QUICK
@given(st.data(), st.integers(1, 40))
def test_distortion(data: st.DataObject, count: int) -> None:
    weights = data.draw(st.lists(st.floats(0, 1), min_size=count, max_size=count))
    total = max(1.0, math.fsum(weights))
    places = sorted(data.draw(st.lists(st.floats(0, 1), min_size=count, max_size=count)))
    lengths = data.draw(st.lists(st.floats(0, 1), min_size=count, max_size=count))
    errors = distortion_errors([([weight / total for weight in weights], places, lengths)])
    assert errors["values that are not finite"] == 0 and errors["negative losses"] == 0
    assert errors["gradient"] < 1e-6 and errors["loss"] < 1e-6


def test_even_samples(within: Within) -> None:
    """8,192 even samples of a translucent ray."""
    hold(within, compositing_errors([[total / 8192] * 8192 for total in (0.1, 1.0, 5.0, 30.0)]), relative=1e-5)


def test_no_length(within: Within) -> None:
    """Intervals of no length between others."""
    rays = [[0.0], [0.0] * 50, [0.0, 1.0, 0.0, 0.0, 2.0, 0.0], [1e6, 0.0, 0.0], [0.0, 1e-12, 0.0]]
    thickness, _, first = flatten(rays)
    weight = weights(thickness, first)[0]
    stopped = float(weight[thickness == 0].abs().max())
    hold(within, compositing_errors(rays), relative=3e-7)
    within("light stopped by no length", stopped, 0.0)


def test_empty_rays(within: Within) -> None:
    """Empty rays between full ones, and no ray at all."""
    rays = [[], [0.5, 1.0], [], [], spread(100, 1e-3, 1, 1), []]
    hold(within, compositing_errors(rays))
    thickness, ray, first = flatten(rays)
    opacity = ray_sum(weights(thickness, first)[0], ray, len(rays))
    within("opacity of empty rays", float(opacity[[0, 2, 3, 5]].abs().max()), 0.0)
    nothing = torch.zeros(0)
    none = torch.zeros(0, dtype=torch.int64)
    weight, light = weights(nothing, first_of_ray(none))
    gradient = gradient_of_sum(nothing, first_of_ray(none))
    within("samples made of nothing", float(len(weight) + len(light) + len(gradient)), 0.0)


def test_a_loss_too_small_for_float32_is_compared_as_it_is() -> None:
    """A weight of 1e-38 costs 1e-77, which is 0 there; a wrong loss is noticed all the same."""
    errors = distortion_errors([([1.1754943508222875e-38], [0.0], [1.0])])
    assert errors["loss"] < 1e-30 and by_size(torch.tensor([0.5]), [1e-77]) == 0.5


def test_a_loss_below_the_digits_of_its_sums_is_told_to_these() -> None:
    """A weight of 4e-16 before one of 1: the loss is 8e-16, of sums whose last digit is 2e-16."""
    assert distortion_errors([([4e-16, 1.0], [0.0, 1.0], [0.0, 0.0])])["loss"] < 1e-6


def test_weights_from_one_minus_exp_are_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    def careless(thickness: torch.Tensor, first: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        light = torch.exp(-exclusive_sum(thickness, first)).to(thickness.dtype)
        return light * (1 - torch.exp(-thickness)), light

    monkeypatch.setitem(globals(), "weights", careless)
    within = Within()
    test_haze(within)
    assert "weight, relative" in within.missed
    test_neighbours_in_a_list(within := Within())
    assert within.missed
