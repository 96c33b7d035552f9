"""Rendering with gradients: the values of the forward renderer, and gradients against finite differences in float64."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from fieldfuse.render.field import Field
from fieldfuse.render.rays import differentiable_gather, render_rays, render_with_gradients
from tests.render.made import random_field, random_rays


def double(field: Field) -> Field:
    return replace(
        field,
        density_rows=field.density_rows.double().detach(),
        feature_rows=field.feature_rows.double().detach(),
        decoder=field.decoder.double(),
        background=field.background.double(),
    )


@pytest.mark.parametrize("decoder", ["deferred", "per_sample"])
@pytest.mark.parametrize("shell", [0.0, 1.0])
def test_same_values_as_the_forward_renderer(decoder: str, shell: float) -> None:
    field = random_field(shell, 32, decoder, keep=0.7, seed=1)
    origins, directions = random_rays(300, 2)
    with torch.no_grad():
        ours = render_with_gradients(field, origins, directions)
    theirs = render_rays(field, origins, directions, threshold=0.0)
    torch.testing.assert_close(ours.colour.clamp(0, 1), theirs.colour, atol=1e-3, rtol=1e-3)
    torch.testing.assert_close(ours.opacity, theirs.opacity, atol=1e-3, rtol=1e-3)
    total = torch.zeros(300).index_add(0, ours.samples.ray, ours.weight)
    torch.testing.assert_close(total, ours.opacity, atol=1e-5, rtol=1e-4)
    seen = ours.opacity > 0.9
    assert int(seen.sum()) > 20
    first = torch.full((300,), torch.inf).scatter_reduce(0, ours.samples.ray, ours.samples.distance, "amin")
    last = torch.zeros(300).scatter_reduce(0, ours.samples.ray, ours.samples.distance, "amax")
    assert bool(((ours.distance >= first - 1e-4) & (ours.distance <= last + 1e-4))[seen].all())


@pytest.mark.parametrize("decoder", ["deferred", "per_sample"])
def test_gradients_against_finite_differences(decoder: str) -> None:
    """Every output at once, with respect to densities, features, the decoder's weights and the background."""
    field = double(random_field(0.0, 32, decoder, keep=0.5, seed=3))
    origins, directions = random_rays(6, 4)
    jitter = torch.rand(6, generator=torch.Generator().manual_seed(5))
    generator = torch.Generator().manual_seed(6)
    pull = [torch.randn(shape, generator=generator, dtype=torch.float64) for shape in ((6, 3), (6,), (6,))]
    weights = list(field.decoder.parameters())

    def loss(density: torch.Tensor, features: torch.Tensor, behind: torch.Tensor) -> torch.Tensor:
        seen = render_with_gradients(replace(field, density_rows=density, feature_rows=features), origins, directions, jitter, behind)
        extra = (seen.weight.square() * seen.samples.distance.double()).sum()
        return (seen.colour * pull[0]).sum() + (seen.distance * pull[1]).sum() + (seen.opacity * pull[2]).sum() + extra

    values = [field.density_rows.clone(), field.feature_rows.clone(), torch.rand((6, 3), generator=generator, dtype=torch.float64)]
    for value in values:
        value.requires_grad_()
    gradients = torch.autograd.grad(loss(*values), [*values, *weights])
    assert not gradients[0][-1] and not gradients[1][-1].any(), "nothing is ever read from the zero row"
    step = 1e-6
    for number, (value, gradient) in enumerate(zip([*values, *weights], gradients, strict=True)):
        largest = gradient.abs().reshape(-1).argsort(descending=True)[:4].tolist()
        for place in largest:
            change = []
            for sign in (1, -1):
                with torch.no_grad():
                    value.view(-1)[place] += sign * step
                    change.append(float(loss(*values)))
                    value.view(-1)[place] -= sign * step
            slope = (change[0] - change[1]) / (2 * step)
            assert slope == pytest.approx(float(gradient.view(-1)[place]), rel=1e-4, abs=1e-7), (number, place)


def test_lookup_gradient() -> None:
    generator = torch.Generator().manual_seed(0)
    rows = torch.randint(0, 12, (9, 8), generator=generator)
    weights = torch.rand((9, 8), generator=generator, dtype=torch.float64)
    for shape in ((12,), (12, 3)):
        values = torch.randn(shape, generator=generator, dtype=torch.float64, requires_grad=True)
        assert torch.autograd.gradcheck(lambda v: differentiable_gather(v, rows, weights), (values,))


def test_a_threshold_drops_only_colours_of_faint_samples() -> None:
    field = random_field(0.0, 32, keep=0.7, seed=1)
    origins, directions = random_rays(200, 2)
    field.density_rows.requires_grad_()
    exact = render_with_gradients(field, origins, directions)
    quick = render_with_gradients(field, origins, directions, threshold=1e-3)
    torch.testing.assert_close(quick.colour, exact.colour, atol=0.02, rtol=0)
    assert torch.equal(quick.weight, exact.weight)


def test_rays_that_meet_nothing_and_rays_of_solid_walls_have_finite_gradients() -> None:
    field = random_field(0.0, 32, keep=0.6, seed=1)
    density = (field.density_rows * 30).requires_grad_()  # from nothing at all to beyond the clamp
    features = field.feature_rows.clone().requires_grad_()
    field = replace(field, density_rows=density, feature_rows=features)
    origins, directions = random_rays(64, 3)
    directions[:8] = -directions[:8]
    seen = render_with_gradients(field, origins, directions)
    assert not seen.opacity[:8].any() and not seen.distance[:8].any()
    torch.testing.assert_close(seen.colour[:8], field.background.expand(8, 3))
    (seen.colour.sum() + seen.distance.sum() + seen.opacity.sum()).backward()
    assert density.grad is not None and features.grad is not None
    assert bool(torch.isfinite(density.grad).all()) and bool(torch.isfinite(features.grad).all())
    nothing = render_with_gradients(field, origins[:8], directions[:8])
    assert len(nothing.samples) == 0 and nothing.colour.shape == (8, 3)
    nothing.colour.sum().backward()
