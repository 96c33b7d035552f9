"""Blocks: growth in the middle of work, erasing and coming back, extreme and colliding keys, none, one, and 200,000 of them."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from fieldfuse.volume.topology import VOXELS, Topology
from tests.stability.hard.errors import not_finite, refused
from tests.stability.hard.ranges import FEW, KEYS
from tests.stability.hard.within import Within

GROUP = "volume"
Key = tuple[int, int, int]


def grid_errors(operations: list[tuple[str, list[Key]]], capacity: int = 4) -> dict[str, float]:
    """Play operations ("activate", "erase", "write") on a `BlockGrid` and on a dictionary; count where they differ.

    New blocks must be zero, also those whose slot was used before; values must survive growth and the erasing of others.
    """
    from fieldfuse.volume.grid import BlockGrid

    model: dict[Key, float] = {}
    wrong = {"blocks": 0.0, "values": 0.0, "slots": 0.0, "order": 0.0}
    grid = BlockGrid(0.1, {"value": 2}, capacity=capacity)
    for number, (name, keys) in enumerate(operations, 1):
        asked = torch.tensor(keys, dtype=torch.int64).view(-1, 3)
        if name == "activate":
            slots = grid.activate(asked)
            wrong["slots"] += float((slots < 0).sum()) + float(len(torch.unique(slots)) != len(set(keys)))
            for key in keys:
                model.setdefault(key, 0.0)
        elif name == "erase":
            wrong["blocks"] += abs(grid.erase(asked) - len({key for key in keys if model.pop(key, None) is not None}))
        else:
            slots = grid.find(asked)
            found = slots[slots >= 0]
            grid.rows("value").view(-1, VOXELS * 2)[found] = float(number)
            model.update({key: float(number) for key in keys if key in model})
        wrong["blocks"] += abs(len(grid) - len(model))
        expected = sorted(model, key=lambda key: (key[2], key[1], key[0]))
        wrong["order"] += float([tuple(key) for key in grid.ordered()[0].tolist()] != expected)
        values = grid.rows("value").view(-1, VOXELS * 2)[grid.ordered()[1]].reshape(-1, 2)
        held = torch.tensor([model[key] for key in expected], dtype=torch.float32).repeat_interleave(VOXELS)
        wrong["values"] += float((values != held[:, None]).sum())
    grid.close()
    return wrong


def test_a_life(within: Within) -> None:
    """Growth in the middle of a run, erasing, coming back."""
    generator = torch.Generator().manual_seed(4)
    operations: list[tuple[str, list[Key]]] = []
    for turn in range(40):
        count = 1 + int(torch.randint(1, 12, (1,), generator=generator)) * (1 + turn // 8)
        keys = [(int(x), int(y), int(z)) for x, y, z in torch.randint(-3, 4, (count, 3), generator=generator)]
        operations.append((("activate", "write", "erase", "activate", "write")[turn % 5], keys))
    within.each(grid_errors(operations), name="wrong {}")


def test_few_blocks(within: Within) -> None:
    """No blocks, one block, the same block many times."""
    one = (5, -6, 7)
    operations = [("activate", []), ("erase", [one]), ("write", [one]), ("activate", [one] * 500), ("write", [one]), ("erase", [one])]
    operations += [("activate", [one]), ("erase", [one, one]), ("activate", [])]
    empty = Topology(torch.zeros((0, 3), dtype=torch.int32))
    within.each(grid_errors(operations, 1), name="wrong {}")
    within("slots of an empty set", float((empty.find(torch.zeros((9, 3), dtype=torch.int64)) >= 0).sum()), 0.0)
    within("rows of an empty set", float(len(empty.halo_rows) + len(empty.lookup_rows)), 0.0)


def test_extreme_keys(within: Within) -> None:
    """Negative and extreme keys."""
    high, low = 2**31 - 1, -(2**31)
    corners = [(x, y, z) for x in (low, high) for y in (low, high) for z in (low, high)]
    beside = [(low + 1, low, low), (high - 1, high, high), (high, high - 1, high - 1), (-1, -1, -1), (0, 0, 0), (0, -1, 0)]
    keys = corners + beside
    operations = [("activate", keys), ("write", keys[::2]), ("erase", keys[::3]), ("activate", keys)]
    too_far = refused(lambda: Topology(torch.tensor([[2**31, 0, 0]])), ValueError, "int32")
    within.each(grid_errors(operations), name="wrong {}")
    within("a key beyond int32 is taken", too_far, 0.0)


def test_colliding_keys(within: Within) -> None:
    """Keys made to collide in a hash table.

    Keys that agree in their low bits, and keys whose sums of multiples (the usual spatial hashes) agree.
    """
    strides = [(i << 20, 0, 0) for i in range(-200, 200)] + [(0, i << 16, 0) for i in range(1, 200)]
    mirrored = [(i, -i, 0) for i in range(1, 200)] + [(i, j, -i - j) for i in range(20) for j in range(1, 20)]
    keys: list[Key] = list(dict.fromkeys(strides + mirrored))
    operations = [("activate", keys), ("write", keys[::2]), ("erase", keys[1::2]), ("activate", keys[::-1]), ("write", keys[::3])]
    within.each(grid_errors(operations, 8), name="wrong {}")


@pytest.mark.long
def test_many_blocks(within: Within) -> None:
    """200,000 blocks."""
    from fieldfuse.volume.grid import BlockGrid

    line = torch.arange(-29, 30)
    keys = torch.stack(torch.meshgrid(line, line, line, indexing="ij"), -1).view(-1, 3)
    keys = keys[torch.randperm(len(keys))[:200_000]]
    topology = Topology(keys)
    within("keys not found", float((topology.find(keys) != torch.arange(len(keys))).sum()), 0.0)
    within("halo of the last block", float((topology.halo_chunk(199_999, 200_000) > topology.zero_row).sum()), 0.0)
    grid = BlockGrid(0.01, {"value": 1}, capacity=150_000)  # too few: it grows once
    first = grid.activate(keys[:100_000])
    grid.rows("value").view(-1, VOXELS)[first] = 1.0
    grid.activate(keys)
    held = grid.rows("value").view(-1, VOXELS)
    within("values lost in growth", float((held[grid.find(keys[:100_000])] != 1).sum()), 0.0)
    within("new blocks that are not zero", float((held[grid.find(keys[100_000:])] != 0).sum()), 0.0)
    within("erased", abs(grid.erase(keys[::2]) - 100_000.0), 0.0)
    within("left", abs(len(grid) - 100_000.0), 0.0)
    within("values that are not finite", not_finite(held[:1000]), 0.0)
    grid.close()


@FEW
@given(st.lists(st.tuples(st.sampled_from(["activate", "erase", "write"]), st.lists(KEYS, max_size=12)), max_size=12), st.integers(1, 6))
def test_the_life_of_a_volume(operations: list[tuple[str, list[tuple[int, int, int]]]], capacity: int) -> None:
    assert not any(grid_errors(operations, capacity).values())
