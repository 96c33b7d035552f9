"""Colours on ever finer lattices: finer than the voxels they began with, within bounds, and from training pictures alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from fieldfuse.capture.types import Views
from fieldfuse.render.color_backprojection import COLOURS, recoloured
from fieldfuse.render.field import Field
from fieldfuse.render.image import render_view
from fieldfuse.training import finer_colours as module
from fieldfuse.training.finer_colours import PIXELS, finer_colours
from fieldfuse.training.levels import finer
from fieldfuse.volume.host import TorchHost
from tests.render.test_color_backprojection import DEPTH, decibel, grey, painted, pictures_of, stripes


@pytest.fixture(scope="module")
def coarse() -> Field:
    """The sphere of `painted`, grey."""
    return grey(painted())


@pytest.fixture(scope="module")
def views() -> Views:
    """Pictures of the same sphere with stripes that are finer than its voxels."""
    field = painted()
    fine = finer(field, torch.ones_like(field.occupied), 2 * field.resolution, TorchHost())
    return pictures_of(replace(fine, feature_rows=stripes(fine)), 16, 128)


@pytest.mark.parametrize("engine", ["numba", "torch"])
def test_stripes_of_two_to_five_voxels_become_sharp(coarse: Field, views: Views, engine: str) -> None:
    between, others = views.subset([1, 6, 11]), views.subset([i for i in range(16) if i not in (1, 6, 11)])
    once = recoloured(coarse, others, DEPTH).field
    before = coarse.feature_rows.clone()
    found = finer_colours(coarse, others, DEPTH, engine=engine)
    assert torch.equal(coarse.feature_rows, before)
    assert decibel(found, between) > decibel(once, between) + 3
    spans = views.intrinsics[0].fx * found.voxel_size / DEPTH
    assert spans == pytest.approx(PIXELS, rel=0.1) and found.resolution == 2 * coarse.resolution
    assert found.decoder is coarse.decoder and not found.feature_rows[:, COLOURS:].any()


def test_the_shape_stays_and_what_nobody_sees_goes(coarse: Field, views: Views) -> None:
    """Opacity and depth of the pictures are what they were; the inside of the sphere is dropped."""
    found = finer_colours(coarse, views, DEPTH)
    for camera, pose in zip(views.intrinsics[:3], views.world_from_camera[:3], strict=True):
        before, after = render_view(coarse, camera, pose), render_view(found, camera, pose)
        assert float(np.abs(before.opacity - after.opacity).mean()) < 0.01
        both = (before.depth > 0) & (after.depth > 0)
        assert float(np.median(np.abs(before.depth - after.depth)[both])) < 0.3 * coarse.voxel_size  # samples lie elsewhere
    whole = coarse.voxels * (found.resolution / coarse.resolution) ** 3
    assert found.voxels < 0.9 * whole


def test_held_out_pictures_are_not_looked_at(coarse: Field, views: Views) -> None:
    views = replace(views, test=np.arange(16) >= 14)
    expected = finer_colours(coarse, views, DEPTH)
    spoilt = replace(views, images=[picture.copy() for picture in views.images])
    spoilt.images[15][:] = 255
    assert torch.equal(finer_colours(coarse, spoilt, DEPTH).feature_rows, expected.feature_rows)


def test_voxels_and_lattices_are_bounded(coarse: Field, views: Views, monkeypatch: pytest.MonkeyPatch) -> None:
    views = views.subset(range(8))
    free = finer_colours(coarse, views, DEPTH)
    for most in (free.voxels // 2, 10):
        monkeypatch.setattr(module, "MOST_VOXELS", most)
        found = finer_colours(coarse, views, DEPTH)
        assert found.voxels <= max(most, coarse.voxels) and found.resolution < free.resolution
    monkeypatch.undo()
    monkeypatch.setattr(module, "MOST_RESOLUTION", 64)
    assert finer_colours(coarse, views, DEPTH).resolution == 64 < free.resolution
    monkeypatch.setattr(module, "MOST_RESOLUTION", 16)  # a lattice that is finer already stays
    assert finer_colours(coarse, views, DEPTH).resolution == coarse.resolution
    monkeypatch.undo()
    monkeypatch.setattr("fieldfuse.memory.available", lambda: 0)  # nothing free: the lattice stays
    found = finer_colours(coarse, views, DEPTH)
    assert found.resolution == coarse.resolution and found.feature_rows.any()


def test_a_field_that_is_fine_enough_or_empty_keeps_its_lattice(coarse: Field, views: Views) -> None:
    views = views.subset([0, 5, 10])
    fine = finer_colours(coarse, views, 100.0)  # far away a voxel is a small part of a pixel
    assert fine.resolution == coarse.resolution and torch.equal(fine.topology.keys, coarse.topology.keys)
    empty = replace(coarse, occupied=torch.zeros_like(coarse.occupied))
    assert torch.equal(finer_colours(empty, views, DEPTH).feature_rows, empty.feature_rows)


def test_what_bulges_over_a_silhouette_goes(coarse: Field, views: Views) -> None:
    """Alpha cuts every picture's right half off; on the finer lattice that is sharp to a voxel of it."""
    left = np.zeros((128, 128), np.uint8)
    left[:, :64] = 255
    images = [np.where(left[..., None] > 0, picture, 255).astype(np.uint8) for picture in views.images]
    cut = replace(views, images=images, alpha=[left] * 16, background=(1.0, 1.0, 1.0)).subset([0, 1, 2])
    field = replace(coarse, background=torch.ones(3))
    found = finer_colours(field, cut, DEPTH)
    without = finer_colours(field, replace(cut, alpha=[None] * 3), DEPTH)
    assert found.voxel_size < 0.8 * without.voxel_size  # alpha tells edges to a pixel
    assert 0 < found.voxels * found.voxel_size**3 < 0.8 * without.voxels * without.voxel_size**3
    for camera, pose in zip(cut.intrinsics, cut.world_from_camera, strict=True):
        shown = render_view(found, camera, pose).opacity
        assert float(shown[:, 68:].mean()) < 0.01 < 0.2 < float(shown[:, :60].mean())
