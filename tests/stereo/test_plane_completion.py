"""Planes that go on where nothing was matched: walls with texture at their edges alone; what must not be made up; and what images show."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
import pytest

from fieldfuse.backends.numba.stereo_cost import UNKNOWN
from fieldfuse.camera import Array, Intrinsics, pixel_grid, unproject
from fieldfuse.capture.types import Views
from fieldfuse.stereo import plane_completion
from fieldfuse.stereo.consistency import DepthMaps
from fieldfuse.stereo.cost_volume import grey_view
from fieldfuse.stereo.match import StereoDepth, stereo_depths
from fieldfuse.stereo.plane_completion import Unsure, best_placed, continued, matching_costs, shown_planes
from fieldfuse.stereo.planes import ON, Points, depth_of, find_planes, in_camera, numbers_of, points_of
from tests.poses.textured import look_at
from tests.stereo.made import CAMERA, FAR, MEDIAN, NEAR, filmed, relative_errors, views_of

HOLE = slice(60, 100), slice(30, 80)
Made = tuple[Views, list[Array], list[StereoDepth]]


@lru_cache(maxsize=1)
def room() -> Made:
    """The corner with painted walls, and what matching finds."""
    views, truth = filmed({1: (129, 100), 2: (130, 100)})
    return views, truth, stereo_depths(views, NEAR, FAR, MEDIAN)


def new_ones(found: list[StereoDepth], more: list[StereoDepth]) -> list[StereoDepth]:
    return [replace(now, depth=np.where(was.depth > 0, 0, now.depth)) for was, now in zip(found, more, strict=True)]


def test_walls_go_on_where_they_are_bare() -> None:
    views, truth, found = room()
    more = continued(found, views, MEDIAN)
    errors, share = relative_errors(new_ones(found, more), truth)
    before, after = relative_errors(found, truth)[1], relative_errors(more, truth)[1]
    assert share > 0.15 and after > before + 0.15 and after > 0.85
    assert np.median(errors) < 0.005 and np.quantile(errors, 0.95) < 0.03


def test_what_was_matched_stays_and_the_rest_is_confident_as_far_as_others_agree() -> None:
    views, _, found = room()
    for was, now in zip(found, continued(found, views, MEDIAN), strict=True):
        matched = was.depth > 0
        assert np.array_equal(now.depth[matched], was.depth[matched]) and np.array_equal(now.confidence[matched], was.confidence[matched])
        assert np.array_equal(now.confidence > 0, now.depth > 0) and now.confidence.max() < 1
        assert (now.confidence[~matched & (now.depth > 0)] >= 0.5).all() and now.depth.dtype == now.confidence.dtype == np.float32


def test_masked_pixels_stay_without_depth() -> None:
    views, _, found = room()
    mask = np.arange(120)[:, None] * np.ones((1, 160)) >= 40
    masked = [replace(one, depth=np.where(mask, one.depth, 0)) for one in found]
    more = continued(masked, replace(views, valid=[mask] * len(views)), MEDIAN)
    assert all((one.depth[:40] == 0).all() for one in more)
    assert any((one.depth[40:] > 0).sum() > (was.depth[40:] > 0).sum() for one, was in zip(more, masked, strict=True))


def test_a_thing_before_the_wall_does_not_become_wall() -> None:
    """The box stands before the floor and the wall. Taken out of the depth but for a rim, it goes on as a box."""
    views, truth = filmed({1: (129, 100), 2: (130, 100), 3: (180, 0), 4: (210, 0)})
    sides = [depth_of_box(truth[index], views.world_from_camera[index]) for index in range(len(views))]
    hollow, inside = [], []
    for depth, box in zip(truth, sides, strict=True):
        rim = np.zeros_like(box)
        for dy, dx in ((3, 0), (-3, 0), (0, 3), (0, -3)):
            rim |= ~np.roll(box, (dy, dx), (0, 1))
        hollow.append(StereoDepth(np.where(box & ~rim, 0, depth), np.where(box & ~rim, 0, 0.8).astype(np.float32), CAMERA))
        inside.append(box & ~rim)
    more = continued(hollow, views, MEDIAN)
    filled = np.concatenate([one.depth[hole] for one, hole in zip(more, inside, strict=True)])
    true = np.concatenate([depth[hole] for depth, hole in zip(truth, inside, strict=True)])
    known = filled > 0
    assert known.mean() > 0.6
    assert (np.abs(filled - true)[known] / true[known] > 0.1).mean() < 0.05


def depth_of_box(depth: Array, pose: Array) -> Array:
    """(H, W) bool pixels that show the box's face or top."""
    world = unproject(CAMERA, pose, pixel_grid(160, 120), depth.reshape(-1)).reshape(120, 160, 3)
    x, y, z = np.moveaxis(world, -1, 0)
    face, top = np.abs(z - 1.2) < 0.02, np.abs(y + 0.9) < 0.02
    return np.asarray((np.abs(x) <= 0.7) & (face & (y > -0.9) | top & (z > 1.2) & (z < 2.6)) & (depth > 0))


