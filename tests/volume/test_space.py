"""Contraction and lookup."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldfuse.volume.lookup import corners, gather, scatter
from fieldfuse.volume.space import Space
from tests.render.made import random_field


@given(st.lists(st.floats(-500, 500, width=32), min_size=3, max_size=3), st.floats(0.25, 2))
@settings(deadline=None)
def test_contraction_stays_inside_and_turns_back(point: list[float], shell: float) -> None:
    space = Space((0.0, 0.0, 0.0), 1.0, shell)
    points = torch.tensor([point], dtype=torch.float64)
    contracted = space.contract(points)
    assert float(contracted.abs().max()) < space.extent + 1e-9
    assert torch.allclose(space.expand(contracted), points, rtol=1e-6, atol=1e-9)


def test_inside_nothing_moves() -> None:
    points = torch.rand(100, 3) * 2 - 1
    assert torch.equal(Space((0.0, 0.0, 0.0), 2.0, 1.0).contract(points), points)


def test_lookup_reproduces_linear_functions_across_blocks() -> None:
    field = random_field(resolution=32)
    rows = torch.arange(len(field.occupied))
    slot, local = rows // 512, rows % 512
    place = field.topology.keys[slot].long() * 8 + torch.stack([local % 8, local // 8 % 8, local // 64], 1)
    values = torch.cat([place.float(), torch.zeros(1, 3)])
    cell = field.occupied.nonzero().squeeze(1)
    inside = torch.rand(len(cell), 3)
    found = gather(values, *corners(field.topology, cell, inside))
    assert torch.allclose(found, place[cell] + inside, atol=1e-4)


@pytest.mark.parametrize("channels", [0, 5])
def test_scatter_is_the_transpose_of_gather(channels: int) -> None:
    field = random_field(resolution=32, keep=0.1)
    size = len(field.density_rows)
    generator = torch.Generator().manual_seed(3)
    cell = field.occupied.nonzero().squeeze(1)
    cell = cell[torch.randint(len(cell), (500,), generator=generator)]
    rows, weights = corners(field.topology, cell, torch.rand(500, 3, generator=generator))
    values = torch.randn((size, channels) if channels else (size,), generator=generator, dtype=torch.float32).requires_grad_(True)
    gradient = torch.randn((500, channels) if channels else (500,), generator=generator)
    (gather(values, rows, weights) * gradient).sum().backward()
    touched, (share,) = scatter(rows, weights, (gradient,))
    full = torch.zeros_like(values)
    full[touched] = share
    assert values.grad is not None
    assert torch.allclose(full, values.grad, atol=1e-5)
