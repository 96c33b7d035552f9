"""Depth by matching: on exact pictures of a textured corner, and its parts against slow, obvious references."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
import pytest

from tests.poses.textured import arc, look_at, render
from toolkit.camera import Array, Intrinsics, pixel_grid, project, unproject
from toolkit.capture.types import Views
from toolkit.errors import InputError, Interrupted
from toolkit.poses.overlap import parallax, spread_parallax
from toolkit.progress import Progress
from toolkit.stereo import match
from toolkit.stereo.correlate import NOISE
from toolkit.stereo.cost import UNKNOWN, GreyView, Matcher, best_half, grey_view, plane_homography, sweep
from toolkit.stereo.match import LENIENT, MANY, STRICT, StereoDepth, demands, inverse_depths, stereo_depths, usable_neighbours
from toolkit.stereo.polish import Polisher
from toolkit.stereo.smooth import PATHS, SOFT_EDGE, smoothed_planes

CAMERA = Intrinsics(160, 120, 150.0, 150.0, 80.0, 60.0)
NEAR, FAR, MEDIAN = 1.0, 9.0, 3.4


def views_of(poses: Array, pictures: list[Array], camera: Intrinsics = CAMERA) -> Views:
    names = [f"{index:02d}" for index in range(len(poses))]
    return Views(names, pictures, [camera] * len(poses), np.asarray(poses), np.zeros(len(poses), bool))


@lru_cache(maxsize=1)
def corner() -> tuple[Views, list[Array]]:
    """Seven pictures and their exact depth."""
    poses = arc(7, 36.0)
    made = [render(pose, CAMERA) for pose in poses]
    return views_of(poses, [picture for picture, _ in made]), [depth for _, depth in made]


@lru_cache(maxsize=1)
def found() -> list[StereoDepth]:
    return stereo_depths(corner()[0], NEAR, FAR, MEDIAN)


def relative_errors(depths: list[StereoDepth], truth: list[Array]) -> tuple[Array, float]:
    """Errors over the truth where both are known, and the share of the true pixels that are."""
    both = [(one.depth > 0) & (true > 0) for one, true in zip(depths, truth, strict=True)]
    errors = [np.abs(one.depth - true)[known] / true[known] for one, true, known in zip(depths, truth, both, strict=True)]
    return np.concatenate(errors), float(sum(known.sum() for known in both) / sum((true > 0).sum() for true in truth))


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


def test_parallax_of_a_whole_picture_is_that_of_its_points() -> None:
    poses = arc(3, 20.0)
    found = spread_parallax(poses, [CAMERA] * 3, MEDIAN)
    pixels = pixel_grid(160, 120)
    for i, j in ((0, 1), (2, 0)):
        points = unproject(CAMERA, poses[i], pixels, np.full(len(pixels), MEDIAN))
        first, second = (points - poses[k][:3, 3] for k in (i, j))
        cosine = (first * second).sum(1) / np.linalg.norm(first, axis=1) / np.linalg.norm(second, axis=1)
        assert found[i, j] == pytest.approx(np.degrees(np.arccos(cosine)).mean(), rel=0.02)
    assert found.diagonal().max() < 1e-5


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
    with pytest.raises(InputError, match="at least two pictures"):
        stereo_depths(views.subset([0]), NEAR, FAR, MEDIAN)
    with pytest.raises(InputError, match="cannot be looked for"):
        stereo_depths(views, 2.0, 1.0, MEDIAN)
    eye = np.array([0.5, -1.3, -2.0])
    turning = np.array([look_at(eye, np.array([x, -0.7, 2.0])) for x in (-0.2, 0.0, 0.2)])
    with pytest.raises(InputError, match="move sideways"):
        stereo_depths(views_of(turning, views.images[:3]), NEAR, FAR, MEDIAN)


def test_it_can_be_stopped() -> None:
    class Stop(Progress):
        def stopping(self) -> bool:
            return True

    with pytest.raises(Interrupted):
        stereo_depths(corner()[0], NEAR, FAR, MEDIAN, progress=Stop())


# --------------------------------------------------------------------------------------------------- parts


def test_a_plane_maps_pixels_as_projection_does() -> None:
    views, _ = corner()
    first, second = (grey_view(views.images[i], CAMERA, views.world_from_camera[i]) for i in (0, 3))
    pixels = pixel_grid(160, 120)[::97]
    points = unproject(CAMERA, views.world_from_camera[0], pixels, np.full(len(pixels), 2.5))
    expected, _ = project(CAMERA, views.world_from_camera[3], points)
    mapped = np.c_[pixels - 0.5, np.ones(len(pixels))] @ plane_homography(first, second, 1 / 2.5).T
    assert np.allclose(mapped[:, :2] / mapped[:, 2:] + 0.5, expected, atol=1e-8)


def slow_cost(view: GreyView, other: GreyView, inverse_depth: Array, half: int = 3) -> Array:
    """`Matcher.costs` by its definition: points of the depth map are projected, and windows compared one by one."""
    height, width = view.grey.shape
    points = unproject(view.camera, view.world_from_camera, pixel_grid(width, height), 1 / inverse_depth.reshape(-1))
    place, depth = project(other.camera, other.world_from_camera, points)
    x, y = (place - 0.5).T
    rows, columns = other.grey.shape
    inside = (depth > 0) & (x >= 0) & (x <= columns - 1) & (y >= 0) & (y <= rows - 1)
    x, y = np.clip(np.where(inside, x, 0), 0, columns - 1), np.clip(np.where(inside, y, 0), 0, rows - 1)
    i, j = np.minimum(x.astype(int), columns - 2), np.minimum(y.astype(int), rows - 2)
    fx, fy, grey = x - i, y - j, other.grey.astype(float) - 128
    upper, lower = grey[j, i] * (1 - fx) + grey[j, i + 1] * fx, grey[j + 1, i] * (1 - fx) + grey[j + 1, i + 1] * fx
    warped = np.where(inside, upper * (1 - fy) + lower * fy, 0).reshape(height, width)
    own, theirs = (np.pad(picture.astype(float), half, mode="edge") for picture in (view.grey.astype(float) - 128, warped))
    out = np.full((height, width), -1.0)
    for v, u in np.ndindex(height, width):
        if inside[v * width + u]:
            first, second = (picture[v : v + 2 * half + 1, u : u + 2 * half + 1] for picture in (own, theirs))
            product = np.mean((first - first.mean()) * (second - second.mean()))
            out[v, u] = 0.5 - 0.5 * product / np.sqrt((first.var() + NOISE) * (second.var() + NOISE))
    return out


def test_cost_is_what_its_definition_says() -> None:
    views, truth = corner()
    first, second = (grey_view(views.images[i], CAMERA, views.world_from_camera[i]) for i in (0, 2))
    small = grey_view(views.images[2], CAMERA.scaled(80, 60), views.world_from_camera[2])
    for other, inverse_depth in ((second, 1 / truth[0]), (second, np.full((120, 160), 0.3)), (small, 1 / truth[0])):
        cost = Matcher(first, [other]).costs(inverse_depth)[0]
        expected = slow_cost(first, other, inverse_depth)
        alike = (cost < 0) == (expected < 0)
        assert alike.mean() > 0.995 and (cost >= 0).mean() > 0.4  # a point on the very border may round either way
        assert np.abs(cost - expected)[alike].max() < 2e-3
    volume = sweep(first, [second], np.array([0.1, 0.3]))
    cost = Matcher(first, [second]).costs(np.full((120, 160), 0.3))[0]
    assert np.array_equal(volume[:, :, 1], np.where(cost < 0, np.float32(UNKNOWN), cost))


@pytest.mark.parametrize("width", [2, 9, 10, 11, 26, 27, 41])
def test_pictures_of_any_width(width: int) -> None:
    rng = np.random.default_rng(width)
    camera = Intrinsics(width, 11, 20.0, 20.0, width / 2, 5.5)
    pose = np.eye(4)
    pose[:3, 3] = 0.03, 0.01, 0
    pictures = rng.integers(0, 256, (2, 11, width)).astype(np.uint8)
    first, second = GreyView(pictures[0], camera, np.eye(4)), GreyView(pictures[1], camera, pose)
    inverse_depth = rng.uniform(0.4, 1.6, (11, width))
    cost = Matcher(first, [second]).costs(inverse_depth)[0]
    expected = slow_cost(first, second, inverse_depth)
    assert np.array_equal(cost < 0, expected < 0) and (cost >= 0).any()
    assert np.abs(cost - expected).max() < 2e-3
    for count in (3, 16, 21):  # planes, of which `GROUP` come at once
        planes = np.linspace(0.4, 1.6, count)
        volume = sweep(first, [second, first], planes)
        matcher = Matcher(first, [second, first])
        for d, plane in enumerate(planes):
            assert np.array_equal(volume[..., d], matcher.cost(np.full((11, width), plane)))
    assert (Matcher(first, []).cost(inverse_depth) == UNKNOWN).all()


def test_cost_is_correlation() -> None:
    rng = np.random.default_rng(0)
    camera = Intrinsics(40, 30, 30.0, 30.0, 20.0, 15.0)
    grey = rng.integers(0, 256, (30, 40)).astype(np.uint8)
    here, plane = GreyView(grey, camera, np.eye(4)), np.ones((30, 40), np.float32)

    def cost_of(other: Array, pose: Array) -> Array:
        return Matcher(here, [GreyView(other, camera, pose)]).costs(plane)[0]

    inner = slice(4, -4), slice(4, -4)
    assert cost_of(grey // 2 + 20, np.eye(4))[inner].max() < 0.01  # brightness and contrast do not matter
    assert cost_of(255 - grey, np.eye(4))[inner].min() > 0.99
    other = rng.integers(0, 256, (30, 40)).astype(np.uint8)
    expected = 0.5 - 0.5 * np.corrcoef(grey[7:14, 7:14].ravel(), other[7:14, 7:14].ravel())[0, 1]
    assert cost_of(other, np.eye(4))[10, 10] == pytest.approx(expected, abs=0.005)
    aside = np.eye(4)
    aside[0, 3] = 20 / 30  # 20 pixels at a depth of 1: the left half of the picture was left behind
    cost = cost_of(other, aside)
    assert (cost[:, :19] == -1).all() and (cost[:, 21:] >= 0).all()


@pytest.mark.parametrize("far", [1e3, 1e12, 1e25, 1e38])
def test_cameras_out_of_this_world_are_not_read_at(far: float) -> None:
    views, _ = corner()
    first = grey_view(views.images[0], CAMERA, views.world_from_camera[0])
    for axis in range(3):
        pose = views.world_from_camera[0].copy()
        pose[axis, 3] = far
        other = grey_view(views.images[1], CAMERA, pose)
        for inverse_depth in (1e-30, 0.3, 1e30):
            with np.errstate(all="ignore"):
                cost = Matcher(first, [other]).costs(np.full((120, 160), inverse_depth))[0]
            assert np.all((cost == -1) | ((cost >= -1e-3) & (cost <= 1.001)))
    thin = grey_view(views.images[1][:1], CAMERA.scaled(160, 1), views.world_from_camera[1])
    assert (Matcher(first, [thin]).costs(np.full((120, 160), 0.3))[0] == -1).all()


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 6, 8])
def test_the_better_half_counts(count: int) -> None:
    rng = np.random.default_rng(1)
    costs = rng.random((count, 6, 7)).astype(np.float32)
    costs[rng.random(costs.shape) < 0.4] = -1
    costs[:, 0, 0] = -1
    out = np.empty((6, 7), np.float32)
    best_half(costs, out)
    for y, x in np.ndindex(6, 7):
        known = np.sort(costs[:, y, x][costs[:, y, x] >= 0])
        expected = known[: (len(known) + 1) // 2].mean() if len(known) else 0.5
        assert out[y, x] == pytest.approx(expected, abs=1e-6)


def slow_total(cost: Array, grey: Array, small: float, large: float) -> Array:
    """Costs along all paths, pixel by pixel from the definition."""
    height, width, planes = cost.shape
    total = np.zeros(cost.shape)
    for down, right in PATHS:
        line = np.full(cost.shape, np.nan)
        rows = range(height) if down >= 0 else range(height - 1, -1, -1)
        columns = range(width) if right >= 0 else range(width - 1, -1, -1)
        for y in rows:
            for x in columns:
                before = y - down, x - right
                if not (0 <= before[0] < height and 0 <= before[1] < width):
                    line[y, x] = cost[y, x]
                    continue
                past = line[before]
                jump = max(large / (1 + abs(grey[y, x] - grey[before]) / SOFT_EDGE), 1.5 * small)
                for d in range(planes):
                    options = [past[d], past.min() + jump]
                    options += [past[n] + small for n in (d - 1, d + 1) if 0 <= n < planes]
                    line[y, x, d] = cost[y, x, d] + min(options) - past.min()
        total += line
    return total


def test_semi_global_matching_against_its_definition() -> None:
    rng = np.random.default_rng(2)
    cost, grey = rng.random((7, 9, 6)).astype(np.float32), rng.uniform(0, 60, (7, 9)).astype(np.float32)
    total = slow_total(cost, grey, 0.05, 0.8)
    plane, margin = smoothed_planes(cost, grey, 0.05, 0.8)
    assert np.array_equal(np.abs(plane - total.argmin(axis=2)) <= 0.5, np.ones((7, 9), bool))
    best = total.argmin(axis=2)
    for y, x in np.ndindex(7, 9):
        apart = [total[y, x, d] for d in range(6) if abs(d - best[y, x]) > 1]
        assert margin[y, x] == pytest.approx((min(apart) - total[y, x].min()) / min(apart), abs=1e-4)


def test_fractions_of_a_plane() -> None:
    planes = np.arange(12)
    true = np.linspace(3.0, 8.0, 60).reshape(6, 10)
    cost = ((planes - true[..., None]) ** 2 / 400).astype(np.float32)
    plane, _ = smoothed_planes(cost, np.zeros((6, 10), np.float32), small=0.0, large=0.0)
    assert np.abs(plane - true).max() < 0.02


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


def test_depth_that_is_nearly_right_is_polished() -> None:
    """Smooth errors of about 1% shrink; what is missing stays missing, and a view without neighbours keeps what it has."""
    views, truth = corner()
    polisher = Polisher(views, views.intrinsics, NEAR, FAR, MEDIAN)
    waves = 1 + 0.012 * np.sin(np.arange(160) / 9)
    before, after = [], []
    for index, true in enumerate(truth):
        given = np.where(np.arange(120)[:, None] < 6, 0, true * waves).astype(np.float32)
        got, told = polisher.polished(index, given)
        assert got.dtype == np.float32 and ((got > 0) == (given > 0)).all()
        assert told.mean() > 0.5 and not told[given == 0].any()
        known = given > 0
        before.append(np.abs(given - true)[known] / true[known])
        after.append(np.abs(got - true)[known] / true[known])
    assert np.median(np.concatenate(after)) < 0.4 * np.median(np.concatenate(before))
    alone = Polisher(views.subset([0]), views.intrinsics[:1], NEAR, FAR, MEDIAN)
    got, told = alone.polished(0, truth[0])
    np.testing.assert_array_equal(got, np.where(truth[0] > 0, truth[0], 0).astype(np.float32))
    assert not told.any()


def test_few_pictures_are_matched_from_farther_apart() -> None:
    """With few pictures neighbours stand 50° apart, and one of them confirms a depth; with many that is too far, and two must."""
    few, many = arc(3, 100.0), np.concatenate([arc(3, 100.0), np.tile(arc(1, 0.0), (MANY - 3, 1, 1))])
    wide = usable_neighbours(few, [CAMERA] * 3, MEDIAN, 2)
    assert 1 in wide[0] and 0 in wide[1] and 1 in wide[2]
    assert not {1, 2} & set(usable_neighbours(many, [CAMERA] * len(many), MEDIAN, 8)[0])
    assert demands(MANY - 1) == LENIENT and demands(MANY) == STRICT and LENIENT.confirm < STRICT.confirm
    asked_so = usable_neighbours(many, [CAMERA] * len(many), MEDIAN, 8, LENIENT)
    assert {1} <= set(asked_so[0])


def test_two_pictures_confirm_each_other_and_more_find_no_less() -> None:
    """What few pictures find is nearly all right, though one other alone confirms it."""
    views, truth = corner()
    for count in (2, 3):
        some = views.subset(list(range(count)))
        for one, true in zip(stereo_depths(some, NEAR, FAR, MEDIAN), truth[:count], strict=True):
            found = one.depth > 0
            assert found.mean() > 0.3
            assert np.mean(np.abs(one.depth[found] / true[found] - 1) < 0.02) > 0.9


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
