"""Editing voxel sets, each against a dictionary of lattice points or an analytic function."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldfuse.volume.edit import corner_nodes, dilate, erase_empty_blocks, pooled_in_torch, resample, split, with_corner_blocks
from fieldfuse.volume.lookup import corners, gather
from fieldfuse.volume.topology import VOXELS, Topology

Place = tuple[int, int, int]


def places(topology: Topology) -> torch.Tensor:
    """(M · 512, 3) lattice coordinates of every row."""
    line = torch.arange(8)
    z, y, x = torch.meshgrid(line, line, line, indexing="ij")
    inner = torch.stack([x, y, z], -1).view(1, VOXELS, 3)
    return (topology.keys.long()[:, None] * 8 + inner).view(-1, 3)


def as_set(topology: Topology, mask: torch.Tensor) -> set[Place]:
    return set(map(tuple, places(topology)[mask].tolist()))


def world(blocks: int, share: float, seed: int, spread: int = 3) -> tuple[Topology, torch.Tensor]:
    """Random blocks and occupied voxels, with the blocks that hold their corners."""
    generator = torch.Generator().manual_seed(seed)
    cells = torch.randperm(spread**3, generator=generator)[:blocks]
    keys = torch.stack([cells % spread - 1, cells // spread % spread - 1, cells // spread**2 - 2], 1)
    occupied = torch.rand(blocks * VOXELS, generator=generator) < share
    return with_corner_blocks(Topology(keys), occupied)


def lookup(topology: Topology, occupied: torch.Tensor, values: torch.Tensor, where: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Trilinear values at (N, 3) lattice places, and which of them lie in occupied voxels."""
    cell = where.floor().long()
    slot = topology.find(cell >> 3)
    local = cell & 7
    row = torch.where(slot < 0, 0, slot * VOXELS + (local[:, 2] * 8 + local[:, 1]) * 8 + local[:, 0])
    hit = (slot >= 0) & occupied[row]
    return gather(values, *corners(topology, row[hit], (where - cell)[hit].float())), hit


def cube_of(place: Place, low: int, high: int) -> set[Place]:
    x, y, z = place
    reach = range(low, high + 1)
    return {(x + i, y + j, z + k) for i in reach for j in reach for k in reach}


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10**6), st.integers(0, 4), st.sampled_from([0.0, 0.002, 0.05]))
def test_sets_against_dictionaries(seed: int, blocks: int, share: float) -> None:
    topology, occupied = world(blocks, share, seed)
    cells = as_set(topology, occupied)
    assert as_set(topology, corner_nodes(topology, occupied)) == {p for cell in cells for p in cube_of(cell, 0, 1)}
    assert torch.equal(pooled_in_torch(topology, occupied, 2), corner_nodes(topology, occupied))
    for steps in (0, 1, 2):
        grown_topology, grown = dilate(topology, occupied, steps)
        assert as_set(grown_topology, grown) == {p for cell in cells for p in cube_of(cell, -steps, steps)}
        assert torch.equal(grown_topology.keys[: topology.blocks], topology.keys)
        inside, kept = dilate(topology, occupied, steps, grow=False)
        assert steps != 1 or torch.equal(pooled_in_torch(topology, occupied, 3), kept)
        assert inside is topology and as_set(topology, kept) == as_set(grown_topology, grown) & set(map(tuple, places(topology).tolist()))


def test_dilating_adds_only_blocks_that_are_needed() -> None:
    occupied = torch.zeros(VOXELS, dtype=torch.bool)
    occupied[(3 * 8 + 0) * 8 + 7] = True  # (x 7, y 0, z 3): reaches +x, −y and the edge between them
    topology, _ = dilate(Topology(torch.tensor([[0, 0, 0]])), occupied)
    assert sorted(topology.keys.tolist()) == [[0, -1, 0], [0, 0, 0], [1, -1, 0], [1, 0, 0]]
    topology, _ = with_corner_blocks(Topology(torch.tensor([[0, 0, 0]])), occupied)
    assert sorted(topology.keys.tolist()) == [[0, 0, 0], [1, 0, 0]]


