"""Matching costs of planes and of depth maps, against a slow, obvious reference."""

from __future__ import annotations

import numpy as np
import pytest

from fieldfuse.backends.numba.stereo_cost import NOISE, UNKNOWN, best_half
from fieldfuse.camera import Array, Intrinsics, pixel_grid, project, unproject
from fieldfuse.stereo.cost_volume import SOFT_EDGE, GreyView, Matcher, grey_view, smoothed_planes
from tests.stereo.made import CAMERA, corner

PATHS = [(way * down, way * right) for way in (1, -1) for down, right in ((0, 1), (1, 0), (1, 1), (1, -1))]  # (rows, columns)


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
    volume = Matcher(first, [second]).volume(np.array([0.1, 0.3]))
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
        volume = Matcher(first, [second, first]).volume(planes)
        matcher = Matcher(first, [second, first])
        for d, plane in enumerate(planes):
            assert np.array_equal(volume[..., d], matcher.cost(np.full((11, width), plane)))
    assert (Matcher(first, []).cost(inverse_depth) == UNKNOWN).all()


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
    plane = smoothed_planes(cost, grey, 0.05, 0.8)
    assert np.array_equal(np.abs(plane - total.argmin(axis=2)) <= 0.5, np.ones((7, 9), bool))


def test_fractions_of_a_plane() -> None:
    planes = np.arange(12)
    true = np.linspace(3.0, 8.0, 60).reshape(6, 10)
    cost = ((planes - true[..., None]) ** 2 / 400).astype(np.float32)
    plane = smoothed_planes(cost, np.zeros((6, 10), np.float32), small=0.0, large=0.0)
    assert np.abs(plane - true).max() < 0.02
