"""Depth maps at the size of a picture: on other pixels than they were found on, what lies beside an edge or a gap is left out."""

from __future__ import annotations

import numpy as np
import pytest

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.stereo.maps import depth_at, enlarged
from fieldfuse.stereo.match import StereoDepth

WIDTH, HEIGHT, STEP = 24, 16, 11


def found(depth: Array, confidence: float = 0.75, noise: float = 0.0) -> StereoDepth:
    height, width = depth.shape
    camera = Intrinsics(width, height, float(width), float(width), width / 2, height / 2)
    return StereoDepth(depth.astype(np.float32), np.where(depth > 0, confidence, 0).astype(np.float32), camera, noise)


def two_surfaces() -> Array:
    depth = np.full((HEIGHT, WIDTH), 3.0)
    depth[:, :STEP] = 1.0
    return depth


@pytest.mark.parametrize("gap", [0, 1, 3])
def test_on_more_pixels_no_depth_is_told_beside_an_edge_or_a_gap(gap: int) -> None:
    depth = two_surfaces()
    depth[:, STEP : STEP + gap] = 0
    got = depth_at(found(depth), 2 * WIDTH, HEIGHT)
    assert not got[:, 2 * (STEP - 1) : 2 * (STEP + gap + 1)].any()
    assert (got[:, : 2 * (STEP - 1)] == 1).all() and (got[:, 2 * (STEP + gap + 1) :] == 3).all()


@pytest.mark.parametrize("size", [(WIDTH, HEIGHT), (2 * WIDTH, 2 * HEIGHT), (31, 19), (12, 8)])
def test_a_slope_keeps_its_depth_at_any_size(size: tuple[int, int]) -> None:
    across = 1 / np.linspace(0.5, 0.6, WIDTH)
    depth = np.tile(across, (HEIGHT, 1))
    got = depth_at(found(depth), *size)
    inside = got[1:-1, 2:-2]
    assert (inside > 0).all() and got.dtype == np.float32
    expected = 1 / np.interp((np.arange(size[0]) + 0.5) * WIDTH / size[0] - 0.5, np.arange(WIDTH), 1 / across)
    np.testing.assert_allclose(inside, np.tile(expected[2:-2], (len(inside), 1)), rtol=1e-4)


def test_on_more_pixels_nothing_lies_between_two_surfaces() -> None:
    got = depth_at(found(two_surfaces()), 3 * WIDTH, 3 * HEIGHT)
    assert set(np.unique(got)) <= {np.float32(0), np.float32(1), np.float32(3)}
    assert 0.7 < (got > 0).mean() < 1


def test_noise_of_what_is_far_is_no_edge() -> None:
    depth = two_surfaces()
    rough = np.where(np.indices(depth.shape).sum(axis=0) % 2 == 0, 10.0, 12.0)  # inverse depths that differ by 0.017
    depth[:, STEP:] = rough[:, STEP:]
    beyond, before = np.s_[:, 2 * (STEP + 1) :], np.s_[:, : 2 * (STEP - 1)]
    assert not depth_at(found(depth), 2 * WIDTH, HEIGHT)[beyond].any()
    got = depth_at(found(depth, noise=0.02), 2 * WIDTH, HEIGHT)
    assert ((got[beyond] >= 10) & (got[beyond] <= 12)).all() and (got[before] == 1).all()
    assert not got[:, 2 * (STEP - 1) : 2 * (STEP + 1)].any()  # the edge between the surfaces stays one


@pytest.mark.parametrize("size", [(WIDTH, HEIGHT), (2 * WIDTH, 2 * HEIGHT)])
def test_what_is_not_known_or_not_confident_is_unknown(size: tuple[int, int]) -> None:
    nothing = np.zeros((HEIGHT, WIDTH))
    assert not depth_at(found(two_surfaces(), confidence=0.4), *size).any()
    assert not depth_at(found(nothing), *size).any() and not enlarged(nothing, *size).any()


def test_enlarged_maps_have_depth_up_to_the_edge() -> None:
    got = enlarged(two_surfaces(), 2 * WIDTH, 2 * HEIGHT)
    np.testing.assert_array_equal(got, np.repeat(np.repeat(two_surfaces(), 2, axis=0), 2, axis=1))
