"""Two engines, one field: torch and the compiled one against sums written out and each other; gradients: `tests/training`."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from fieldfuse.render.field import Field, density
from fieldfuse.render.numba_renderer import NumbaRenderer
from fieldfuse.render.rays import render_rays
from tests.stability.hard import reference
from tests.stability.hard.errors import not_finite
from tests.stability.hard.fields import aimed_rays, small_field
from tests.stability.hard.within import Within

GROUP = "engines"
OPACITY = 1e-6


def both(field: Field, origins: Tensor, directions: Tensor, threshold: float) -> dict[str, Tensor]:
    """(B, 5) colour, distance and opacity by each engine."""
    slow = render_rays(field, origins, directions, threshold)
    renderer = NumbaRenderer(field, 1)
    renderer.threshold = threshold
    fast = renderer.render(origins, directions)
    return {"torch": torch.cat([slow.colour, slow.distance[:, None], slow.opacity[:, None]], 1), "compiled": fast}


def even(thickness: float, resolution: int = 128) -> tuple[Field, Tensor, Tensor]:
    """A full lattice in which each sample of a ray along x has this optical thickness, and such a ray."""
    field = small_field(0, 1.0, resolution)
    unit = float(density(torch.zeros(1)).double())
    raw = math.log(thickness / (unit * 2 / resolution))
    origin = torch.tensor([[-3.0, -0.15, 0.33]])
    return replace(field, density_rows=torch.full_like(field.density_rows, raw)), origin, torch.tensor([[1.0, 0.0, 0.0]])


def test_haze_to_solid(within: Within) -> None:
    """Haze to solid: opacity of a ray through 128 even samples."""
    for thickness in (1e-9, 1e-6, 1e-4, 1e-2, 1.0, 30.0):
        field, origin, direction = even(thickness)
        exact = 1 - reference.composite([thickness] * 128)[2]
        for name, values in both(field, origin, direction, 0.0).items():
            # The compiled engine ends a ray where a ten-thousandth of the light is left.
            bound = OPACITY if exact < 0.999 else 2e-4
            within(f"{name}, τ = {thickness:g} a sample", abs(float(values[0, 4]) - exact), bound)


def test_clamped(within: Within) -> None:
    """Densities at and beyond the clamp, empty and solid side by side."""
    field = small_field(7, 0.5)
    raw = torch.where(torch.rand(len(field.density_rows)) < 0.5, 1e30, -1e30)
    raw[-1] = 0
    origins, directions = aimed_rays(400, 2)
    values = both(replace(field, density_rows=raw), origins, directions, 1e-3)
    colour = (values["torch"][:, :3] - values["compiled"][:, :3]).abs().amax(1)
    opacity = (values["torch"][:, 4] - values["compiled"][:, 4]).abs()
    within("values that are not finite", not_finite(*values.values()), 0.0)
    within("colours outside [0, 1]", float(sum(((v[:, :3] < 0) | (v[:, :3] > 1)).sum() for v in values.values())), 0.0)
    # A sample that float32 puts on the other side of a voxel's border changes its ray, and only it.
    within("colours of the two engines apart, 95% of rays", float(colour.quantile(0.95)), 1e-3)
    within("opacities of the two engines apart, 95% of rays", float(opacity.quantile(0.95)), 1e-3)


def test_nothing(within: Within) -> None:
    """Nothing to see: no rays, rays that miss, a field without voxels."""
    field = small_field(1)
    origins, directions = aimed_rays(20, 5)
    empty = replace(field, occupied=torch.zeros_like(field.occupied)).packed()()
    for what, seen, ways in (("missing", field, -directions), ("no voxels", empty, directions)):
        for name, values in both(seen, origins, ways, 1e-3).items():
            apart = float((values[:, :3] - field.background).abs().max())
            within(f"{name}, {what}: not the background", apart + float(values[:, 3:].abs().max()), 1e-6)
    none = both(field, origins[:0], directions[:0], 1e-3)
    within("pictures of no rays", float(sum(len(values) for values in none.values())), 0.0)
