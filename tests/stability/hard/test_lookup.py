"""Trilinear lookup: on lattice points, across block borders, beside absent blocks; its transpose; lower precision."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from fieldfuse.volume.lookup import corners, gather, scatter
from fieldfuse.volume.topology import VOXELS, Topology
from tests.stability.hard import reference
from tests.stability.hard.errors import absolute, by_size, not_finite
from tests.stability.hard.fields import lattice, scattered_blocks
from tests.stability.hard.ranges import KEYS, QUICK
from tests.stability.hard.within import Within

GROUP = "lookup"
VALUE = 1e-6
ABSENT = 1e-4  # thousands of terms of both signs, and nobody uses the sum
BOUNDS = {"values that are not finite": 0.0, "gradient of all that is absent": ABSENT}


def random_places(topology: Topology, count: int, seed: int) -> tuple[Tensor, Tensor]:
    """(N,) voxel rows and (N, 3) places in them; a third lie exactly on corners, edges or faces."""
    generator = torch.Generator().manual_seed(seed)
    cell = torch.randint(0, topology.zero_row, (count,), generator=generator)
    inside = torch.rand(count, 3, generator=generator)
    exact = torch.rand(count, 3, generator=generator) < 0.3
    return cell, torch.where(exact, inside.round(), inside)


def lookup_errors(topology: Topology, cell: Tensor, inside: Tensor, values: Tensor) -> dict[str, float]:
    """Errors of `gather`, its autograd gradient and `scatter` against dictionaries of lattice points; absent corners are zero."""
    places = [tuple(place) for place in lattice(topology).tolist()]
    at = {place: row for row, place in enumerate(places)}
    stored = values.double().tolist()
    cells, where = [places[row] for row in cell.tolist()], inside.double().tolist()
    exact = [reference.trilinear(lambda c: stored[at[c]] if c in at else 0.0, c, tuple(p)) for c, p in zip(cells, where, strict=True)]
    pull = torch.randn(len(cell), generator=torch.Generator().manual_seed(1))
    sums = [0.0] * len(stored)
    for c, p, g in zip(cells, where, pull.double().tolist(), strict=True):
        for index in range(8):
            dx, dy, dz = index & 1, index >> 1 & 1, index >> 2
            row = at.get((c[0] + dx, c[1] + dy, c[2] + dz), len(stored) - 1)
            weight = math.prod(p[axis] if step else 1 - p[axis] for axis, step in enumerate((dx, dy, dz)))
            sums[row] += weight * g
    rows, weights = corners(topology, cell, inside)
    leaf = values.clone().requires_grad_(True)
    got = gather(leaf, rows, weights)
    (got * pull).sum().backward()
    wide = torch.stack([values, 2 * values], 1).requires_grad_(True)
    got_wide = gather(wide, rows, weights)
    touched, (share, share_wide) = scatter(rows, weights, (pull, torch.stack([pull, -pull], 1)))
    full = torch.zeros(len(values)).index_add_(0, touched, share)
    full_wide = torch.zeros(len(values), 2).index_add_(0, touched, share_wide)
    assert leaf.grad is not None
    return {
        "value": by_size(got, exact),
        "value of several channels": by_size(got_wide[:, 1], [2 * value for value in exact]),
        "weights that do not sum to 1": absolute(weights.double().sum(1), torch.ones(len(cell))),
        "gradient by autograd": by_size(leaf.grad[:-1], sums[:-1]),
        "gradient by hand": by_size(full[:-1], sums[:-1]),
        "gradient by hand, several channels": by_size(full_wide[:-1], torch.tensor([sums, [-g for g in sums]], dtype=torch.float64).T[:-1]),
        "gradient of all that is absent": by_size(full[-1:], sums[-1:]),
        "values that are not finite": not_finite(got, leaf.grad, full, full_wide),
    }


def _rows(topology: Topology, slope: Tensor) -> Tensor:
    """(M · 512 + 1,) float32 values that rise by `slope` (3,) along the axes, and the zero row."""
    return torch.cat([(lattice(topology).double() @ slope).float(), torch.zeros(1)])


def test_random_lookup(within: Within) -> None:
    """Random places, absent neighbours read as zero."""
    topology = scattered_blocks(12, 3)
    values = torch.cat([torch.randn(topology.zero_row), torch.zeros(1)])
    within.each(lookup_errors(topology, *random_places(topology, 1500, 4), values), VALUE, BOUNDS)


def test_lonely_block(within: Within) -> None:
    """One block alone in the world."""
    topology = Topology(torch.tensor([[-(2**31) + 1, 2**31 - 2, 0]]))
    values = torch.cat([torch.randn(topology.zero_row), torch.zeros(1)])
    rows, _ = corners(topology, torch.arange(VOXELS), torch.full((VOXELS, 3), 0.5))
    at_far_side = rows[-1, 1:]  # the last voxel: all but its own corner lie in absent blocks
    moved = Topology(torch.zeros((1, 3), dtype=torch.int64))
    same = absolute(rows.double(), corners(moved, torch.arange(VOXELS), torch.full((VOXELS, 3), 0.5))[0].double())
    within("corners of absent blocks that are not the zero row", float((at_far_side != topology.zero_row).sum()), 0.0)
    within("rows that depend on where the block lies", same, 0.0)
    within.each(lookup_errors(moved, *random_places(moved, 600, 5), values), VALUE, BOUNDS)


def test_linear_fields(within: Within) -> None:
    """Linear fields across block borders."""
    topology = Topology(torch.stack(torch.meshgrid(*[torch.arange(-2, 2)] * 3, indexing="ij"), -1).view(-1, 3))
    cell, inside = random_places(topology, 20_000, 6)
    places = lattice(topology)[cell]
    known = (places < 15).all(1)  # the last layer's upper corners have no block
    cell, inside, places = cell[known], inside[known], places[known]
    worst = 0.0
    for slope in ([1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0], [0.3, -2.0, 0.7], [1e-6, 1e-6, 1e-6], [1e4, -1e4, 3e3]):
        direction = torch.tensor(slope, dtype=torch.float64)
        values = _rows(topology, direction)
        got = gather(values, *corners(topology, cell, inside))
        worst = max(worst, by_size(got, (places + inside.double()) @ direction))
    within("linear field, by its largest value", worst, VALUE)


def test_many_into_one(within: Within) -> None:
    """100,000 gradients into one row."""
    topology = Topology(torch.zeros((1, 3), dtype=torch.int64))
    count = 100_000
    cell = torch.full((count,), 5 * 73)
    inside = torch.rand(count, 3)
    pull = torch.randn(count) + 3
    rows, weights = corners(topology, cell, inside)
    touched, (share,) = scatter(rows, weights, (pull,))
    exact = torch.zeros(topology.zero_row + 1, dtype=torch.float64)
    exact.index_add_(0, rows.reshape(-1).long(), (weights.double() * pull.double()[:, None]).reshape(-1))
    again, (same,) = scatter(rows, weights, (pull,))
    within("sums of 100,000 terms", by_size(share, exact[touched]), 2e-5)
    within("difference between two runs", absolute(same, share) + absolute(again, touched), 0.0)
    within("rows touched, beyond 8", float(len(touched) - 8), 0.0)


@QUICK
@given(st.lists(KEYS, min_size=1, max_size=8, unique=True), st.integers(0, 1000))
def test_lookup(keys: list[tuple[int, int, int]], seed: int) -> None:
    topology = Topology(torch.tensor(keys))
    values = torch.cat([torch.randn(topology.zero_row, generator=torch.Generator().manual_seed(seed)), torch.zeros(1)])
    errors = lookup_errors(topology, *random_places(topology, 60, seed), values)
    for name, error in errors.items():
        assert error <= (0 if "finite" in name else ABSENT if "absent" in name else VALUE), (name, error)


def test_on_lattice(within: Within) -> None:
    """Exactly on lattice points, from every voxel that touches them."""
    topology = Topology(torch.stack(torch.meshgrid(*[torch.arange(-1, 1)] * 3, indexing="ij"), -1).view(-1, 3))
    values = torch.cat([torch.randn(topology.zero_row), torch.zeros(1)])
    places = lattice(topology)
    inner = ((places > -8) & (places < 7)).all(1).nonzero().squeeze(1)
    worst = 0.0
    for index in range(8):
        step = torch.tensor([index & 1, index >> 1 & 1, index >> 2])
        below = places[inner] - step
        local = below & 7
        cell = topology.find(below >> 3) * VOXELS + (local[:, 2] * 8 + local[:, 1]) * 8 + local[:, 0]
        got = gather(values, *corners(topology, cell, step.float().expand(len(cell), 3)))
        worst = max(worst, absolute(got, values[inner]))
    within("stored value, read from eight sides", worst, 0.0)


def test_continuity(within: Within) -> None:
    """Continuity where two voxels meet."""
    topology = Topology(torch.stack(torch.meshgrid(*[torch.arange(-1, 1)] * 3, indexing="ij"), -1).view(-1, 3))
    values = torch.cat([torch.randn(topology.zero_row), torch.zeros(1)])
    places = lattice(topology)
    worst, slope = 0.0, 0.0
    for axis in range(3):
        here = (places[:, axis] < 6).nonzero().squeeze(1)
        following = places[here].clone()
        following[:, axis] += 1
        local = following & 7
        there = topology.find(following >> 3) * VOXELS + (local[:, 2] * 8 + local[:, 1]) * 8 + local[:, 0]
        inside = torch.rand(len(here), 3)
        for back in (0.0, 1e-4):
            first, second = inside.clone(), inside.clone()
            first[:, axis], second[:, axis] = 1 - back, back
            a, b = gather(values, *corners(topology, here, first)), gather(values, *corners(topology, there, second))
            if back == 0:
                worst = max(worst, absolute(a, b))
            else:
                slope = max(slope, absolute(a, b))
    within("jump at the border", worst, VALUE)
    within("change over 2e-4 of a voxel", slope, 2e-3)


def test_double_gradcheck(within: Within) -> None:
    """Gradcheck in double."""
    topology = scattered_blocks(2, 9, 1)
    cell, inside = random_places(topology, 6, 2)
    rows, weights = corners(topology, cell, inside.double())
    used, index = torch.unique(rows, return_inverse=True)
    small = torch.randn(len(used), 2, dtype=torch.float64, requires_grad=True)
    flat = torch.randn(len(used), dtype=torch.float64, requires_grad=True)
    good = torch.autograd.gradcheck(lambda v: gather(v, index.int(), weights), (small,), raise_exception=False)
    good &= torch.autograd.gradcheck(lambda v: gather(v, index, weights), (flat,), raise_exception=False)
    within("gradcheck failures", float(not good), 0.0)


def test_half_values(within: Within) -> None:
    """Values in bfloat16 and float16, and under autocast."""
    topology = scattered_blocks(8, 5)
    cell, inside = random_places(topology, 2000, 8)
    rows, weights = corners(topology, cell, inside)
    for kind in (torch.bfloat16, torch.float16):
        values = torch.cat([torch.randn(topology.zero_row), torch.zeros(1)]).to(kind)
        exact = gather(values.double(), rows, weights.double())
        name = str(kind).removeprefix("torch.")
        with torch.autocast("cpu", dtype=kind):
            mixed = gather(values.float(), rows, weights)
            _, (share,) = scatter(rows, weights, (torch.ones(len(cell)),))
        _, (plain,) = scatter(rows, weights, (torch.ones(len(cell)),))
        within(f"values stored in {name}", by_size(gather(values, rows, weights), exact), 4 * float(torch.finfo(kind).eps))
        within(f"values under {name} autocast", by_size(mixed, exact), VALUE)
        within(f"gradients under {name} autocast", absolute(share, plain), 0.0)


def test_a_wrong_corner_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = corners
    monkeypatch.setitem(globals(), "corners", lambda *given: (plain(*given)[0].roll(1, 1), plain(*given)[1]))
    test_linear_fields(within := Within())
    assert within.missed
