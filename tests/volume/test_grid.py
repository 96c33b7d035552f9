"""BlockGrid, and the habits of Open3D's hash map that it hides, each shown to be harmless."""

from __future__ import annotations

import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
import torch

from fieldfuse.errors import InputError
from fieldfuse.memory import madvise
from fieldfuse.volume.compiled import refined, release_unused
from fieldfuse.volume.edit import corner_nodes
from fieldfuse.volume.grid import BlockGrid, GridHost, host_for
from fieldfuse.volume.host import TorchHost
from fieldfuse.volume.topology import VOXELS, Topology
from tests.pages import in_memory

ROOT = Path(__file__).resolve().parents[2]


def line(start: int, stop: int) -> torch.Tensor:
    """Keys (i, 0, 0)."""
    keys = torch.zeros((stop - start, 3), dtype=torch.int32)
    keys[:, 0] = torch.arange(start, stop)
    return keys


def small_grid(capacity: int) -> BlockGrid:
    return BlockGrid(0.1, {"value": 1}, capacity)


def test_present_keys_have_their_slots() -> None:
    grid = small_grid(16)
    first = grid.activate(line(0, 4))
    assert torch.equal(grid.activate(line(0, 4)), first) and len(set(first.tolist())) == 4
    mixed = grid.activate(torch.cat([line(2, 6), line(2, 6)]))  # present, missing and repeated ones at once
    assert torch.equal(mixed[:2], first[2:]) and torch.equal(mixed[:4], mixed[4:]) and len(grid) == 6


def test_passing_present_keys_again_does_not_grow_the_table() -> None:
    grid = small_grid(10)
    for _ in range(5):
        grid.activate(line(0, 8))
    assert (grid.capacity, len(grid)) == (10, 8)


def test_growth_voids_old_views() -> None:
    grid = small_grid(4)
    slots = grid.activate(line(0, 4))
    rows = grid.rows("value")
    rows.view(-1, VOXELS)[slots] = torch.arange(4.0)[:, None].expand(4, VOXELS)
    moved = grid.activate(line(0, 40))
    assert len(rows) == 0, "a view that lost its grid must have no rows to write to"
    with pytest.raises(IndexError):
        rows[0] = 1.0
    assert grid.rows("value").view(-1, VOXELS)[moved[:4]].mean(1).tolist() == [0, 1, 2, 3]


def test_erased_slots_come_back_clean() -> None:
    grid = BlockGrid(0.1, {"feature": 3, "density": 1}, 4)
    grid.activate(line(0, 4))
    for name in ("feature", "density"):
        grid.rows(name).fill_(5.0)
    assert grid.erase(torch.cat([line(0, 3), line(0, 3), line(90, 91)])) == 3
    slots = grid.activate(line(10, 12))
    kept = grid.find(line(3, 4))
    for name in ("feature", "density"):
        blocks = grid.rows(name).view(grid.capacity, -1)
        assert float(blocks[slots].abs().max()) == 0.0 and float(blocks[kept].min()) == 5.0


def test_row_order_is_z_major() -> None:
    grid = BlockGrid(0.5, {"feature": 3}, 8)
    key = torch.tensor([[2, -3, 4]], dtype=torch.int32)
    slot = int(grid.activate(key)[0])
    x, y, z = 1, 5, 6
    grid.rows("feature")[((slot * 8 + z) * 8 + y) * 8 + x] = torch.tensor([1.0, 2.0, 3.0])
    blocks = o3d.core.Tensor(np.array([slot], np.int32))
    places, flat = grid._host.voxel_coordinates_and_flattened_indices(blocks)  # Open3D's own word on where a row is
    values = torch.from_dlpack(grid._host.attribute("feature").to_dlpack()).reshape(-1, 3)[torch.from_numpy(flat.numpy())]
    hit = values.abs().sum(1).nonzero().view(-1)
    assert len(hit) == 1
    expected = (np.array([2, -3, 4]) * 8 + [x, y, z]) * 0.5
    np.testing.assert_allclose(places.numpy()[int(hit)], expected, atol=1e-6)