def test_what_looks_different_from_elsewhere_is_no_wall() -> None:
    """A mirror on the wall: where its colours are those of another picture in each view, no plane goes on."""
    views, truth, found = room()
    colours = np.random.default_rng(0).permutation(len(views)) * 30
    pictures, holes = [], []
    for index, (picture, depth) in enumerate(zip(views.images, truth, strict=True)):
        flat = (found[index].depth <= 0) & (depth > 0) & (np.abs(picture[..., 0].astype(int) - 129) <= 2)
        picture = picture.copy()
        picture[flat] = 20 + colours[index]
        pictures.append(picture)
        holes.append(flat)
    before = continued(found, views, MEDIAN)
    after = continued(found, replace(views, images=pictures), MEDIAN)
    share = [np.mean(np.concatenate([one.depth[hole] > 0 for one, hole in zip(more, holes, strict=True)])) for more in (before, after)]
    assert share[0] > 0.6 and share[1] < 0.2 * share[0]


def test_what_has_no_neighbours_is_left_as_it_was() -> None:
    views, _, found = room()
    assert continued(found[:1], views.subset([0]), MEDIAN)[0] is found[0]
    away = views.world_from_camera[0] @ np.diag([-1.0, 1.0, -1.0, 1.0])  # turned round
    poses = np.concatenate([views.world_from_camera, away[None]])
    more = continued([*found, found[0]], views_of(poses, [*views.images, views.images[0]]), MEDIAN)
    assert np.array_equal(more[-1].depth, found[0].depth) and np.array_equal(more[-1].confidence, found[0].confidence)
    assert np.mean([(one.depth > 0).mean() for one in more[:-1]]) > np.mean([(one.depth > 0).mean() for one in found]) + 0.1


def test_a_plane_aslant_tells_no_depth() -> None:
    planes = np.array([[0.0, 1.0, 0.0, 1.0]])  # a floor below the camera
    camera = Intrinsics(160, 120, 150.0, 150.0, 80.0, 60.0)
    depth = depth_of(np.zeros((120, 160), np.int32), camera, planes, plane_completion.SLANT)
    rows = (np.arange(120) + 0.5 - 60) / 150
    expected = np.arctan(rows) > np.deg2rad(90 - plane_completion.SLANT)  # of the middle column, whose rays do not lean to the side
    assert np.array_equal(depth[:, 80] > 0, expected) and np.allclose(depth[expected, 80], 1 / rows[expected], rtol=1e-5)


def test_who_votes_for_which_plane() -> None:
    """The first plane that is near enough; none is an answer, too, and what has no depth does not vote."""
    planes = np.array([[0.0, 0.0, 1.0, 2.0], [0.0, 0.0, -1.0, -2.1], [0.0, 1.0, 0.0, 1.0]])  # the last is seen from above its edge, aslant
    depth = np.array([[2.0, 2.05, 2.1, 2.3, 0.0]], np.float32)
    voter = numbers_of(depth, Intrinsics(5, 1, 100.0, 100.0, 2.5, 0.5), planes, plane_completion.ON, 80.0)
    assert voter.tolist() == [[0, 0, 1, len(planes), -1]]


