"""Effects on rays and depth: distortion, rolling shutter, depth noise."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldfuse.camera import OPENCV, Intrinsics, distort
from fieldfuse.effects.effect_specs import preset
from fieldfuse.effects.models import DepthNoise, Distortion, RollingShutter
from fieldfuse.errors import InputError

CAMERA = Intrinsics(64, 48, 50.0, 50.0, 32.0, 24.0)


# ---- distortion


def test_distortion_by_hand() -> None:
    """x = 0.3, y = −0.2: r² = 0.13."""
    effect = Distortion(0.1, -0.05, 0.01, -0.02, 0.2)
    radial = 1 + 0.1 * 0.13 - 0.05 * 0.13**2 + 0.2 * 0.13**3
    x = 0.3 * radial + 2 * 0.01 * 0.3 * -0.2 - 0.02 * (0.13 + 2 * 0.09)
    y = -0.2 * radial + 0.01 * (0.13 + 2 * 0.04) + 2 * -0.02 * 0.3 * -0.2
    got = effect.forward(torch.tensor([[0.3, -0.2]], dtype=torch.float64))
    np.testing.assert_allclose(got.numpy(), [[x, y]], atol=1e-12)


@settings(max_examples=50, deadline=None)
@given(st.tuples(*[st.floats(-0.2, 0.2)] * 2, *[st.floats(-0.02, 0.02)] * 3), st.integers(0, 100))
def test_distortion_is_opencvs(values: tuple[float, float, float, float, float], seed: int) -> None:
    points = np.random.default_rng(seed).uniform(-0.6, 0.6, (20, 2))
    camera = Intrinsics(64, 48, 50.0, 50.0, 32.0, 24.0, OPENCV, values)
    got = Distortion.of(camera).forward(torch.tensor(points))
    np.testing.assert_allclose(got.numpy(), distort(camera, points), atol=1e-10)


@pytest.mark.parametrize("strength", ["weak", "medium", "strong"])
def test_inverse_is_exact(strength: str) -> None:
    effect = preset("distortion", strength)
    points = torch.tensor(np.random.default_rng(0).uniform(-0.65, 0.65, (500, 2)))
    torch.testing.assert_close(effect.invert(effect.forward(points)), points, atol=1e-12, rtol=0)


def test_a_lens_that_folds_is_refused() -> None:
    assert preset("distortion", "strong").before(CAMERA).distorted
    with pytest.raises(InputError, match="turns back inside the picture"):
        Distortion(-0.9, 0.0).before(CAMERA)


# ---- rolling shutter


@given(st.floats(-10, 10), st.floats(0, 0.1), st.integers(1, 500))
def test_rows_are_spread_evenly_about_the_frames_time(seconds: float, readout: float, height: int) -> None:
    rows = RollingShutter(readout).rows(seconds, height)
    assert rows.shape == (height,)
    assert rows.mean() == pytest.approx(seconds, abs=1e-9)
    assert rows[-1] - rows[0] == pytest.approx(readout * (height - 1) / height, abs=1e-9)


def test_the_first_row_by_hand() -> None:
    rows = RollingShutter(0.02).rows(1.0, 10)
    assert rows[0] == pytest.approx(1 - 0.009) and rows[4] == pytest.approx(1 - 0.001)


# ---- depth noise


def flat(depth: float, size: int = 150) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return np.full((size, size), depth, np.float32), np.full((size, size), 0.5, np.float32), np.zeros((size, size), np.float32)


@pytest.mark.parametrize("depth", [0.8, 2.0, 5.0])
def test_noise_grows_with_the_square_of_depth(depth: float) -> None:
    effect = DepthNoise(sigma=0.002, step=0.0)
    got = effect.forward(*flat(depth), np.random.default_rng(0))
    assert (got > 0).all()
    assert got.mean() == pytest.approx(depth, abs=0.0005)
    assert got.std() == pytest.approx(0.002 * depth**2, rel=0.03)


def test_depth_comes_in_steps_of_disparity() -> None:
    effect = DepthNoise(sigma=0.0, step=0.01)
    z = np.array([1.0, 1.004, 1.02, 4.0, 250.0, 0.0])
    got = effect.quantise(z)
    np.testing.assert_allclose(got[:4], [1 / 1.0, 1 / 1.0, 1 / 0.98, 1 / 0.25])
    assert got[4] == 0 and got[5] == 0  # less than half a step from infinity; nothing there
    ramp = effect.quantise(np.linspace(1, 3, 5000))
    inverse = 1 / np.unique(ramp)
    np.testing.assert_allclose(np.diff(inverse), -0.01, atol=1e-12)
    assert np.abs(np.diff(np.unique(ramp)))[-1] == pytest.approx(0.01 * 3**2, rel=0.05)


def test_holes_at_edges_on_dark_and_on_glossy_surfaces() -> None:
    depth, albedo, gloss = flat(2.0, 120)
    depth[:, 60:] = 1.0
    albedo[:40, :50] = 0.015  # a quarter of `dark`
    gloss[80:, :50] = 0.5
    effect = DepthNoise(sigma=0.0, step=0.0, edge=2, edge_loss=0.6, dark=0.06, dark_loss=0.8, gloss_loss=0.5, patch=1)
    probability = effect.loss(depth, albedo, gloss)
    assert probability[10, 10] == pytest.approx(0.8 * 0.75)
    assert probability[100, 10] == pytest.approx(0.5 * 0.5)
    np.testing.assert_allclose(probability[60, 54:66], [0, 0, 0, 0, 0.6, 0.6, 0.6, 0.6, 0, 0, 0, 0], atol=1e-12)
    holes = np.mean([effect.forward(depth, albedo, gloss, np.random.default_rng(i)) == 0 for i in range(20)], axis=0)
    assert holes[:40, :50].mean() == pytest.approx(0.6, abs=0.02)
    assert holes[80:, :50].mean() == pytest.approx(0.25, abs=0.02)
    assert holes[50:70, :50].max() == 0


def test_holes_come_in_patches_and_range_is_limited() -> None:
    depth, albedo, gloss = flat(2.0, 120)
    gone = DepthNoise(patch=6).forward(depth, albedo * 0, gloss, np.random.default_rng(0)) == 0
    blocks = gone.reshape(20, 6, 20, 6).mean(axis=(1, 3))
    assert set(np.unique(blocks)) == {0.0, 1.0}
    limited = DepthNoise(nearest=1.0, farthest=3.0)
    for z, kept in ((0.8, False), (2.0, True), (3.5, False)):
        assert (limited.forward(*flat(z, 20), np.random.default_rng(0)) > 0).all() == kept
    assert not limited.forward(*flat(0.0, 20), np.random.default_rng(0)).any()
