"""A scene fitted cell by cell: the cut, the coarse field around a cell, the merge, and that workers do not matter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from fieldfuse.render.field import Field
from fieldfuse.render.numba_renderer import NumbaRenderer
from fieldfuse.training.cells.merge import NotCoveredError, check_coverage, merged
from fieldfuse.training.cells.partition import Cells, cut, morton, region_mask
from fieldfuse.training.cells.pixels import STRIDE, Sight, pools
from fieldfuse.training.levels import finer
from fieldfuse.training.losses import Rates
from fieldfuse.training.numba_engine import NumbaEngine
from fieldfuse.training.pixels import PixelPool
from fieldfuse.volume.host import TorchHost
from tests.render.made import random_field, random_rays
from tests.training.gradients import made_views, numba_gradients


def cells_of(field: Field, count: int) -> Cells:
    return cut(field.topology.keys.numpy(), np.ones(field.blocks), count)


def surrounded(coarse: Field, cells: Cells, cell: int, ratio: int) -> Field:
    """One cell of a field, refined and as yet unchanged, with the coarse field around it."""
    resolution = ratio * coarse.resolution
    part = coarse
    while part.resolution < resolution:
        finer_one = 2 * part.resolution
        part = finer(part, region_mask(part, cells, cell, coarse.resolution, finer_one), finer_one, TorchHost())
    rest = coarse.occupied & ~region_mask(coarse, cells, cell, coarse.resolution, resolution)
    return replace(part, outer=replace(coarse, occupied=rest))


def whole_refined(coarse: Field, ratio: int) -> Field:
    field = coarse
    for _ in range(ratio.bit_length() - 1):
        field = finer(field, torch.ones_like(field.occupied), 2 * field.resolution, TorchHost())
    return field


def test_the_morton_curve_visits_octants_one_after_the_other() -> None:
    keys = np.stack(np.meshgrid(*[np.arange(4)] * 3, indexing="ij"), 3).reshape(-1, 3) + 5
    ordered = keys[np.argsort(morton(keys))] - 5
    assert [tuple(place) for place in ordered[:3]] == [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
    for start in range(0, 64, 8):
        octant = ordered[start : start + 8]
        assert (octant.max(0) - octant.min(0) == 1).all()


@pytest.mark.parametrize("count", [1, 3, 8, 1000])
def test_every_block_has_one_owner_and_work_is_even(count: int) -> None:
    field = random_field(1.0, 64, keep=0.05)
    work = np.random.default_rng(0).random(field.blocks)
    cells = cut(field.topology.keys.numpy(), work, count)
    assert cells.count <= count
    shares = np.bincount(cells.owner, work, minlength=cells.count)
    assert (np.bincount(cells.owner, minlength=cells.count) > 0).all()
    assert shares.max() <= work.sum() / count + work.max()
    assert (cells.owner_of(field.topology.keys.numpy().astype(np.int64), 1) == cells.owner).all()
    assert (cells.owner_of(np.array([[-50, 0, 0], [500, 0, 0]]), 1) == -1).all()


def test_nothing_to_see_is_still_cut() -> None:
    field = random_field(0.0, 32)
    assert cut(field.topology.keys.numpy(), np.zeros(field.blocks), 4).count >= 1


@pytest.mark.parametrize("ratio", [2, 4])
def test_regions_cover_the_field_and_overlap_by_a_block(ratio: int) -> None:
    field = random_field(0.0, 32, keep=0.5)
    cells = cells_of(field, 4)
    masks = torch.stack([region_mask(field, cells, cell, 32, 32 * ratio) for cell in range(cells.count)])
    assert torch.equal(masks.any(0), field.occupied)
    for cell, mask in enumerate(masks):
        own = (field.occupied.view(-1, 512) & torch.from_numpy(cells.owner == cell)[:, None]).view(-1)
        assert (mask & own).equal(own)
        assert 0 < int((mask & ~own).sum()) < int(field.occupied.sum()) - int(own.sum())


@pytest.mark.parametrize("shell", [0.0, 1.0])
@pytest.mark.parametrize("ratio", [2, 4])
def test_a_cell_with_the_rest_around_it_shows_what_the_whole_shows(shell: float, ratio: int) -> None:
    coarse = random_field(shell, 32, keep=0.2, raw=-2.0)
    cells, whole = cells_of(coarse, 5), NumbaRenderer(whole_refined(coarse, ratio), 1)
    lines = random_rays(400, 3)
    expected = whole.render(*lines)
    for cell in range(cells.count):
        shown = NumbaRenderer(surrounded(coarse, cells, cell, ratio), 1).render(*lines)
        # Trilinear values of a refined lattice are the coarse one's within rounding; a ray may end a sample earlier.
        assert float((shown - expected).abs()[:, [0, 1, 2, 4]].max()) < 2e-3
        assert float((shown - expected).abs()[:, [0, 1, 2, 4]].mean()) < 1e-5


def test_a_cells_gradients_are_the_wholes_and_the_rest_gets_none() -> None:
    coarse = random_field(1.0, 32, keep=0.3, raw=-2.5)
    cells, whole = cells_of(coarse, 3), whole_refined(coarse, 2)
    part = surrounded(coarse, cells, 1, 2)
    pool = PixelPool(made_views(), depth=True)
    picks = torch.randperm(len(pool), generator=torch.Generator().manual_seed(0))[:200]
    rates = Rates(0.0, 0.0, 0.0, 0.01, 0.03, depth=0.05)
    of_whole, of_part = (numba_gradients(NumbaEngine(field, pool, 0, 1), picks, rates) for field in (whole, part))
    slots = whole.topology.find(part.topology.keys)
    row = part.occupied.nonzero().squeeze(1)
    deep = row[((row % 8 > 0) & (row // 8 % 8 > 0) & (row // 64 % 8 > 0))]  # not on a lower face, which outer voxels share
    there = slots[deep // 512] * 512 + deep % 512
    for mine, all_of_it in zip(of_part[:2], of_whole[:2], strict=True):
        scale = float(all_of_it.abs().max())
        assert float((mine[deep] - all_of_it[there]).abs().max()) < 2e-3 * scale
        assert float(mine[deep].abs().max()) > 0.01 * scale
    before = coarse.density_rows.clone(), coarse.feature_rows.clone()
    engine = NumbaEngine(part, pool, 0, 1)
    for _ in range(3):
        engine.step(256, Rates(0.1, 0.05, 0.0, 0.01))
    assert torch.equal(coarse.density_rows, before[0]) and torch.equal(coarse.feature_rows, before[1])
    assert float((part.density_rows - finer(coarse, region_mask(coarse, cells, 1, 32, 64), 64, TorchHost()).density_rows).abs().max()) > 0


@pytest.mark.parametrize("ratio", [2, 4])
def test_unchanged_cells_merge_to_the_whole(ratio: int) -> None:
    coarse = random_field(1.0, 32, keep=0.2)
    cells, whole = cells_of(coarse, 6), whole_refined(coarse, ratio).settled()
    fields = [replace(surrounded(coarse, cells, cell, ratio), outer=None).settled() for cell in range(cells.count)]
    result = merged(coarse, cells, fields.__getitem__)
    slots = result.topology.find(whole.topology.keys)
    assert result.blocks == whole.blocks and bool((slots >= 0).all())
    assert torch.equal(result.occupied.view(-1, 512)[slots], whole.occupied.view(-1, 512))
    assert torch.equal(result.density_rows[:-1].view(-1, 512)[slots], whole.density_rows[:-1].view(-1, 512))
    assert torch.equal(result.feature_rows[:-1].view(len(slots), -1)[slots], whole.feature_rows[:-1].view(len(slots), -1))
    assert check_coverage(coarse, coarse.occupied.view(-1, 512).sum(1).numpy(), cells, result) == []


def test_a_cell_that_came_back_empty_is_refused() -> None:
    coarse = random_field(0.0, 32, keep=0.2)
    cells = cells_of(coarse, 3)
    fields = [replace(surrounded(coarse, cells, cell, 2), outer=None).settled() for cell in range(3)]
    empty = replace(fields[1], occupied=torch.zeros_like(fields[1].occupied))
    result = merged(coarse, cells, [fields[0], empty, fields[2]].__getitem__)
    with pytest.raises(NotCoveredError, match="cell 2 of 3 came back with 0%"):
        check_coverage(coarse, coarse.occupied.view(-1, 512).sum(1).numpy(), cells, result)


@pytest.mark.parametrize("masked", [False, True])
def test_a_cells_pixels_are_those_it_is_seen_at(masked: bool) -> None:
    views = made_views(side=22)
    valid = [np.random.default_rng(index).random((22, 22)) < 0.6 for index in range(len(views))]
    views = replace(views, valid=valid if masked else [])
    field = random_field(1.0, 32, keep=0.1, raw=-1.0)
    cells = cut(field.topology.keys.numpy(), field.occupied.view(-1, 512).sum(1).numpy(), 3)
    sight = Sight(field, 1)
    seen, whole = np.array(list(sight.cells_of_pixels(views, cells))), PixelPool(views, depth=True)
    view, row, column = whole.seen_at(torch.arange(len(whole)))
    for cell, pool in enumerate(pools(views, cells, sight, depth=True)):
        expected = torch.from_numpy(seen[view, cell, row // STRIDE, column // STRIDE]).nonzero().squeeze(1)
        assert 0 < len(pool) == len(expected) < len(whole)
        mine, all_of_it = pool.take(torch.arange(len(pool))), whole.take(expected)
        for name in ("origins", "directions", "colour", "distance"):
            assert torch.equal(getattr(mine, name), getattr(all_of_it, name)), name