def run_python(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", textwrap.dedent(code)], check=False, cwd=ROOT, capture_output=True, text=True, timeout=600)


LEAKY = """
    import builtins, sys
    import torch
    from fieldfuse.volume.grid import BlockGrid
    grid = BlockGrid(0.1, {"value": 2}, 64)
    grid.activate(torch.zeros((1, 3), dtype=torch.int32))
    leaf = grid.rows("value").requires_grad_()
    loss = (leaf * leaf).sum()
    (leaf * 2).sum().backward()
    builtins.kept = [grid, leaf, loss]
    kept = [loss]
"""


def test_no_leak_noise_at_exit() -> None:
    quiet = run_python(LEAKY)
    assert (quiet.returncode, quiet.stdout, quiet.stderr) == (0, "", "")


def test_ordered_is_sorted_and_does_not_depend_on_history() -> None:
    keys = torch.randint(-5, 5, (60, 3), generator=torch.Generator().manual_seed(1), dtype=torch.int32)
    one, two = small_grid(4), small_grid(512)
    one.activate(keys)
    two.activate(keys.flip(0)[:30])
    two.activate(line(100, 140))
    two.erase(line(100, 140))
    two.activate(keys)
    expected = sorted(set(map(tuple, keys.tolist())), key=lambda key: key[::-1])
    for grid in (one, two):
        ordered, slots = grid.ordered()
        assert list(map(tuple, ordered.tolist())) == expected
        assert torch.equal(grid.find(ordered), slots) and torch.equal(grid.topology().keys, ordered)


def test_slots_of_a_fresh_table_are_the_same_every_time() -> None:
    keys = torch.unique(torch.randint(-20, 20, (5000, 3), generator=torch.Generator().manual_seed(0)), dim=0).int()
    for _ in range(3):  # with two processors, one insertion of all keys gives another order each time
        grid = BlockGrid(0.1, {"density": 1}, capacity=len(keys) + 1)
        slots = grid.activate(keys[torch.randperm(len(keys))])
        assert torch.equal(grid.find(keys), torch.arange(len(keys))) and len(slots) == len(keys)
        grid.close()


def test_keys_at_the_ends_of_int32() -> None:
    grid = small_grid(4)
    keys = torch.tensor([[2**31 - 1] * 3, [-(2**31)] * 3])
    slots = grid.activate(keys)
    assert torch.equal(grid.find(keys), slots) and slots.min() >= 0
    assert grid.find(keys.flip(0) + torch.tensor([[1, 0, 0], [-1, 0, 0]])).tolist() == [-1, -1]


def test_empty_and_closed() -> None:
    grid = small_grid(4)
    none = torch.zeros((0, 3), dtype=torch.int32)
    assert len(grid.activate(none)) == len(grid.find(none)) == grid.erase(none) == len(grid) == 0
    assert grid.find(line(0, 2)).tolist() == [-1, -1] and grid.topology().blocks == 0
    rows = grid.rows("value")
    grid.close()
    assert len(rows) == 0
    with pytest.raises(RuntimeError, match="closed"):
        grid.rows("value")
    with pytest.raises(ValueError, match="integer"):
        small_grid(1).activate(torch.zeros(3, 3))
    with pytest.raises(KeyError, match="no attribute"):
        small_grid(1).rows("colour")


@pytest.mark.skipif(o3d.core.cuda.is_available(), reason="only where Open3D has no CUDA")
def test_missing_cuda_is_said_in_one_sentence() -> None:
    with pytest.raises(InputError, match="CUDA"):
        BlockGrid(0.1, {"value": 1}, device="cuda")


@pytest.mark.parametrize("channels", [1, 5, 16])
def test_a_fits_rows_are_open3ds_memory_from_a_cache_line_on(channels: int) -> None:
    keys = torch.cartesian_prod(*[torch.arange(4)] * 3).int()
    host = GridHost()
    for _ in range(2):  # the second one may get memory that was used before
        hosted = host.allocate(keys, channels, 0.1)
        assert hosted.feature.shape == (len(keys) * 512 + 1, channels) and hosted.density.shape == (len(keys) * 512 + 1,)
        assert hosted.feature.data_ptr() % 64 == 0 and hosted.density.data_ptr() % 64 == 0
        assert not hosted.feature.any() and not hosted.density.any()
        assert torch.equal(hosted.topology.keys[torch.sort(hosted.topology.find(keys)).values], hosted.topology.keys)
        hosted.feature[:], hosted.density[:] = 2.0, 3.0
        assert host.grid is not None
        for name, value in (("feature", 2.0), ("density", 3.0)):
            buffer = host.grid.rows(name)
            assert int((buffer == value).sum()) == (len(keys) * 512 + 1) * buffer.shape[1]
    host.close()


def test_no_block_has_rows_as_well() -> None:
    hosted = GridHost().allocate(torch.zeros((0, 3), dtype=torch.int32), 4, 0.1)
    assert hosted.topology.blocks == 0 and hosted.density.tolist() == [0.0] and hosted.feature.tolist() == [[0.0] * 4]


@pytest.mark.skipif(madvise is None, reason="this system takes no pages back early")
def test_a_coarser_levels_rows_take_no_memory_while_the_finer_ones_are_made() -> None:
    keys = torch.cartesian_prod(*[torch.arange(8)] * 3).int()
    host = GridHost()
    hosted = host.allocate(keys, 16, 0.1)
    hosted.feature[:] = 1
    assert in_memory(hosted.feature.numpy()) > 0.99
    host.allocate(keys[:4], 16, 0.05)
    assert in_memory(hosted.feature.numpy()) < 0.01, "though somebody still holds them"
    assert not hosted.feature[512:-512].any()  # void, and nothing that was freed
    host.close()


@pytest.mark.skipif(madvise is None, reason="this system takes no pages back early")
def test_rows_beside_no_voxel_take_no_memory() -> None:
    """A wall through a cube of blocks, made twice as fine: of each block that it crosses a few layers of corners are used."""

    def used(nodes: torch.Tensor) -> float:
        return float(nodes.float().mean())

    keys = torch.cartesian_prod(*[torch.arange(8)] * 3).int()
    occupied = torch.zeros(len(keys), 8, 8, 8, dtype=torch.bool)
    occupied[(keys < 7).all(1), 3] = True  # z, y, x; blocks beyond hold corners
    start = Topology(keys)
    density, feature = torch.ones(start.zero_row + 1), torch.ones(start.zero_row + 1, 16)
    host = GridHost()
    hosted, finer = refined(start, occupied.view(-1), (density, feature), 2.0, host, 0.05)
    nodes = corner_nodes(hosted.topology, finer)
    assert int(nodes.sum()) < 0.5 * len(nodes)
    assert used(nodes) <= in_memory(hosted.feature.numpy()) < 1.6 * used(nodes)  # a layer of a block may lie in two pages
    assert (hosted.feature[:-1][nodes] == 1).all()
    finer[: len(finer) // 2] = False
    release_unused(corner_nodes(hosted.topology, finer), hosted.density, hosted.feature)
    nodes = corner_nodes(hosted.topology, finer)
    assert used(nodes) <= in_memory(hosted.feature.numpy()) < 1.6 * used(nodes)  # a layer of a block may lie in two pages
    assert (hosted.feature[:-1][nodes] == 1).all() and not hosted.feature[:-1][~nodes].any()
    host.close()


def test_rows_live_where_open3d_can_have_them() -> None:
    """On the CPU in its hash map; on CUDA too where its build can, else in plain tensors: a fit there needs no other Open3D."""
    assert isinstance(host_for("cpu"), GridHost)
    assert isinstance(host_for("cuda"), GridHost if o3d.core.cuda.is_available() else TorchHost)
