"""Blocks: growth in the middle of work, erasing and coming back, extreme and colliding keys, none, one, and 200,000 of them."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from fieldfuse.evaluation.selftest.case import Measure, absolute, case, not_finite, refused
from fieldfuse.evaluation.selftest.lookup import scattered_blocks
from fieldfuse.volume.topology import BLOCK, KEY_HIGH, KEY_LOW, VOXELS, Topology

GROUP = "volume"
Key = tuple[int, int, int]


def grid_errors(operations: list[tuple[str, list[Key]]], capacity: int = 4) -> dict[str, float]:
    """Play operations ("activate", "erase", "write") on a `BlockGrid` and on a dictionary; count where they differ.

    New blocks must be zero, also those whose slot was used before; values must survive growth and the erasing of others.
    """
    from fieldfuse.volume.grid import BlockGrid

    model: dict[Key, float] = {}
    wrong = {"blocks": 0.0, "values": 0.0, "slots": 0.0, "order": 0.0}
    with BlockGrid(0.1, {"value": 2}, capacity=capacity) as grid:
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
            wrong["order"] += float([tuple(key) for key in grid.keys().tolist()] != expected)
            values = grid.gather("value")
            held = torch.tensor([model[key] for key in expected], dtype=torch.float32).repeat_interleave(VOXELS)
            wrong["values"] += float((values[:-1] != held[:, None]).sum()) + float((values[-1] != 0).sum())
    return wrong


def topology_errors(topology: Topology) -> dict[str, float]:
    """`find`, `around`, `lookup_rows` and `halo_rows` against a dictionary of keys, for every block."""
    keys = [tuple(key) for key in topology.keys.tolist()]
    at = {key: slot for slot, key in enumerate(keys)}
    wrong = {"find": 0.0, "around": 0.0, "lookup rows": 0.0, "halo rows": 0.0}
    asked = [(x + dx, y + dy, z + dz) for x, y, z in keys for dx in (-1, 0, 1) for dy in (-1, 0, 1) for dz in (-1, 0, 1)]
    found = topology.find(torch.tensor(asked, dtype=torch.int64).view(-1, 3)).tolist()
    wrong["find"] = float(sum(slot != at.get(key, -1) for key, slot in zip(asked, found, strict=True)))
    around = topology.around.tolist()
    for slot, (x, y, z) in enumerate(keys):
        for column in range(27):
            near = (x + column % 3 - 1, y + column // 3 % 3 - 1, z + column // 9 - 1)
            wrong["around"] += around[slot][column] != at.get(near, -1)
    for name, first, size, rows in (("lookup rows", 0, BLOCK + 1, topology.lookup_rows), ("halo rows", -1, BLOCK + 2, topology.halo_rows)):
        listed = rows.tolist()
        for slot, key in enumerate(keys[:4]):
            for column in range(size**3):
                place = [key[axis] * BLOCK + first + column // size**axis % size for axis in range(3)]
                owner = at.get((place[0] >> 3, place[1] >> 3, place[2] >> 3))
                local = ((place[2] & 7) * BLOCK + (place[1] & 7)) * BLOCK + (place[0] & 7)
                wrong[name] += listed[slot][column] != (topology.zero_row if owner is None else owner * VOXELS + local)
    return wrong


def _zero(errors: dict[str, float], what: str = "") -> list[Measure]:
    return [Measure(f"wrong {name}{what}", error, 0.0) for name, error in errors.items()]


@case(GROUP, "growth in the middle of a run, erasing, coming back")
def a_life(folder: Path) -> list[Measure]:
    generator = torch.Generator().manual_seed(4)
    operations: list[tuple[str, list[Key]]] = []
    for turn in range(40):
        count = 1 + int(torch.randint(1, 12, (1,), generator=generator)) * (1 + turn // 8)
        keys = [(int(x), int(y), int(z)) for x, y, z in torch.randint(-3, 4, (count, 3), generator=generator)]
        operations.append((("activate", "write", "erase", "activate", "write")[turn % 5], keys))
    return _zero(grid_errors(operations))


@case(GROUP, "no blocks, one block, the same block many times")
def few_blocks(folder: Path) -> list[Measure]:
    one = (5, -6, 7)
    operations = [("activate", []), ("erase", [one]), ("write", [one]), ("activate", [one] * 500), ("write", [one]), ("erase", [one])]
    operations += [("activate", [one]), ("erase", [one, one]), ("activate", [])]
    empty = Topology(torch.zeros((0, 3), dtype=torch.int32))
    return [
        *_zero(grid_errors(operations, 1)),
        *_zero(topology_errors(empty), ", no blocks"),
        *_zero(topology_errors(Topology(torch.tensor([one]))), ", one block"),
        Measure("slots of an empty set", float((empty.find(torch.zeros((9, 3), dtype=torch.int64)) >= 0).sum()), 0.0),
        Measure("rows of an empty set", float(len(empty.halo_rows) + len(empty.lookup_rows) + len(empty.dilated_keys())), 0.0),
    ]


@case(GROUP, "negative and extreme keys")
def extreme_keys(folder: Path) -> list[Measure]:
    high, low = KEY_HIGH, KEY_LOW
    corners = [(x, y, z) for x in (low, high) for y in (low, high) for z in (low, high)]
    beside = [(low + 1, low, low), (high - 1, high, high), (high, high - 1, high - 1), (-1, -1, -1), (0, 0, 0), (0, -1, 0)]
    keys = corners + beside
    topology = Topology(torch.tensor(keys))
    lone = Topology(torch.tensor([(high, high, high)]))
    operations = [("activate", keys), ("write", keys[::2]), ("erase", keys[::3]), ("activate", keys)]
    too_far = refused(lambda: Topology(torch.tensor([[2**31, 0, 0]])), ValueError, "int32")
    return [
        *_zero(grid_errors(operations)),
        *_zero(topology_errors(topology)),
        *_zero(topology_errors(lone), " at the far end"),
        Measure("a key beyond int32 is taken", too_far, 0.0),
        Measure("keys grown beyond int32", float((lone.dilated_keys().long().abs() > 2**31).sum()), 0.0),
    ]


@case(GROUP, "keys made to collide in a hash table")
def colliding_keys(folder: Path) -> list[Measure]:
    """Keys that agree in their low bits, and keys whose sums of multiples (the usual spatial hashes) agree."""
    strides = [(i << 20, 0, 0) for i in range(-200, 200)] + [(0, i << 16, 0) for i in range(1, 200)]
    mirrored = [(i, -i, 0) for i in range(1, 200)] + [(i, j, -i - j) for i in range(20) for j in range(1, 20)]
    keys: list[Key] = list(dict.fromkeys(strides + mirrored))
    operations = [("activate", keys), ("write", keys[::2]), ("erase", keys[1::2]), ("activate", keys[::-1]), ("write", keys[::3])]
    return _zero(grid_errors(operations, 8))


@case(GROUP, "blocks far apart: searched codes and the dense table agree")
def codes_and_table(folder: Path) -> list[Measure]:
    keys = scattered_blocks(40, 2, 4).keys
    far = torch.cat([keys, keys + torch.tensor([2**30, -(2**30), 2**29], dtype=torch.int32)])
    dense, coded = Topology(keys), Topology(keys, max_table_cells=1)
    query = torch.randint(-7, 8, (20_000, 3))
    return [
        Measure("find", absolute(dense.find(query), coded.find(query)), 0.0),
        Measure("around", absolute(dense.around, coded.around), 0.0),
        Measure("halo rows", absolute(dense.halo_rows, coded.halo_rows), 0.0),
        Measure("grown keys", absolute(_sorted(dense.dilated_keys(2)), _sorted(coded.dilated_keys(2))), 0.0),
        *_zero(topology_errors(Topology(far)), ", two clusters"),
    ]


def _sorted(keys: Tensor) -> Tensor:
    return torch.unique(keys, dim=0)


@case(GROUP, "200,000 blocks", slow=True)
def many_blocks(folder: Path) -> list[Measure]:
    from fieldfuse.volume.grid import BlockGrid

    line = torch.arange(-29, 30)
    keys = torch.stack(torch.meshgrid(line, line, line, indexing="ij"), -1).view(-1, 3)
    keys = keys[torch.randperm(len(keys))[:200_000]]
    topology = Topology(keys)
    out = [
        Measure("keys not found", float((topology.find(keys) != torch.arange(len(keys))).sum()), 0.0),
        Measure("halo of the last block", float((topology.halo_chunk(199_999, 200_000) > topology.zero_row).sum()), 0.0),
    ]
    with BlockGrid(0.01, {"value": 1}, capacity=150_000) as grid:  # too few: it grows once
        first = grid.activate(keys[:100_000])
        grid.rows("value").view(-1, VOXELS)[first] = 1.0
        grid.activate(keys)
        held = grid.rows("value").view(-1, VOXELS)
        out.append(Measure("values lost in growth", float((held[grid.find(keys[:100_000])] != 1).sum()), 0.0))
        out.append(Measure("new blocks that are not zero", float((held[grid.find(keys[100_000:])] != 0).sum()), 0.0))
        out.append(Measure("erased", abs(grid.erase(keys[::2]) - 100_000.0), 0.0))
        out.append(Measure("left", abs(len(grid) - 100_000.0), 0.0))
        out.append(Measure("values that are not finite", not_finite(held[:1000]), 0.0))
    return out