def test_erase_empty_blocks_keeps_values_and_corner_blocks() -> None:
    topology, occupied = world(4, 0.05, 3)
    empty = Topology(torch.cat([torch.tensor([[50, 0, 0]]), topology.keys.long(), torch.tensor([[-50, 0, 0]])]))
    padded = torch.cat([torch.zeros(VOXELS, dtype=torch.bool), occupied, torch.zeros(VOXELS, dtype=torch.bool)])
    values = torch.arange(float(len(padded) + 1))
    values[-1] = 0
    small, kept, (one, two) = erase_empty_blocks(empty, padded, [values, values[:, None].expand(-1, 3)])
    assert torch.equal(small.keys, topology.keys) and torch.equal(kept, occupied)
    used = corner_nodes(topology, occupied)
    assert torch.equal(one[:-1], torch.where(used, values[VOXELS : -1 - VOXELS], 0)) and float(one[-1]) == 0
    assert torch.equal(two, one[:, None].expand(-1, 3))


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([0.01, 0.2, 1.0]))
def test_trilinear_split_leaves_the_function_as_it_was(seed: int, share: float) -> None:
    topology, occupied = world(3, share, seed)
    generator = torch.Generator().manual_seed(seed)
    nodes = torch.cat([corner_nodes(topology, occupied), torch.tensor([False])])
    values = torch.where(nodes[:, None], torch.randn(len(nodes), 3, generator=generator), 1e9)  # never to be mixed in
    values[-1] = 0
    fine, fine_occupied, (new,) = split(topology, occupied, [values])
    children = {p for cell in as_set(topology, occupied) for p in cube_of(tuple(2 * c for c in cell), 0, 1)}
    assert as_set(fine, fine_occupied) == children
    assert float(new[-1].abs().sum()) == 0

    inside = places(topology)[occupied].double()
    inside = (inside + torch.rand(inside.shape, generator=generator, dtype=torch.float64)).repeat(3, 1)
    old_values, old_hit = lookup(topology, occupied, values, inside)
    new_values, new_hit = lookup(fine, fine_occupied, new, inside * 2)
    assert old_hit.all() and new_hit.all()
    torch.testing.assert_close(new_values, old_values, atol=2e-5, rtol=0)

    kept = nodes[:-1].nonzero().view(-1)  # coinciding corners: bit for bit
    slot = fine.find((places(topology)[kept] * 2) >> 3)
    local = (places(topology)[kept] * 2) & 7
    rows = slot * VOXELS + (local[:, 2] * 8 + local[:, 1]) * 8 + local[:, 0]
    assert bool((slot >= 0).all()) and torch.equal(new[rows], values[kept])


def test_borders_do_not_darken() -> None:
    topology, occupied = world(4, 0.03, 11)
    nodes = torch.cat([corner_nodes(topology, occupied), torch.tensor([False])])
    ones = nodes.float()
    for scale in (0.5, 2 / 3, 0.9, 1.0):
        new_topology = Topology(torch.tensor([[x, y, z] for x in range(-3, 6) for y in range(-3, 6) for z in range(-5, 4)]))
        (new,) = resample(topology, occupied, [ones], new_topology.keys, scale)
        assert set(new.unique().tolist()) <= {0.0, 1.0} or float((new[new > 0] - 1).abs().max()) < 1e-6
        # every corner of a fine voxel whose centre is in an occupied voxel has a value, also beyond the blocks that there were
        centre = (places(new_topology).double() + 0.5) * scale
        _, hit = lookup(topology, occupied, ones, centre)
        touched = torch.cat([corner_nodes(new_topology, hit), torch.tensor([False])])
        assert int(hit.sum()) > 0 and bool((new[touched] > 0.99).all())


@pytest.mark.parametrize("scale", [256 / 384, 0.5, 1.0, 1.5])
def test_resample_reproduces_a_trilinear_function(scale: float) -> None:
    generator = torch.Generator().manual_seed(4)
    keys = torch.tensor([[x, y, z] for x in range(-2, 3) for y in range(-2, 3) for z in range(-2, 3)])
    topology = Topology(keys[torch.randperm(len(keys), generator=generator)])
    occupied = (places(topology) < 23).all(1)
    linear = torch.tensor([0.3, -0.7, 1.1], dtype=torch.float64)
    values = torch.cat([places(topology).double() @ linear + 5, torch.zeros(1, dtype=torch.float64)])
    new_keys = torch.tensor([[0, 0, 0], [-1, 0, 0], [0, -1, -1]])
    one, several = resample(topology, occupied, [values, values[:, None] * torch.tensor([1.0, 2.0])], new_keys, scale)
    at = places(Topology(new_keys)).double() * scale
    torch.testing.assert_close(one[:-1], at @ linear + 5, atol=1e-5, rtol=0)
    torch.testing.assert_close(several[:, 1], 2 * one, atol=1e-9, rtol=0)


def test_nothing_in_nothing_out() -> None:
    empty = Topology(torch.zeros((0, 3), dtype=torch.int32))
    none = torch.zeros(0, dtype=torch.bool)
    topology, occupied, (values,) = split(empty, none, [torch.zeros(1, 3)])
    assert topology.blocks == 0 and len(occupied) == 0 and values.shape == (1, 3)
    assert dilate(empty, none, 2)[0].blocks == 0
    assert erase_empty_blocks(empty, none, [torch.zeros(1)])[0].blocks == 0
