"""Marching through contracted space, where a lattice ends at infinity: order, finiteness, and how well its steps cover a ray."""

from __future__ import annotations

from functools import cache

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from fieldfuse.render.march import MarchGrid, march
from fieldfuse.volume.space import Space
from fieldfuse.volume.topology import VOXELS
from tests.stability.hard.errors import absolute, largest, not_finite, relative
from tests.stability.hard.fields import lattice_grid, random_rays, unit
from tests.stability.hard.ranges import FEW
from tests.stability.hard.within import Within

GROUP = "rays with a background"


def contracted(point: Tensor, shell: float) -> Tensor:
    """(N, 3) float64 normalised points, contracted: y where max|y| ≤ 1, else (1 + b − b / n) · y / n."""
    size = point.abs().amax(1, keepdim=True).clamp_min(1)
    return point * ((1 + shell - shell / size) / size)


def background_errors(grid: MarchGrid, origins: Tensor, directions: Tensor, near: float = 0.0) -> dict[str, float]:
    """Samples of a full lattice with a shell, against where a float64 ray lies at their distances and how long it is there."""
    space = grid.space
    samples = march(grid, origins, directions, near)
    place = origins.double()[samples.ray] + samples.distance.double()[:, None] * directions.double()[samples.ray]
    lattice = (contracted(place / space.half, space.shell) + space.extent) / grid.voxel
    slot, local = samples.cell // VOXELS, samples.cell % VOXELS
    corner = grid.topology.keys[slot].long() * 8 + torch.stack([local % 8, local // 8 % 8, local // 64], 1)
    told = corner + samples.inside.double()
    same = samples.ray[1:] == samples.ray[:-1]
    covered = torch.zeros(len(origins), dtype=torch.float64).index_add_(0, samples.ray, samples.length.double())
    return {
        "sample's voxel against its distance, in voxels": float((told - lattice).abs().amax(1).max()),
        "widest gap between samples, in voxels": float((told[1:] - told[:-1])[same].norm(dim=1).max()),
        "samples out of order": float((samples.distance[1:] < samples.distance[:-1])[same].sum()),
        "samples of empty voxels": float((~grid.occupied[samples.cell]).sum()),
        "length along the ray, relative": relative(covered, _lengths(grid, origins, directions, near), 0.1),
        "values that are not finite": not_finite(samples.distance, samples.length, samples.inside),
        "lengths that are not positive": float((samples.length <= 0).sum()),
    }


def _lengths(grid: MarchGrid, origins: Tensor, directions: Tensor, near: float) -> Tensor:
    """(B,) contracted length of each ray from `near` to infinity: a polyline through 200,000 points, closer where it bends."""
    space = grid.space
    share = torch.linspace(0, 1, 200_001, dtype=torch.float64)[:-1]
    scale = space.half * (1 + float((origins.double() / space.half).norm(dim=1).max()))
    distance = near + scale * share / (1 - share)
    out = []
    for origin, direction in zip(origins.double(), directions.double(), strict=True):
        line = contracted((origin + distance[:, None] * direction) / space.half, space.shell)
        out.append(line.diff(dim=0).norm(dim=1).sum())
    return torch.stack(out)


BOUNDS = {
    "sample's voxel against its distance, in voxels": 1.0,
    "widest gap between samples, in voxels": 2.0,
    "samples out of order": 0.0,
    "samples of empty voxels": 0.0,
    "length along the ray, relative": 0.03,
    "values that are not finite": 0.0,
    "lengths that are not positive": 0.0,
}


@cache
def _grid() -> MarchGrid:
    return lattice_grid(256, 1.0, shell=1.0)


def background_grid(half: float = 1.0) -> MarchGrid:
    """A full lattice in a region of this half size."""
    _grid().space = Space((0.0, 0.0, 0.0), half, 1.0)
    return _grid()


def from_both_sides() -> dict[str, float]:
    rays = zip(random_rays(12, 3), random_rays(12, 4, away=0.4), strict=True)
    return background_errors(background_grid(), *(torch.cat(pair) for pair in rays))


def along_axes() -> dict[str, float]:
    directions = unit(torch.tensor([[1.0, 0, 0], [0, -1.0, 0], [0, 0, 1.0], [1.0, 1.0, 0], [-1.0, 1.0, 1.0], [1.0, 1e-9, -1e-20]]))
    return background_errors(background_grid(), torch.cat([torch.zeros(6, 3), 0.9 * directions, -3 * directions]), directions.repeat(3, 1))


def in_a_shell(shell: float, half: float) -> dict[str, float]:
    origins, directions = random_rays(8, 7, away=0.5)
    return background_errors(lattice_grid(256, 1.0, 1, half, shell), origins * half, directions, 0.05 * half)


CASES = {
    "from inside and from outside the region": from_both_sides,
    "along axes and diagonals, away from the region": along_axes,
    "thin and thick shells, small and large regions": lambda: largest(in_a_shell(*of) for of in ((0.5, 1e-3), (1.0, 1e4), (2.0, 5.0))),
}


@pytest.mark.parametrize("case", CASES)
def test_rays(case: str, within: Within) -> None:
    """Samples lie where rays pass."""
    within.each(CASES[case](), others=BOUNDS)


def test_far_start(within: Within) -> None:
    """Starting 5 and 10 half sizes away."""
    grid = background_grid()
    for away in (5.0, 10.0):
        origins, directions = random_rays(10, 8, away)
        samples = march(grid, origins, directions)
        crossing = torch.zeros(10, dtype=torch.int64).index_add_(0, samples.ray, (samples.distance - away).abs().lt(1).long())
        within(f"rays from {away:g} away without a sample near the region", float((crossing == 0).sum()), 0.0)
        within(f"not finite from {away:g} away", not_finite(samples.distance, samples.length, samples.inside), 0.0)


def test_contraction(within: Within) -> None:
    """Contraction and its inverse, and gradients at its seams."""
    generator = torch.Generator().manual_seed(0)
    for shell in (0.25, 1.0, 3.0):
        space = Space((0.0, 0.0, 0.0), 1.0, shell)
        size = 10 ** (torch.rand(4000, 1, generator=generator, dtype=torch.float64) * 8 - 4)
        points = unit(torch.randn(4000, 3, generator=generator)).double() * size
        wanted = contracted(points, shell)
        got = space.contract(points.float())
        near = points.abs().amax(1) < 100
        within(f"contracted, shell {shell:g}", absolute(got, wanted), 1e-6 * (1 + shell))
        back = space.expand(space.contract(points[near]))
        away = (back - points[near]).abs().amax(1) / points[near].abs().amax(1)
        within(f"there and back within 100 half sizes, shell {shell:g}, relative", float(away.max()), 1e-9)
        within(f"outside the lattice, shell {shell:g}", float((got.abs().amax(1) - 1 - shell).clamp_min(0).max()), 0.0)
        seams = torch.tensor([[1.0, 1.0, 1.0], [1.0, -1.0, 0], [1.0, 0, 0], [0, 0, 0], [1e-30, 0, 0], [3e38, 1, 1]], requires_grad=True)
        space.contract(seams).sum().backward()
        assert seams.grad is not None
        within(f"gradients at seams that are not finite, shell {shell:g}", not_finite(seams.grad), 0.0)
        inner = torch.tensor([[0.2, -0.7, 0.99]], dtype=torch.float64, requires_grad=True)
        outer = torch.tensor([[1.7, -0.4, 0.3], [-9.0, 2.0, 40.0]], dtype=torch.float64, requires_grad=True)
        good = all(torch.autograd.gradcheck(space.contract, (leaf,), raise_exception=False) for leaf in (inner, outer))
        within(f"gradcheck failures, shell {shell:g}", float(not good), 0.0)


@FEW
@given(st.floats(0.05, 6), st.integers(0, 1000), st.floats(-3, 3))
def test_marching_beyond_the_region(away: float, seed: int, power: float) -> None:
    half = 10.0**power
    origins, directions = random_rays(4, seed, away)
    errors = background_errors(background_grid(half), origins * half, directions, 0.01 * half)
    for name, bound in BOUNDS.items():
        assert errors[name] <= bound, (name, errors[name])
