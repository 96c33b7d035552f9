"""How fine a lattice pictures ask for: two pixels a voxel, and more than 512 voxels a side only where these are many more."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fieldfuse.training.start import FINER, FINEST, PIXELS, USUAL, finest_resolution, space_of, worth_a_level
from tests.training.test_fit import scene, sphere_views


@pytest.mark.parametrize(
    ("asked", "given"), [(40, 64), (300, 288), (USUAL, USUAL), (1.3 * USUAL, USUAL), (1.6 * USUAL, 832), (FINEST, FINEST), (4000, FINEST)]
)
def test_a_lattice_is_as_fine_as_the_pictures_ask_for_within_bounds(asked: float, given: int) -> None:
    views, around = replace(sphere_views(4), background=None), scene()
    space = space_of(views, around)
    focal = asked * PIXELS * around.median_depth / (2 * space.extent * space.half)
    longer = replace(views, intrinsics=[replace(camera, fx=focal, fy=focal) for camera in views.intrinsics])
    assert finest_resolution(space, longer, around) == given


def test_what_is_little_finer_than_usual_is_no_level_of_its_own() -> None:
    assert worth_a_level(USUAL) == worth_a_level(USUAL + 32) == worth_a_level(FINER - 1) == USUAL
    assert worth_a_level(FINER) == FINER and worth_a_level(64) == 64
    assert np.all(np.diff([worth_a_level(resolution) for resolution in range(64, 2 * FINEST, 32)]) >= 0)
