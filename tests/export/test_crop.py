"""Crops: a field keeps what lies in a region, whatever frame that is given in, and loses what no two cameras see."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.capture.types import Views
from fieldfuse.config import crop_box, load_settings
from fieldfuse.errors import InputError
from fieldfuse.evaluation.sphere import sphere_field
from fieldfuse.export.crop import cleaned, common_view, cropped, kept_share, region_of
from fieldfuse.nerfusion.decoder import make_decoder
from fieldfuse.poses.region import FORWARD, OBJECT, Region
from fieldfuse.poses.scene import Scene
from fieldfuse.render.field import Field
from fieldfuse.render.image import render_view
from fieldfuse.render.paths import look_at
from fieldfuse.training.levels import NewField, all_places
from fieldfuse.volume.host import TorchHost
from fieldfuse.volume.space import Space
from fieldfuse.volume.topology import VOXELS
from tests.export.samples import turned
from tests.tsdf.scenes import all_round

LENS = Intrinsics(64, 48, 60.0, 60.0, 32.0, 24.0)
POSES = all_round(np.zeros(3), 3.0, 8)


def views(poses: Array = POSES) -> Views:
    return Views([str(i) for i in range(len(poses))], [], [LENS] * len(poses), poses, np.zeros(len(poses), bool))


def scene(layout: str = OBJECT) -> Scene:
    return Scene(turned(), np.zeros(3), np.ones(3), 3.0, 0.5, 6.0, 0.0, False, True, layout)


def middles(field: Field) -> Array:
    """(V, 3) of the occupied voxels, working frame."""
    row = field.occupied.nonzero().view(-1)
    local = torch.stack([row & 7, row >> 3 & 7, row >> 6 & 7], dim=1) + 0.5
    places = (field.topology.keys[row // VOXELS] * 8 + local.double()) * field.grid.voxel - field.space.extent
    return np.asarray(field.space.to_working(places))


@pytest.mark.parametrize("shell", [0.0, 1.0])
def test_a_region_decides_which_voxels_stay(shell: float) -> None:
    field = sphere_field(32)
    field = replace(field, space=replace(field.space, shell=shell))
    region = Region.box(np.array([-9, -9, -9]), np.array([9, 9, 0.05]))
    part = cropped(field, region)
    whole = middles(field)
    assert part.voxels == int(region.inside(whole).sum()) and 0 < part.voxels < field.voxels
    assert region.inside(middles(part)).all()
    lens, pose = LENS, POSES[0]
    before, after = render_view(field, lens, pose), render_view(part, lens, pose)
    assert 0.01 < (before.opacity - after.opacity > 0.5).mean() < (before.opacity > 0.5).mean()
    light, inside = kept_share(field, part, region, views())
    assert 0.3 < light < 1 and inside > 0.9
    assert kept_share(field, field, None, views()) == pytest.approx((1, 1))


def test_numbers_are_in_the_frame_of_the_input() -> None:
    low, high = crop_box("3, -2,0.5,1,4,1e2") or ([], [])
    assert (low, high) == ([1.0, -2.0, 0.5], [3.0, 4.0, 100.0])
    region = region_of("3,-2,0.5,1,4,100", scene(), views())
    points = np.random.default_rng(0).uniform(-5, 120, (500, 3)) * [0.05, 0.05, 1]
    assert region is not None
    assert np.array_equal(region.inside(turned().points(points)), ((points >= low) & (points <= high)).all(axis=1))


@pytest.mark.parametrize("text", ["", "1,2,3", "0,0,0,1,1,nan", "0,0,0,0,1,1", "0,0,0,1,1,1e400", "sphere", "1,2,3,4,5,6,7"])
def test_what_is_no_region_is_refused(text: str) -> None:
    with pytest.raises(InputError, match=r"export\.crop.* it must be one of off, auto, box, hull, or a box"):
        load_settings(flags={"export.crop": text})
    assert load_settings(pairs=["export.crop=off"]).export.crop == "off"
    assert load_settings(pairs=["export.crop=0,0,0,1,1,1"]).export.crop == "0,0,0,1,1,1"


def test_auto_crops_objects_alone_and_a_hull_is_what_half_of_the_cameras_see() -> None:
    assert region_of("off", scene(), views()) is None and region_of("auto", scene(FORWARD), views()) is None
    found = region_of("auto", scene(), views())
    assert found is not None
    assert found.inside(np.array([[1.19, 0, 0], [1.21, 0, 0], [-1.19, 1.19, -1.19]])).tolist() == [True, False, True]
    # Cameras all round see a ball about the middle, of the radius of their cone.
    hull = common_view(scene(), views())
    assert hull.inside(np.zeros((1, 3))).all()
    away = views(POSES @ np.diag([1.0, -1, -1, 1]))
    with pytest.raises(InputError, match="nothing in common"):
        common_view(scene(), away)
    assert Region.hull(np.zeros((5, 3))) is None


def test_what_floats_before_one_camera_goes_and_the_rest_stays() -> None:
    ahead, floater = np.array([0.0, -1, 0]), np.array([0.0, -0.85, 0])
    space = Space((0.0, 0.0, 0.0), 1.0, 0.0)
    places = all_places(space, 64)
    at = (np.asarray(places) + 0.5) / 32 - 1
    places = places[torch.from_numpy((np.linalg.norm(at, axis=1) < 0.4) | (np.linalg.norm(at - floater, axis=1) < 0.08))]
    field = NewField(space, 64, make_decoder("deferred", 8, 16), torch.zeros(3)).on(places, TorchHost(), 3.0, torch.Generator())
    # Two cameras behind the ball, which hides what floats there, and one or two before it.
    behind = look_at(np.array([[0.1, 3.0, 0], [-0.1, 3.0, 0]]), np.zeros(3), np.array([0.0, 0, 1]))
    before = look_at(3 * ahead + np.array([[0.1, 0, 0], [-0.1, 0, 0]]), np.zeros(3), np.array([0.0, 0, 1]))
    for count, stays in ((0, False), (1, False), (2, True)):
        poses = np.concatenate([behind, before[:count]])
        part = cleaned(field, [LENS] * len(poses), poses)
        assert (np.linalg.norm(middles(part) - floater, axis=1) < 0.1).any() == stays
        assert part.voxels < field.voxels  # the middle of the ball is seen by none
        shown, whole = render_view(part, LENS, behind[0]), render_view(field, LENS, behind[0])
        assert np.abs(shown.opacity - whole.opacity).max() < 0.05
    assert np.abs(render_view(part, LENS, before[0]).opacity - render_view(field, LENS, before[0]).opacity).max() < 0.05
