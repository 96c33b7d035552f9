"""Coarse to fine: cells, splitting, adopting, children; and the store against the functional volumes."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldfuse.nerfusion.extras.two_lattices import INHERITED, adopt, allowed_cells, solid_cells, split_volume
from fieldfuse.nerfusion.lattice import LatentVolume, cells, empty_volume, part
from fieldfuse.nerfusion.store import GlobalStore
from fieldfuse.volume.lookup import corners, gather
from fieldfuse.volume.topology import VOXELS, Topology
from tests.nerfusion.made import lattice


def volume(seed: int, share: float = 0.7, blocks: float = 0.5, channels: int = 3) -> LatentVolume:
    """Random latents at random corners of random blocks."""
    generator = torch.Generator().manual_seed(seed)
    line = torch.arange(3)
    keys = torch.stack(torch.meshgrid(line, line, line, indexing="ij"), -1).view(-1, 3)
    kept = torch.randperm(27, generator=generator)[: max(int(27 * blocks), 1)]
    topology = Topology(keys[kept])
    count = (torch.rand(topology.zero_row, generator=generator) < share).float() * 3
    rows = torch.tanh(torch.randn((topology.zero_row + 1, channels), generator=generator))
    rows[:-1] *= (count > 0)[:, None]
    rows[-1] = 0
    return LatentVolume(lattice(24), topology, rows, count)


def corner_value(topology: Topology, mask: torch.Tensor, place: tuple[int, int, int]) -> bool:
    x, y, z = place
    slot = int(topology.find(torch.tensor([x >> 3, y >> 3, z >> 3])))
    return slot >= 0 and bool(mask[slot * VOXELS + ((z & 7) * 8 + (y & 7)) * 8 + (x & 7)])


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([0.3, 0.9]), st.booleans())
def test_cells_by_the_definition(seed: int, share: float, every: bool) -> None:
    made = volume(seed, share)
    found = cells(made.topology, made.known, every)
    generator = torch.Generator().manual_seed(seed)
    for row in torch.randint(len(found), (40,), generator=generator).tolist():
        key, local = made.topology.keys[row // VOXELS].tolist(), row % VOXELS
        x, y, z = key[0] * 8 + (local & 7), key[1] * 8 + (local >> 3 & 7), key[2] * 8 + (local >> 6)
        around = [corner_value(made.topology, made.known, (x + i, y + j, z + k)) for i in (0, 1) for j in (0, 1) for k in (0, 1)]
        assert bool(found[row]) == (all(around) if every else any(around))


def test_pruning_keeps_what_any_point_of_a_cell_makes_solid() -> None:
    made = volume(0, 1.0, 1.0)
    gamma = 0.6
    thickness = torch.randn(len(made.rows), generator=torch.Generator().manual_seed(1)) + math.log(-math.log(gamma)) - 1.5
    kept = solid_cells(made, thickness, gamma)
    whole = solid_cells(made, thickness, None)
    assert 0 < int(kept.sum()) < int(whole.sum())
    rows = whole.nonzero().view(-1)
    inside = torch.rand((40, 3), generator=torch.Generator().manual_seed(2))
    inside[:8] = torch.tensor([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]).float()
    least = torch.ones(len(rows))
    for place in inside:
        value = gather(thickness, *corners(made.topology, rows, place.expand(len(rows), 3)))
        least = torch.minimum(least, torch.exp(-torch.exp(value)))
    assert torch.equal(kept[rows], least <= gamma), "the paper's rule: min over points of exp(−τ) > γ is pruned"


def test_splitting_keeps_the_function_inside_what_is_kept() -> None:
    made = volume(3, 0.95, 1.0)
    kept = solid_cells(made, torch.zeros(len(made.rows)), None) & (torch.rand(len(made.count)) < 0.3)
    finer = split_volume(made, kept)
    assert finer.lattice.resolution == 2 * made.lattice.resolution and float(finer.count.max()) == INHERITED
    cell = kept.nonzero().view(-1)[:50]
    assert int(cells(finer.topology, finer.known, every=True).sum()) >= 8 * int(kept.sum()), "every child has its corners"
    key, local = made.topology.keys[cell // VOXELS].long(), cell % VOXELS
    low = key * 8 + torch.stack([local & 7, local >> 3 & 7, local >> 6], 1)
    for place in ((0.2, 0.4, 0.3), (0.7, 0.9, 0.6)):
        inside = torch.tensor(place).expand(len(cell), 3)
        coarse = gather(made.rows, *corners(made.topology, cell, inside))
        fine = (low + inside) * 2
        whole = fine.floor().long()
        slot = finer.topology.find(whole >> 3)
        row = slot * VOXELS + ((whole[:, 2] & 7) * 8 + (whole[:, 1] & 7)) * 8 + (whole[:, 0] & 7)
        found = gather(finer.rows, *corners(finer.topology, row, fine - whole))
        torch.testing.assert_close(found, coarse, atol=1e-5, rtol=1e-4)


def test_cells_are_allowed_where_their_parents_are_solid_and_there() -> None:
    fine = Topology(torch.tensor([[0, 0, 0], [7, 7, 7], [1, 0, 1]]))
    coarse = LatentVolume(lattice(), Topology(torch.tensor([[0, 0, 0]])), torch.zeros(VOXELS + 1, 3), torch.zeros(VOXELS))
    for z, y, x in ((z, y, x) for z in (1, 2) for y in (2, 3) for x in (3, 4)):
        coarse.count[(z * 8 + y) * 8 + x] = 1  # the corners of one cell
    thickness = torch.zeros(VOXELS + 1)
    found = allowed_cells(coarse, thickness, 0.6, fine).view(3, 8, 8, 8)
    assert found.nonzero().tolist() == [[0, z, y, x] for z in (2, 3) for y in (4, 5) for x in (6, 7)]
    assert not allowed_cells(coarse, thickness - 9, 0.6, fine).any()


def test_adopting_changes_nothing_that_is_known() -> None:
    state, other = volume(1, 0.4), volume(2, 0.6)
    other = replace(other, count=other.count.clamp_max(1))
    both = adopt(state, other)
    old = len(state.count)
    assert torch.equal(both.rows[:old][state.known], state.rows[:-1][state.known])
    assert torch.equal(both.count[:old][state.known], state.count[state.known])
    place = (both.topology.find(other.topology.keys)[:, None] * VOXELS + torch.arange(VOXELS)).view(-1)
    before = torch.cat([state.known, torch.zeros(len(both.count) - old, dtype=torch.bool)])
    taken = other.known & ~before[place]
    assert int(taken.sum()) > 0 and torch.equal(both.rows[place][taken], other.rows[:-1][taken])
    assert int(both.known.sum()) == int(state.known.sum()) + int(taken.sum()) and not both.rows[-1].any()


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10**6))
def test_the_store_does_what_functional_volumes_do(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    store = GlobalStore(lattice(24), 3)
    expected = empty_volume(lattice(24), 3)
    for step in range(4):
        new = volume(seed + step, 0.5, 0.4)
        changed = new.known & (torch.rand(len(new.count), generator=generator) < 0.8)
        only = replace(new, rows=new.rows * torch.cat([changed, changed.new_zeros(1)])[:, None], count=new.count * changed)
        store.write(new, changed)
        blank = part(expected, only.topology)
        here = replace(
            blank,
            rows=torch.where(torch.cat([changed, changed.new_zeros(1)])[:, None], only.rows, blank.rows),
            count=torch.where(changed, only.count, blank.count),
        )
        rest = expected.topology.keys[here.topology.find(expected.topology.keys) < 0]
        keys = torch.cat([rest, here.topology.keys])
        expected = adopt(part(here, Topology(keys)), part(expected, Topology(keys)))
        if step == 2:
            keep = torch.rand(store.topology.blocks, generator=generator) < 0.7
            kept = store.topology.keys[keep]
            store.keep(keep)
            expected = part(expected, Topology(kept))
        found = part(store.volume(), expected.topology)
        assert store.topology.blocks == expected.topology.blocks
        assert torch.equal(found.rows, expected.rows) and torch.equal(found.count, expected.count)
        assert not store.volume().rows[-1].any()


def test_an_empty_store() -> None:
    store = GlobalStore(lattice(24), 3)
    asked = store.part(Topology(torch.tensor([[1, 1, 1]])))
    assert not asked.count.any() and not asked.rows.any() and len(asked.rows) == VOXELS + 1
    assert store.volume().topology.blocks == 1 and not store.volume().rows.any()
