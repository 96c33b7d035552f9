"""Topology against plain dictionaries, near zero and at the ends of int32."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldfuse.volume.topology import VOXELS, Topology

Key = tuple[int, int, int]
coordinate = st.integers(-3, 3)
place = st.tuples(coordinate, coordinate, coordinate)
key_lists = st.lists(place, max_size=12, unique=True)
shifts = st.sampled_from([0, -(2**31) + 3, 2**31 - 4])  # of all keys, to the ends of int32


def make(keys: list[Key]) -> Topology:
    return Topology(torch.tensor(keys, dtype=torch.int64).view(-1, 3))


@settings(max_examples=60, deadline=None)
@given(key_lists, st.lists(place, max_size=12), shifts)
def test_find_and_around(keys: list[Key], extra: list[Key], shift: int) -> None:
    keys, extra = ([(x + shift, y, z - shift) for x, y, z in some] for some in (keys, extra))
    keys = [key for key in keys if all(-(2**31) <= value < 2**31 for value in key)]
    slot_of = {key: slot for slot, key in enumerate(keys)}
    query = torch.tensor(keys + extra + [(2**40, 0, 0), (0, -(2**62), 1)], dtype=torch.int64).view(-1, 3)
    steps = [(x, y, z) for z in (-1, 0, 1) for y in (-1, 0, 1) for x in (-1, 0, 1)]
    topology = make(keys)
    assert topology.find(query).tolist() == [slot_of.get(tuple(key), -1) for key in query.tolist()]
    assert topology.around.tolist() == [[slot_of.get((k[0] + s[0], k[1] + s[1], k[2] + s[2]), -1) for s in steps] for k in keys]


@settings(max_examples=15, deadline=None)
@given(st.lists(st.tuples(*[st.sampled_from((-2, -1, 0, 3))] * 3), max_size=10, unique=True))
def test_rows_around_a_block(keys: list[Key]) -> None:
    slot_of = {key: slot for slot, key in enumerate(keys)}

    def row(x: int, y: int, z: int) -> int:
        slot = slot_of.get((x >> 3, y >> 3, z >> 3))
        return len(keys) * VOXELS if slot is None else ((slot * 8 + (z & 7)) * 8 + (y & 7)) * 8 + (x & 7)

    topology = make(keys)
    for rows, first, size in ((topology.lookup_rows, 0, 9), (topology.halo_rows, -1, 10)):
        line = range(first, first + size)
        expected = [[row(k[0] * 8 + x, k[1] * 8 + y, k[2] * 8 + z) for z in line for y in line for x in line] for k in keys]
        assert rows.shape == (len(keys), size**3) and rows.dtype == torch.int32 and rows.tolist() == expected
    assert torch.equal(topology.halo_chunk(1, 3), topology.halo_rows[1:3])
    assert torch.equal(topology.lookup_chunk(0, 99), topology.lookup_rows)


def test_the_table_is_as_documented() -> None:
    topology = make([(5, -7, 2), (6, -9, 2)])
    (ox, oy, oz), (sx, sy, sz) = topology.table_origin, topology.table_size
    assert topology.table.shape == (sz, sy, sx) and topology.table.dtype == torch.int32
    assert int(topology.table[2 - oz, -7 - oy, 5 - ox]) == 0 and int(topology.table[2 - oz, -9 - oy, 6 - ox]) == 1
    assert int((topology.table >= 0).sum()) == 2
    margin = topology.table.clone()
    margin[1:-1, 1:-1, 1:-1] = -1
    assert bool((margin == -1).all()) and int((topology.table[1:-1, 1:-1, 1:-1] >= 0).sum()) == 2
    assert topology.to("cpu") is topology and make([(0, 0, 0), (2**20, 0, 0)]).blocks == 2


def test_keys_that_are_refused() -> None:
    with pytest.raises(ValueError, match="unique"):
        make([(1, 2, 3), (0, 0, 0), (1, 2, 3)])
    with pytest.raises(ValueError, match="int32"):
        make([(2**31, 0, 0)])
    with pytest.raises(ValueError, match="far apart"):
        make([(0, 0, 0), (2**20, 2**20, 2**20)])
    for wrong in (torch.zeros(3, dtype=torch.int32), torch.zeros(2, 4, dtype=torch.int32), torch.zeros(2, 3)):
        with pytest.raises(ValueError, match="integer"):
            Topology(wrong)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_cuda_agrees_with_the_cpu() -> None:
    keys = torch.unique(torch.randint(-9, 9, (300, 3)), dim=0)
    here = Topology(keys)
    there = here.to("cuda")
    assert torch.equal(there.halo_rows.cpu(), here.halo_rows) and torch.equal(there.lookup_rows.cpu(), here.lookup_rows)
