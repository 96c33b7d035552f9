"""The same kernels over ranges that hypothesis searches for the worst."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fieldfuse.camera import FISHEYE, OPENCV, Intrinsics, lens_limit
from fieldfuse.evaluation.depth import depth_metrics
from fieldfuse.evaluation.images import psnr, ssim
from fieldfuse.evaluation.selftest import compositing, edit, lookup, metrics, network, place, rays, rays_background, volume
from fieldfuse.evaluation.selftest.cameras import LENS, POSE, lens_errors, of_fov, projection_errors
from fieldfuse.evaluation.selftest.case import by_size
from fieldfuse.evaluation.selftest.compositing_more import distortion_errors
from fieldfuse.volume.topology import Topology

QUICK = settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.too_slow])
FEW = settings(max_examples=10, deadline=None, suppress_health_check=[HealthCheck.too_slow])
THICKNESS = st.one_of(st.just(0.0), st.floats(-12, 6).map(lambda power: 10.0**power))
KEYS = st.tuples(st.integers(-3, 3), st.integers(-3, 3), st.integers(-3, 3))


@QUICK
@given(st.lists(st.lists(THICKNESS, max_size=40), min_size=1, max_size=6), st.integers(0, 100))
def test_compositing(parts: list[list[float]], seed: int) -> None:
    for measure in compositing.measures(compositing.compositing_errors(parts, seed)):
        assert measure.good, measure


@QUICK
@given(st.data(), st.integers(1, 40))
def test_distortion(data: st.DataObject, count: int) -> None:
    weights = data.draw(st.lists(st.floats(0, 1), min_size=count, max_size=count))
    total = max(1.0, math.fsum(weights))
    places = sorted(data.draw(st.lists(st.floats(0, 1), min_size=count, max_size=count)))
    lengths = data.draw(st.lists(st.floats(0, 1), min_size=count, max_size=count))
    errors = distortion_errors([([weight / total for weight in weights], places, lengths)])
    assert errors["values that are not finite"] == 0 and errors["negative losses"] == 0
    assert errors["gradient"] < 1e-6 and errors["loss"] < 1e-6


def test_a_loss_too_small_for_float32_is_compared_as_it_is() -> None:
    """A weight of 1e-38 costs 1e-77, which is 0 there; a loss that is wrong is told all the same."""
    errors = distortion_errors([([1.1754943508222875e-38], [0.0], [1.0])])
    assert errors["loss"] < 1e-30 and by_size(torch.tensor([0.5]), [1e-77]) == 0.5


def test_a_loss_below_the_digits_of_its_sums_is_told_to_these() -> None:
    """A weight of 4e-16 before one of 1: the loss is 8e-16, of sums whose last digit is 2e-16."""
    assert distortion_errors([([4e-16, 1.0], [0.0, 1.0], [0.0, 0.0])])["loss"] < 1e-6


@QUICK
@given(st.sampled_from([8, 16, 32]), st.floats(0, 1), st.integers(0, 1000), st.floats(0.2, 30), st.floats(-6, 6), st.integers(1, 8))
def test_marching(resolution: int, share: float, seed: int, away: float, power: float, fine: int) -> None:
    half = 10.0**power
    origins, directions = rays.random_rays(6, seed, away)
    errors = rays.march_errors(rays.lattice_grid(resolution, share, seed, half), origins * half, directions, fine=fine)
    for name, bound in rays.BOUNDS.items():
        assert errors[name] <= bound, (name, errors[name])


@FEW
@given(st.floats(0.05, 6), st.integers(0, 1000), st.floats(-3, 3))
def test_marching_beyond_the_region(away: float, seed: int, power: float) -> None:
    half = 10.0**power
    origins, directions = rays.random_rays(4, seed, away)
    errors = rays_background.background_errors(background_grid(half), origins * half, directions, 0.01 * half)
    for name, bound in rays_background.BOUNDS.items():
        assert errors[name] <= bound, (name, errors[name])


def background_grid(half: float) -> rays.MarchGrid:
    from fieldfuse.volume.space import Space

    grid = rays.lattice_grid(256, 1.0, 0, 1.0, 1.0) if not _KEPT else _KEPT[0]
    _KEPT[:] = [grid]
    grid.space = Space((0.0, 0.0, 0.0), half, 1.0)
    return grid


_KEPT: list[rays.MarchGrid] = []


@QUICK
@given(st.lists(KEYS, min_size=1, max_size=8, unique=True), st.integers(0, 1000))
def test_lookup(keys: list[tuple[int, int, int]], seed: int) -> None:
    topology = Topology(torch.tensor(keys))
    values = torch.cat([torch.randn(topology.zero_row, generator=torch.Generator().manual_seed(seed)), torch.zeros(1)])
    errors = lookup.lookup_errors(topology, *lookup.random_places(topology, 60, seed), values)
    for name, error in errors.items():
        assert error <= (0 if "finite" in name else lookup.ABSENT if "absent" in name else lookup.VALUE), (name, error)


@FEW
@given(st.lists(st.tuples(st.sampled_from(["activate", "erase", "write"]), st.lists(KEYS, max_size=12)), max_size=12), st.integers(1, 6))
def test_the_life_of_a_volume(operations: list[tuple[str, list[tuple[int, int, int]]]], capacity: int) -> None:
    assert not any(volume.grid_errors(operations, capacity).values())


@FEW
@given(st.lists(st.tuples(*[st.integers(-(2**31), 2**31 - 1)] * 3), min_size=1, max_size=12, unique=True))
def test_keys_anywhere(keys: list[tuple[int, int, int]]) -> None:
    assert not any(volume.topology_errors(Topology(torch.tensor(keys))).values())


@FEW
@given(st.integers(0, 10_000), st.sampled_from(["trilinear", "nearest"]))
def test_splits(seed: int, mode: str) -> None:
    errors = edit.split_errors(seed, mode)
    assert errors.pop("value in occupied voxels") < 1e-6
    assert not any(errors.values()), errors


@QUICK
@given(st.floats(-3, 3), st.floats(0, 6.8), st.integers(0, 1000))
def test_similarities(power: float, far: float, seed: int) -> None:
    points = np.random.default_rng(seed).uniform(-2, 2, (10, 3))
    errors = place.similarity_errors(place.similarity(10.0**power, 10.0**far, seed), points)
    assert max(errors.values()) <= 4, errors


@QUICK
@given(st.floats(1, 170), st.integers(0, 100))
def test_pinhole_cameras(degrees: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    errors = projection_errors(of_fov(degrees), POSE, rng.uniform([0, 0], [64, 48], (50, 2)), 10 ** rng.uniform(-3, 3, 50))
    assert errors["values that are not finite"] == 0
    assert errors["pixels there and back, by the focal length"] < 1e-8 and errors["ray beside its point, relative"] < 3e-7


@QUICK
@given(st.lists(st.floats(-0.4, 0.4), min_size=4, max_size=4), st.sampled_from([OPENCV, FISHEYE]), st.floats(0, 6.28))
def test_lenses(coefficients: list[float], lens: str, angle: float) -> None:
    small = [coefficients[0], coefficients[1] * 0.3, *(value * 0.01 for value in coefficients[2:])]
    camera = Intrinsics(640, 480, 400.0, 400.0, 320.0, 240.0, lens, tuple(small))
    reach = 0.6 * lens_limit(camera, 0.8)
    radius = np.linspace(0, reach, 20)
    errors = lens_errors(camera, np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1))
    assert errors["values that are not finite"] == 0 and errors["bent"] < LENS and errors["bent and unbent"] < LENS


@FEW
@given(st.lists(KEYS, min_size=1, max_size=4, unique=True), st.floats(0, 1), st.integers(0, 100))
def test_block_convolution(keys: list[tuple[int, int, int]], share: float, seed: int) -> None:
    topology = Topology(torch.tensor(keys))
    occupied = torch.rand(topology.zero_row, generator=torch.Generator().manual_seed(seed)) < share
    errors = network.convolution_errors(topology, occupied, seed)
    assert errors["value"] < 3e-6 and errors["gradient"] < 3e-6
    assert errors["values at empty voxels"] == 0 and errors["values that are not finite"] == 0


@QUICK
@given(st.floats(-15, 15), st.floats(-6, 0), st.integers(1, 5), st.integers(0, 1000))
def test_aggregation(mean: float, spread: float, views: int, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    size = math.copysign(10.0 ** abs(mean / 3), mean)
    values = size * (1 + 10.0**spread * torch.randn(views, 8, 3, generator=generator))
    visible = torch.rand(views, 8, generator=generator) < 0.7
    visible[0] |= ~visible.any(0)
    errors = network.aggregation_errors(values, visible)
    assert errors.pop("mean, by the largest value") < 1e-6 and errors.pop("variance, beyond the rounding of its inputs") <= 1
    assert not any(errors.values()), errors


NUMBERS = st.sampled_from([0.0, -0.0, 1.0, 0.5, -1.0, 255.0, 65535.0, 1e-310, 1e-20, 1e20, 1e308, math.nan, math.inf, -math.inf])


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@QUICK
@given(st.lists(NUMBERS, min_size=2, max_size=2), st.integers(1, 14), st.integers(1, 14), st.booleans())
def test_metrics_are_numbers_or_none(values: list[float], height: int, width: int, striped: bool) -> None:
    first, second = (np.full((height, width, 3), value) for value in values)
    if striped:
        first[::2] = 0.25
    results = [psnr(first, second), ssim(first, second), depth_metrics(first[..., 0], second[..., 0])]
    assert metrics.unclear(results) == 0
    json.dumps(results, allow_nan=False)
