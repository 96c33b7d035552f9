"""Depth by matching, on exact pictures of a textured corner."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
import pytest

from fieldfuse.camera import Array, Intrinsics, pixel_grid
from fieldfuse.capture.types import Views
from fieldfuse.errors import InputError, Interrupted
from fieldfuse.poses.overlap import parallax, spread_parallax
from fieldfuse.stereo import match
from fieldfuse.stereo.cost_volume import grey_view, plane_homography
from fieldfuse.stereo.match import LENIENT, MANY, STRICT, StereoDepth, demands, inverse_depths, stereo_depths, usable_neighbours
from tests.poses.textured import arc, look_at, render
from tests.stereo.made import CAMERA, FAR, MEDIAN, NEAR, Stopping, corner, relative_errors, views_of


@lru_cache(maxsize=1)
def found() -> list[StereoDepth]:
    return stereo_depths(corner()[0], NEAR, FAR, MEDIAN)


def test_depth_is_found_on_textured_surface() -> None:
    errors, coverage = relative_errors(found(), corner()[1])
    assert np.median(errors) < 0.005
    assert np.quantile(errors, 0.9) < 0.03
    assert coverage > 0.7
    assert all(one.depth.dtype == np.float32 and one.depth.shape == (120, 160) for one in found())


def test_confidence_tells_good_depth_from_bad() -> None:
    truth = corner()[1]
    low, high = [], []
    for one, true in zip(found(), truth, strict=True):
        known = (one.depth > 0) & (true > 0)
        error = np.abs(one.depth - true) / np.maximum(true, 1e-6)
        low.append(error[known & (one.confidence < 0.7)])
        high.append(error[known & (one.confidence >= 0.8)])
        assert np.array_equal(one.confidence > 0, one.depth > 0)
        assert one.confidence.max() < 1
    assert np.concatenate(low).mean() > 2 * np.concatenate(high).mean()


def test_larger_pictures_are_matched_small_and_keep_their_field_of_view() -> None:
    poses = arc(7, 36.0)[2:5]
    views = views_of(poses, [render(pose)[0] for pose in poses], Intrinsics(320, 240, 300.0, 300.0, 160.0, 120.0))
    depths = stereo_depths(views, NEAR, FAR, MEDIAN, long_side=160)
    assert depths[0].intrinsics == CAMERA
    errors, _ = relative_errors(depths, corner()[1][2:5])
    assert np.median(errors) < 0.008


def test_a_camera_that_moves_forward_finds_depth() -> None:
    """The middle of its pictures is seen from one direction alone, what lies around it from several."""
    eyes = [np.array([0.3, -1.3, -2.4 + 0.25 * step]) for step in range(5)]
    poses = np.array([look_at(eye, np.array([0.3, -1.3, 3.0])) for eye in eyes])
    angles = parallax(poses, MEDIAN), spread_parallax(poses, [CAMERA] * 5, MEDIAN)
    assert angles[0].max() < 1 < angles[1][0, 2:].min()
    made = [render(pose, CAMERA) for pose in poses]
    errors, coverage = relative_errors(
        stereo_depths(views_of(poses, [one for one, _ in made]), NEAR, FAR, MEDIAN), [one for _, one in made]
    )
    assert np.median(errors) < 0.01 and coverage > 0.4


def test_masked_pixels_have_no_depth() -> None:
    views, _ = corner()
    part = views.subset([0, 1, 2])
    part.valid = [np.arange(160)[None] < np.full((120, 1), 60), None, None]
    part.alpha = [None, np.where(np.arange(120)[:, None] < 50, 0, 255) * np.ones((1, 160), np.uint8), None]
    depths = stereo_depths(part, NEAR, FAR, MEDIAN)
    assert not depths[0].depth[:, 60:].any() and (depths[0].depth[:, :60] > 0).mean() > 0.2
    assert not depths[1].depth[:50].any() and (depths[1].depth[50:] > 0).mean() > 0.2


def test_bare_walls_give_no_depth() -> None:
    views, _ = corner()
    bare = views_of(views.world_from_camera, [np.full_like(picture, 130) for picture in views.images])
    kept = np.mean([(one.depth > 0).mean() for one in stereo_depths(bare.subset([0, 1, 2]), NEAR, FAR, MEDIAN)])
    assert kept < 0.05


def test_what_cannot_be_matched_is_refused() -> None:
    views, _ = corner()
    with pytest.raises(InputError, match="at least two images"):
        stereo_depths(views.subset([0]), NEAR, FAR, MEDIAN)
    with pytest.raises(InputError, match="cannot be looked for"):
        stereo_depths(views, 2.0, 1.0, MEDIAN)
    eye = np.array([0.5, -1.3, -2.0])
    turning = np.array([look_at(eye, np.array([x, -0.7, 2.0])) for x in (-0.2, 0.0, 0.2)])
    with pytest.raises(InputError, match="move sideways"):
        stereo_depths(views_of(turning, views.images[:3]), NEAR, FAR, MEDIAN)


def test_it_can_be_stopped() -> None:
    with pytest.raises(Interrupted):
        stereo_depths(corner()[0], NEAR, FAR, MEDIAN, progress=Stopping())


def test_planes_lie_one_to_two_pixels_apart() -> None:
    views, _ = corner()
    ready = [grey_view(picture, CAMERA, pose) for picture, pose in zip(views.images, views.world_from_camera, strict=True)]
    planes = inverse_depths(ready[0], [ready[1], ready[2]], NEAR, FAR)
    assert planes[0] == pytest.approx(1 / FAR) and planes[-1] == pytest.approx(1 / NEAR)
    assert np.allclose(np.diff(planes), planes[1] - planes[0])
    middle = np.array([80.0, 60.0, 1.0])
    moves = [plane_homography(ready[0], ready[2], value) @ middle for value in planes]
    steps = np.linalg.norm(np.diff([move[:2] / move[2] for move in moves], axis=0), axis=1)
    assert 1 < np.median(steps) < 2


def test_neighbours_from_the_same_place_are_left_out() -> None:
    poses = arc(9, 44.0)
    poses = np.concatenate([poses, poses[4:5]])  # a tenth camera where the fifth stands
    near = usable_neighbours(poses, [CAMERA] * 10, MEDIAN, 8)
    assert 9 not in near[4] and 4 not in near[9]
    assert all(index not in row for index, row in enumerate(near))
    away = np.concatenate([poses[:2], [look_at(np.array([0.0, -1, 0]), np.array([0.0, -1, -5]))]])  # the third looks the other way
    assert usable_neighbours(away, [CAMERA] * 3, MEDIAN, 8) == [[1], [0], []]


def test_few_pictures_are_matched_from_farther_apart() -> None:
    """With few pictures neighbours stand 50° apart, and one of them confirms a depth; with many that is too far, and two must."""
    few, many = arc(3, 100.0), np.concatenate([arc(3, 100.0), np.tile(arc(1, 0.0), (MANY - 3, 1, 1))])
    wide = usable_neighbours(few, [CAMERA] * 3, MEDIAN, 2)
    assert 1 in wide[0] and 0 in wide[1] and 1 in wide[2]
    assert not {1, 2} & set(usable_neighbours(many, [CAMERA] * len(many), MEDIAN, 8)[0])
    assert demands(MANY - 1) == LENIENT and demands(MANY) == STRICT and LENIENT.confirm < STRICT.confirm
    asked_so = usable_neighbours(many, [CAMERA] * len(many), MEDIAN, 8, LENIENT)
    assert {1} <= set(asked_so[0])


def near_and_far(noise: float = 12.0) -> tuple[Views, list[Array]]:
    """Seven cameras side by side before a textured wall at a depth of 12 whose left half is hidden by one at 1.5; and exact depth."""
    rng = np.random.default_rng(0)
    textures = [cv2.GaussianBlur(rng.uniform(0, 255, (400, 600, 3)).astype(np.float32), (0, 0), 1.2) * 2 - 128 for _ in range(2)]
    poses = np.tile(np.eye(4), (7, 1, 1))
    poses[:, 0, 3] = 0.06 * np.arange(7)
    grid = pixel_grid(CAMERA.width, CAMERA.height).reshape(CAMERA.height, CAMERA.width, 2)
    pictures, depths = [], []
    for pose in poses:
        layers = []
        for texture, depth in zip(textures, (1.5, 12.0), strict=True):
            place = grid + np.array([pose[0, 3] / depth * CAMERA.fx + 200, 100])  # pixels of the wall, as the first camera sees it
            layers.append(cv2.remap(texture, *np.moveaxis(place.astype(np.float32), -1, 0), interpolation=cv2.INTER_LINEAR))
        hidden = grid[..., 0] + pose[0, 3] / 1.5 * CAMERA.fx < 90
        seen = np.where(hidden[..., None], *layers) + noise * rng.standard_normal((*hidden.shape, 3))
        pictures.append(np.clip(seen, 0, 255).astype(np.uint8))
        depths.append(np.where(hidden, 1.5, 12.0))
    return views_of(poses, pictures), depths


def test_what_stands_far_behind_is_found_though_its_depth_is_rough(monkeypatch: pytest.MonkeyPatch) -> None:
    views, truth = near_and_far()
    depths = stereo_depths(views, 1.0, 20.0, 1.5)
    behind = np.array(truth) > 2
    far = np.array([one.depth for one in depths])[behind]
    off = np.abs(far[far > 0] / 12 - 1)
    assert (far > 0).mean() > 0.8 and np.median(off) < 0.1 and np.quantile(off, 0.95) < 0.3
    assert all(0 < one.noise < 0.05 for one in depths)
    errors, coverage = relative_errors(depths, [np.where(true < 2, true, 0) for true in truth])
    assert coverage > 0.7 and np.median(errors) < 0.01
    monkeypatch.setattr(match, "NOISE", 0.0)
    strict = np.array([one.depth for one in stereo_depths(views, 1.0, 20.0, 1.5)])[behind]
    assert (strict > 0).mean() < 0.6 * (far > 0).mean()
