"""On coarse lattices colours are means over what a voxel covers; at the finest, and at the end, they are as they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from fieldfuse.config import FitSettings
from fieldfuse.training import fit
from fieldfuse.training.fit import fit_field
from fieldfuse.training.pixels import PixelPool, softened
from fieldfuse.training.schedule import LAST_SOFT, MOST_SOFT, Schedule
from tests.training.test_fit import scene, sphere_views, ticking, wanted


def noise(seed: int, height: int = 40, width: int = 60) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3)).astype(np.uint8)


@pytest.mark.parametrize("radius", [0.5, 1.0, 3.0])
def test_a_mean_is_that_of_a_gaussian(radius: float) -> None:
    image, (y, x) = noise(0), (20, 30)
    rows, columns = np.mgrid[:40, :60]
    weight = np.exp(-((rows - y) ** 2 + (columns - x) ** 2) / (2 * radius**2))
    mean = (weight[:, :, None] * image).sum((0, 1)) / weight.sum()
    assert np.abs(softened(image, None, radius)[y, x] - mean).max() < 4
    assert softened(image, None, 0.0) is image


@pytest.mark.parametrize("radius", [0.5, 1.0, 4.0])
def test_with_holes_it_is_nearly_the_mean_of_what_is_known(radius: float) -> None:
    """Against the same weights over valid pixels alone, on a picture with scattered holes of another colour and a large one."""
    smooth = softened(noise(2), None, 2.0)
    valid = np.random.default_rng(1).random(smooth.shape[:2]) < 0.9
    valid[10:25, 20:45] = False
    asked = [(20, 15), (9, 30), (26, 46), (33, 50), (5, 5)]
    for place in asked:
        valid[place] = True
    image = np.where(valid[:, :, None], smooth, 255).astype(np.uint8)
    rows, columns = np.mgrid[:40, :60]
    off = []
    for y, x in asked:
        weight = np.exp(-((rows - y) ** 2 + (columns - x) ** 2) / (2 * radius**2)) * valid
        mean = (weight[:, :, None] * image).sum((0, 1)) / weight.sum()
        off.append(np.abs(softened(image, valid, radius)[y, x] - mean).max())
    assert max(off) < 12 and np.mean(off) < 5
    assert softened(image, None, radius)[9, 30].mean() > softened(image, valid, radius)[9, 30].mean() + 5


def test_a_pool_softens_in_place_and_comes_back() -> None:
    views = sphere_views()
    valid = [np.random.default_rng(index).random(image.shape[:2]) < 0.7 for index, image in enumerate(views.images)]
    for made in (views, replace(views, valid=valid), replace(views, weight=[0.5] * len(views))):
        pool = PixelPool(made)
        before, seen = pool.colour.clone(), pool.colour.numpy()
        pool.soften(made, 2.0)
        assert not torch.equal(pool.colour, before) and np.shares_memory(seen, pool.colour.numpy())
        masks = made.valid or [None] * len(made)
        one = PixelPool(replace(made, images=[softened(image, mask, 2.0) for image, mask in zip(made.images, masks, strict=True)]))
        assert torch.equal(pool.colour, one.colour)
        pool.soften(made, 0.0)
        assert torch.equal(pool.colour, before)


def test_the_finer_the_lattice_the_sharper() -> None:
    plan = Schedule([64, 128, 256, 480], 10.0, FitSettings(), True)
    radii = []
    for level in range(4):
        plan.level = level
        radii.append(plan.radius(0.1))
        assert plan.radius(LAST_SOFT + 0.01) == 0
    assert radii == [1.875, 0.9375, 0.46875, 0.0]
    assert Schedule([64, 480], 10.0, FitSettings(soften=1e9), True).radius(0.1) == MOST_SOFT
    assert Schedule([64, 480], 10.0, FitSettings(soften=0.0), True).radius(0.1) == 0


@pytest.mark.parametrize(("views", "reaches"), [(40, True), (40, False), (12, True)])
def test_a_fit_ends_with_colours_as_they_are(views: int, reaches: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    ticking(monkeypatch, 0.02)
    asked: list[float] = []
    pools: list[tuple[PixelPool, torch.Tensor]] = []
    whole = PixelPool.soften

    def watched(self: PixelPool, given: object, radius: float) -> None:
        if not pools:
            pools.append((self, self.colour.clone()))
        asked.append(radius)
        whole(self, given, radius)  # type: ignore[arg-type]

    monkeypatch.setattr(PixelPool, "soften", watched)
    monkeypatch.setattr(Schedule, "worth", lambda self, voxels, rays_left, bounded=True: reaches)
    result = fit_field(sphere_views(views), scene(), wanted("engine=numba", "budget=3", "field.resolution=64"))
    assert result.field.resolution == (64 if reaches else 32)
    if views < fit.LEAST_VIEWS:
        assert asked == []  # each pixel of few views is worth more
    else:
        assert asked[0] == 0.5 and asked[-1] == 0
        assert torch.equal(pools[0][0].colour, pools[0][1])
