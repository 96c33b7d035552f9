"""Which plane a picture shows where its depth is a guess: what is recognised, what is seen through, and who is asked."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fieldfuse.camera import Array
from fieldfuse.stereo.bare import points_of
from fieldfuse.stereo.cost import UNKNOWN, grey_view
from fieldfuse.stereo.match import StereoDepth
from fieldfuse.stereo.on_planes import Unsure, best_placed, matching_costs, shown_planes
from fieldfuse.stereo.plane_maps import depth_of, in_camera, numbers_of
from fieldfuse.stereo.planes import find_planes
from tests.poses.textured import look_at
from tests.stereo.made import CAMERA
from tests.stereo.test_bare import filmed

HOLE = slice(60, 100), slice(30, 80)


@pytest.fixture(scope="module")
def corner() -> tuple[list[Unsure], list[Array], Array]:
    """Views of the corner whose exact depth is sure, it, and its planes."""
    views, truth = filmed({})
    exact = [depth.astype(np.float32) for depth in truth]
    greys = [grey_view(picture, CAMERA, pose) for picture, pose in zip(views.images, views.world_from_camera, strict=True)]
    nobody = np.zeros(exact[0].shape, bool)
    made = [Unsure(grey, picture, depth, depth, nobody) for grey, picture, depth in zip(greys, views.images, exact, strict=True)]
    planes = find_planes(points_of([StereoDepth(depth, depth, CAMERA) for depth in exact], views.world_from_camera), on=0.003)
    return made, exact, planes


def unsure(views: list[Unsure], index: int, where: Array, guess: Array) -> list[Unsure]:
    """The views, of which one is not sure in a part of its picture."""
    one = views[index]
    changed = replace(one, sure=np.where(where, np.float32(0), one.sure), guess=np.where(where, guess, one.guess).astype(np.float32))
    return [*views[:index], changed, *views[index + 1 :]]


def hole() -> Array:
    out = np.zeros((CAMERA.height, CAMERA.width), bool)
    out[HOLE] = True
    return out


def test_planes_seen_by_a_camera_there_and_back(corner: tuple[list[Unsure], list[Array], Array]) -> None:
    views, exact, planes = corner
    local = in_camera(planes, views[2].grey.world_from_camera)
    numbers = numbers_of(exact[2], CAMERA, local, 0.003, 85.0)
    on = (numbers >= 0) & (numbers < len(planes))
    assert on.mean() > 0.95 and ((exact[2] > 0) == (numbers >= 0)).all()
    depth = depth_of(np.where(on, numbers, -1), CAMERA, local, 85.0)
    assert np.abs(depth[on] / exact[2][on] - 1).max() < 0.003 and not depth[~on].any()


def test_costs_are_lowest_where_things_are(corner: tuple[list[Unsure], list[Array], Array]) -> None:
    views, exact, _ = corner
    true = exact[3]
    none = np.zeros_like(true)
    others = [views[index].grey for index in (1, 2, 4, 5)]
    costs = matching_costs(views[3].grey, others, [true, 1.05 * true, 0.9 * true, none])
    assert costs.shape == (*true.shape, 4) and (costs[..., 3] == 1).all()
    seen = true > 0
    assert np.median(costs[..., 0][seen]) < 0.02 < 0.1 < np.median(costs[..., 2][seen])
    assert (costs[..., 0] < costs[..., 1])[seen].mean() > 0.97
    alone = matching_costs(views[3].grey, [], [true, none])
    assert (alone[..., 0][seen] == UNKNOWN).all() and (alone[..., 1] == 1).all()


def test_the_plane_that_pictures_show_is_taken_whatever_was_guessed(corner: tuple[list[Unsure], list[Array], Array]) -> None:
    views, exact, planes = corner
    where = hole() & (exact[3] > 0)
    some = unsure(views, 3, where, 0.6 * exact[3])
    which = shown_planes(3, some, planes, np.full(len(planes), 0.05))
    assert (which[~where] == -1).all()
    local = in_camera(planes, views[3].grey.world_from_camera)
    right = np.abs(depth_of(which, CAMERA, local, 85.0) / np.where(where, exact[3], 1) - 1) < 0.005
    assert right[where].mean() > 0.9


def test_a_guess_that_pictures_show_is_kept_from_planes_that_they_do_not(corner: tuple[list[Unsure], list[Array], Array]) -> None:
    """Only a plane that passes far before all of it is there to be taken."""
    views, exact, _ = corner
    pose = views[3].grey.world_from_camera
    normal = pose[:3, 2]
    before = np.append(normal, normal @ (pose[:3, 3] + 0.4 * float(np.median(exact[3][HOLE])) * normal))[None]
    where = hole() & (exact[3] > 0)
    which = shown_planes(3, unsure(views, 3, where, exact[3]), before, np.array([0.05]))
    assert (which == -1).mean() > 0.99


def test_a_guess_that_other_views_hold_stays_where_nothing_is_recognised(corner: tuple[list[Unsure], list[Array], Array]) -> None:
    """Such as a bare leg of a table before a bare floor, whose plane is sure all around it."""
    views, exact, planes = corner
    grey = np.full((CAMERA.height, CAMERA.width, 3), 120, np.uint8)
    bare = [replace(one, picture=grey, grey=grey_view(grey, CAMERA, one.grey.world_from_camera)) for one in views]
    where = hole() & (exact[3] > 0)
    free = unsure(bare, 3, where, 0.8 * exact[3])
    held = [*free[:3], replace(free[3], held=where), *free[4:]]
    took, kept = (shown_planes(3, each, planes, np.full(len(planes), 0.05))[where] >= 0 for each in (free, held))
    assert took.mean() > 0.5 > 0.2 > kept.mean()


def test_nothing_is_asked_where_nothing_was_guessed(corner: tuple[list[Unsure], list[Array], Array]) -> None:
    views, exact, planes = corner
    missing = unsure(views, 3, hole(), np.zeros_like(exact[3]))
    assert (shown_planes(3, missing, planes, np.full(len(planes), 0.05)) == -1).all()
    assert best_placed(3, views) == []  # all is sure


def test_who_sees_it_from_elsewhere_is_asked(corner: tuple[list[Unsure], list[Array], Array]) -> None:
    """Not who stands in the same place, nor who looks away."""
    views, exact, _ = corner
    pose = views[3].grey.world_from_camera
    back = look_at(pose[:3, 3] + [0.5, 0, 0], pose[:3, 3] + [0.5, 0, 0] - pose[:3, 2])
    more = [*unsure(views, 3, hole(), exact[3]), views[3], replace(views[0], grey=replace(views[0].grey, world_from_camera=back))]
    chosen = best_placed(3, more)
    assert chosen and set(chosen) <= {0, 1, 2, 4, 5, 6} and len(set(chosen)) == len(chosen)
