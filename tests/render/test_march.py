"""Marching: every occupied voxel on a ray is visited, none twice as often, inside and beyond the region."""

from __future__ import annotations

import pytest
import torch

from fieldfuse.render.march import march
from tests.render.made import random_field, random_rays


@pytest.mark.parametrize("keep", [1.0, 0.05])
def test_samples_are_those_of_a_dense_walk(keep: float) -> None:
    """Without contraction the lattice is uniform: the sum of lengths in occupied voxels equals a fine dense walk's."""
    field = random_field(keep=keep)
    origins, directions = random_rays(64)
    samples = march(field.grid, origins, directions, fine=8)
    measured = torch.zeros(64).index_add_(0, samples.ray, samples.length)
    step = 2e-3
    distance = torch.arange(0, 7, step)
    points = origins[:, None] + directions[:, None] * distance[None, :, None]
    contracted = field.space.contract(field.space.normalise(points)).reshape(-1, 3)
    within = (contracted.abs() <= 1).all(1)
    row, _ = field.grid.voxels(contracted)
    dense = ((row >= 0) & within).view(64, -1).sum(1) * (step / field.space.half)
    assert float(measured.sum()) > 10 * keep
    tolerance = 0.05 if keep == 1 else 0.35  # isolated voxels are hit or missed by whole samples
    assert torch.allclose(measured, dense, atol=tolerance)
    assert float(measured.sum()) == pytest.approx(float(dense.sum()), rel=0.03)


@pytest.mark.parametrize("shell", [0.0, 1.0])
def test_samples_lie_where_they_say(shell: float) -> None:
    field = random_field(background=shell, resolution=128, keep=0.2)
    origins, directions = random_rays(32)
    samples = march(field.grid, origins, directions)
    points = origins[samples.ray] + directions[samples.ray] * samples.distance[:, None]
    contracted = field.space.contract(field.space.normalise(points))
    lattice = (contracted + field.space.extent) / field.grid.voxel
    slot, local = samples.cell // 512, samples.cell % 512
    corner = field.topology.keys[slot].long() * 8 + torch.stack([local % 8, local // 8 % 8, local // 64], 1)
    assert ((lattice - (corner + samples.inside)).abs().amax(1) < 0.5).float().mean() > 0.99
    assert bool(field.occupied[samples.cell].all())
    same = samples.ray[1:] == samples.ray[:-1]
    assert bool((samples.distance[1:] > samples.distance[:-1])[same].all())
    assert bool((samples.ray[samples.first] == samples.ray).all())


def test_contracted_rays_reach_far_beyond_the_region() -> None:
    field = random_field(background=1.0, resolution=64)
    origins, directions = random_rays(16)
    samples = march(field.grid, origins, directions)
    reached = torch.zeros(16).scatter_reduce_(0, samples.ray, samples.distance, "amax")
    assert bool((reached > 10 * field.space.half).all())
    assert bool(torch.isfinite(samples.length).all()) and bool((samples.length > 0).all())


@pytest.mark.parametrize("direction", [[1.0, 0, 0], [0, -1.0, 0], [0, 0, 1.0], [0.70710678, 0.70710678, 0]])
def test_axis_parallel_rays_and_rays_that_miss(direction: list[float]) -> None:
    field = random_field()
    d = torch.tensor([direction])
    hit = march(field.grid, -3 * d, d)
    assert len(hit) > 10
    assert len(march(field.grid, 3 * d, d)) == 0
    assert (
        len(march(field.grid, -3 * d + torch.tensor([[0, 0, 50.0]]), d * torch.tensor([1.0, 1.0, 0.0]) + torch.tensor([[0.0, 0, 1e-9]])))
        == 0
    )


def test_jitter_moves_samples_by_less_than_a_step() -> None:
    field = random_field()
    origins, directions = random_rays(8)
    still = march(field.grid, origins, directions, jitter=torch.zeros(8))
    moved = march(field.grid, origins, directions, jitter=torch.full((8,), 0.99))
    assert abs(len(still) - len(moved)) <= 16
    assert not torch.equal(still.distance[:50], moved.distance[:50])