def test_votes_spread_as_by_opencv() -> None:
    """Its extra modules have the same filter, which a plain OpenCV has not."""
    if not hasattr(cv2, "ximgproc"):
        pytest.skip("this OpenCV has no ximgproc; pip install opencv-contrib-python-headless")
    random = np.random.default_rng(0)
    guide = cv2.GaussianBlur(cv2.resize(random.integers(0, 255, (12, 20, 3)).astype(np.uint8), (100, 60)), (0, 0), 1)
    votes = (random.random((60, 100, 3)) > 0.9).astype(np.float32)
    theirs = cv2.ximgproc.createDTFilter(guide, 50.0, 30.0, mode=cv2.ximgproc.DTF_RF)
    expected = np.stack([theirs.filter(np.ascontiguousarray(votes[..., channel])) for channel in range(3)], axis=2)
    plane_completion.spread_along(guide, votes, 50.0, 30.0)
    np.testing.assert_allclose(votes, expected, atol=3e-6)


def scattered(planes: Array, counts: list[int], noise: float, seed: int) -> Points:
    """Points on planes n · p = d before four cameras at the origin that look along z, off by `noise` of their depth."""
    random = np.random.default_rng(seed)
    rays = np.column_stack([random.uniform(-0.6, 0.6, (sum(counts), 2)), np.ones(sum(counts))])
    which = np.repeat(np.arange(len(planes)), counts)
    depth = planes[which, 3] / (rays * planes[which, :3]).sum(axis=1)
    depth *= 1 + noise * random.standard_normal(len(depth))
    order = np.argsort(random.integers(0, 4, len(depth)), kind="stable")
    view = np.sort(random.integers(0, 4, len(depth)))
    place = rays * depth[:, None]
    return Points(place[order], depth[order], view, rays[order, :2] / 1.2 + 0.5)


@pytest.mark.parametrize("seed", range(4))
def test_planes_are_found_largest_first(seed: int) -> None:
    random = np.random.default_rng(seed)
    normals = np.column_stack([random.uniform(-0.5, 0.5, (3, 2)), np.ones(3)])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    planes = np.column_stack([normals, [1.0, 2.0, 4.0]])
    found = find_planes(scattered(planes, [6000, 3000, 1200], 0.003, seed), seed)
    assert len(found) >= 3
    for plane, true in zip(found[:3], planes, strict=True):
        sign = np.sign(plane[:3] @ true[:3])
        assert sign * plane[:3] @ true[:3] > np.cos(np.deg2rad(0.5)) and abs(sign * plane[3] / true[3] - 1) < ON / 3


def test_too_few_points_have_no_planes() -> None:
    assert find_planes(Points(np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.int64), np.zeros((0, 2)))).shape == (0, 4)
    line = np.column_stack([np.linspace(-1, 1, 50), np.zeros(50), np.ones(50)])
    assert find_planes(Points(line, np.ones(50), np.zeros(50, np.int64), line[:, :2])).shape[1] == 4


@pytest.fixture(scope="module")
def corner() -> tuple[list[Unsure], list[Array], Array]:
    """Views of the corner whose exact depth is sure, it, and its planes."""
    views, truth = filmed({})
    exact = [depth.astype(np.float32) for depth in truth]
    greys = [grey_view(picture, CAMERA, pose) for picture, pose in zip(views.images, views.world_from_camera, strict=True)]
    nobody = np.zeros(exact[0].shape, bool)
    made = [Unsure(grey, picture, depth, depth, nobody) for grey, picture, depth in zip(greys, views.images, exact, strict=True)]
    planes = find_planes(points_of(DepthMaps(exact, views.intrinsics, views.world_from_camera)), on=0.003)
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
    bare = [replace(one, image=grey, grey=grey_view(grey, CAMERA, one.grey.world_from_camera)) for one in views]
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
