"""Marching: every occupied voxel on a ray is visited, none twice as often, inside and beyond the region."""

from __future__ import annotations

import pytest
import torch

from fieldfuse.render.march import march
from tests.render.made import random_field, random_rays


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


def test_jitter_moves_samples_by_less_than_a_step() -> None:
    field = random_field()
    origins, directions = random_rays(8)
    still = march(field.grid, origins, directions, jitter=torch.zeros(8))
    moved = march(field.grid, origins, directions, jitter=torch.full((8,), 0.99))
    assert abs(len(still) - len(moved)) <= 16
    assert not torch.equal(still.distance[:50], moved.distance[:50])
