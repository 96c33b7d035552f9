"""Depth of what is bare: walls with texture at their edges alone, made and matched; and what must not be made up."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
import pytest

from fieldfuse.camera import Array, Intrinsics, pixel_grid, unproject
from fieldfuse.capture.types import Views
from fieldfuse.stereo import bare
from fieldfuse.stereo.bare import continued
from fieldfuse.stereo.match import StereoDepth, stereo_depths
from fieldfuse.stereo.plane_maps import depth_of, numbers_of
from fieldfuse.stereo.planes import ON, Points, find_planes
from tests.poses.textured import PLANES, arc, render, texture
from tests.stereo.made import CAMERA, FAR, MEDIAN, NEAR, relative_errors, views_of

Made = tuple[Views, list[Array], list[StereoDepth]]


def filmed(paint: dict[int, tuple[int, int]]) -> tuple[Views, list[Array]]:
    """Seven pictures of the corner, some of whose sides are painted in one grey but for a frame so wide, and their exact depth."""
    textures = [texture(index) for index in range(len(PLANES))]
    for side, (grey, frame) in paint.items():
        textures[side][frame : 512 - frame, frame : 512 - frame] = grey
    planes = [(*plane, painted) for plane, painted in zip(PLANES, textures, strict=True)]
    poses = arc(7, 36.0)
    made = [render(pose, CAMERA, planes) for pose in poses]
    return views_of(poses, [picture for picture, _ in made]), [depth for _, depth in made]


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


def test_the_same_again() -> None:
    views, _, found = room()
    for one, two in zip(continued(found, views, MEDIAN), continued(found, views, MEDIAN), strict=True):
        assert np.array_equal(one.depth, two.depth)


def test_masks_are_kept() -> None:
    views, _, found = room()
    valid = [np.ones((120, 160), bool) for _ in range(len(views))]
    for mask in valid:
        mask[:40] = False
    masked = [replace(one, depth=np.where(mask, one.depth, 0)) for one, mask in zip(found, valid, strict=True)]
    more = continued(masked, replace(views, valid=valid), MEDIAN)
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


def test_one_picture_or_none_that_sees_the_same_is_left_as_it_was() -> None:
    views, _, found = room()
    assert continued(found[:1], views.subset([0]), MEDIAN)[0] is found[0]
    empty = [replace(one, depth=np.zeros_like(one.depth), confidence=np.zeros_like(one.confidence)) for one in found]
    assert all((one.depth == 0).all() for one in continued(empty, views, MEDIAN))


def test_a_picture_that_looks_elsewhere_is_left_as_it_was() -> None:
    views, _, found = room()
    away = np.diag([-1.0, 1.0, -1.0, 1.0])  # turned round
    poses = np.concatenate([views.world_from_camera, (views.world_from_camera[0] @ away)[None]])
    more = continued([*found, found[0]], views_of(poses, [*views.images, views.images[0]]), MEDIAN)
    assert np.array_equal(more[-1].depth, found[0].depth) and np.array_equal(more[-1].confidence, found[0].confidence)
    before, after = ([(one.depth > 0).mean() for one in many] for many in (found, more[:-1]))
    assert np.mean(after) > np.mean(before) + 0.1


def test_a_plane_aslant_tells_no_depth() -> None:
    planes = np.array([[0.0, 1.0, 0.0, 1.0]])  # a floor below the camera
    camera = Intrinsics(160, 120, 150.0, 150.0, 80.0, 60.0)
    depth = depth_of(np.zeros((120, 160), np.int32), camera, planes, bare.SLANT)
    rows = (np.arange(120) + 0.5 - 60) / 150
    expected = np.arctan(rows) > np.deg2rad(90 - bare.SLANT)  # of the middle column, whose rays do not lean to the side
    assert np.array_equal(depth[:, 80] > 0, expected) and np.allclose(depth[expected, 80], 1 / rows[expected], rtol=1e-5)


def test_who_votes_for_which_plane() -> None:
    """The first plane that is near enough; none is an answer, too, and what has no depth does not vote."""
    planes = np.array([[0.0, 0.0, 1.0, 2.0], [0.0, 0.0, -1.0, -2.1], [0.0, 1.0, 0.0, 1.0]])  # the last is seen from above its edge, aslant
    depth = np.array([[2.0, 2.05, 2.1, 2.3, 0.0]], np.float32)
    voter = numbers_of(depth, Intrinsics(5, 1, 100.0, 100.0, 2.5, 0.5), planes, bare.ON, 80.0)
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
    bare.spread_along(guide, votes, 50.0, 30.0)
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
