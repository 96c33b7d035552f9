"""Forward models against their formulas at known values, inverses against them: lens, shutter, light, sensors, background, highlights."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldfuse.camera import OPENCV, Intrinsics, distort
from fieldfuse.effects.effect_specs import STRENGTHS, preset
from fieldfuse.effects.models import (
    Compression,
    DepthNoise,
    Distortion,
    Exposure,
    MotionBlur,
    RollingShutter,
    SensorNoise,
    decode_srgb,
    encode_srgb,
)
from fieldfuse.effects.scenery import Background, Highlights
from fieldfuse.errors import InputError
from fieldfuse.tone import share, square_radius

CAMERA = Intrinsics(64, 48, 50.0, 50.0, 32.0, 24.0)
SMALL = Intrinsics(40, 30, 35.0, 35.0, 20.0, 15.0)


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


@pytest.mark.parametrize("strength", STRENGTHS)
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


def scene(seed: int = 0) -> torch.Tensor:
    return torch.rand(30, 40, 3, generator=torch.Generator().manual_seed(seed)) * 0.8 + 0.05


# ---- transfer


def test_srgb_at_known_values() -> None:
    """Table values of the standard: the toe's end, middle grey, white; beyond [0, 1] is clipped."""
    linear = torch.tensor([0.0, 0.0031308, 0.18, 0.5, 1.0, 1.7, -0.2])
    expected = torch.tensor([0.0, 0.04045, 0.46136, 0.73536, 1.0, 1.0, 0.0])
    torch.testing.assert_close(encode_srgb(linear), expected, atol=2e-5, rtol=0)


@given(st.floats(0, 1))
def test_srgb_there_and_back(value: float) -> None:
    linear = torch.tensor([value], dtype=torch.float64)
    torch.testing.assert_close(decode_srgb(encode_srgb(linear)), linear, atol=1e-6, rtol=0)


# ---- exposure


@settings(deadline=None)
@given(st.integers(0, 1000), st.integers(3, 200), st.floats(0.01, 2), st.floats(0.01, 0.5))
def test_drift_has_mean_zero_and_the_named_deviation(seed: int, frames: int, stops: float, tint: float) -> None:
    gain = Exposure(stops, tint).gains(frames, np.random.default_rng(seed))
    level, red, blue = np.log2(gain[:, 1]), np.log2(gain[:, 0] / gain[:, 1]), np.log2(gain[:, 2] / gain[:, 1])
    for curve, deviation in ((level, stops), (red, tint), (blue, tint)):
        assert abs(curve.mean()) < 1e-9
        assert curve.std() == pytest.approx(deviation, rel=1e-6)


def test_drift_is_smooth() -> None:
    gain = preset("exposure", "strong").gains(60, np.random.default_rng(1))
    assert np.abs(np.diff(np.log2(gain), axis=0)).max() < 0.15 * np.ptp(np.log2(gain))
    assert np.array_equal(preset("exposure", "strong").gains(2, np.random.default_rng(1)), np.ones((2, 3)))


# ---- vignetting


def test_vignetting_is_a_cosine_to_the_fourth() -> None:
    square = square_radius(SMALL)
    assert square[0, 0] == pytest.approx((19.5**2 + 14.5**2) / 625) and square.min() == pytest.approx(0.5 / 625)  # pixels' centres
    np.testing.assert_allclose(share(0.35, np.array([0.0, 1.0])), [1.0, 0.35])
    angle = np.arctan(np.sqrt(0.35**-0.5 - 1) * 0.5)
    assert share(0.35, np.array([0.25])) == pytest.approx(np.cos(angle) ** 4, rel=1e-6)


# ---- highlights


def test_a_highlight_is_strongest_in_the_mirror_direction() -> None:
    """A surface that faces up, a lamp at 45°: full strength where the ray is mirrored into it, cos^n off it, none behind."""
    s = 0.5**0.5
    normal, lamp = torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([[s, 0.0, s]])
    rays = torch.tensor([[s, 0.0, -s], [0.0, 0.0, -1.0], [-s, 0.0, -s]])
    effect = Highlights(strength=2.0)
    got = effect.forward(rays, normal.expand(3, 3), lamp.expand(3, 3), torch.tensor([0.5, 0.5, 0.5]), torch.full((3,), 8.0))
    np.testing.assert_allclose(got.numpy(), [1.0, 2 * 0.5 * s**8, 0.0], atol=1e-6)


def test_a_coat_gives_dull_surfaces_a_highlight() -> None:
    ray, up = torch.tensor([[0.0, 0.0, -1.0]]), torch.tensor([[0.0, 0.0, 1.0]])
    dull, sharpness = torch.zeros(1), torch.full((1,), 20.0)
    assert float(Highlights(1.0, 0.0).forward(ray, up, up, dull, sharpness)) == 0
    assert float(Highlights(1.0, 0.2).forward(ray, up, up, dull, sharpness)) == pytest.approx(0.2)


# ---- background


def test_the_sky_follows_its_gradient() -> None:
    effect = Background(detail=0.0)
    elevation = torch.deg2rad(torch.tensor([0.0, 12.0, 90.0, -6.0]))
    rays = torch.stack([torch.cos(elevation), torch.zeros(4), torch.sin(elevation)], dim=1)
    haze, zenith, earth = (torch.tensor(c) for c in (effect.haze, effect.zenith, effect.earth))
    e = float(np.exp(-1))
    expected = [haze, haze * e + zenith * (1 - e), zenith + (haze - zenith) * float(np.exp(-7.5)), haze * e + earth * (1 - e)]
    torch.testing.assert_close(effect.forward(rays), torch.stack(expected), atol=1e-5, rtol=1e-4)


def test_detail_adds_a_skyline_that_a_seed_chooses() -> None:
    azimuth = torch.linspace(-3.1, 3.1, 500)
    height, shade = Background(1.0, seed=1).skyline(azimuth)
    assert height.min() > 0 and height.max() > 8 and len(torch.unique(shade)) > 40
    assert not torch.equal(height, Background(1.0, seed=2).skyline(azimuth)[0])
    low = torch.stack([torch.cos(azimuth), torch.sin(azimuth), torch.full((500,), 0.01)], dim=1)
    low = torch.nn.functional.normalize(low, dim=1)
    plain, rich = (Background(detail, seed=1).forward(low) for detail in (0.0, 1.0))
    assert (plain - rich).abs().mean() > 0.05


# ---- motion blur


def test_instants_are_the_middles_of_equal_parts() -> None:
    np.testing.assert_allclose(MotionBlur(0.1, 4).instants(), [-0.0375, -0.0125, 0.0125, 0.0375])


def test_a_moving_edge_becomes_a_ramp() -> None:
    """An edge that moves by 8 pixels during the exposure: light rises linearly over 8 pixels, in linear light."""
    effect = MotionBlur(1.0, 64)
    columns = torch.arange(40) + 0.5
    pictures = [(columns > 20 + 8 * float(t)).float().expand(3, 40) for t in effect.instants()]
    expected = ((columns - 16) / 8).clamp(0, 1)
    torch.testing.assert_close(torch.stack(pictures).mean(0)[0], expected, atol=0.01, rtol=0)


# ---- sensor noise


@pytest.mark.parametrize("strength", STRENGTHS)
@pytest.mark.parametrize("level", [0.02, 0.3, 0.9])
def test_noise_has_the_variance_of_its_formula(strength: str, level: float) -> None:
    effect = preset("sensor_noise", strength)
    flat = np.full((120, 120, 3), level, dtype=np.float32)
    noisy = effect.forward(flat, np.random.default_rng(0))
    variance = level / effect.well + (effect.read / effect.well) ** 2
    assert noisy.mean() == pytest.approx(level, abs=4 * np.sqrt(variance / flat.size))
    assert noisy.var() == pytest.approx(variance, rel=0.04)


def test_a_full_well_clips_before_it_is_noisy() -> None:
    noisy = SensorNoise(1000, 0).forward(np.full((50, 50, 3), 3.0), np.random.default_rng(0))
    assert noisy.mean() == pytest.approx(1, abs=0.01)


# ---- compression


def test_compression_is_jpeg_with_its_quality() -> None:
    picture = (scene(3).numpy() * 255).astype(np.uint8)
    picture = cv2.resize(picture, (160, 120), interpolation=cv2.INTER_CUBIC)
    errors, sizes = [], []
    for strength in STRENGTHS:
        data = preset("compression", strength).encode(picture)
        assert data[:2] == b"\xff\xd8" and data[-2:] == b"\xff\xd9"
        out = Compression.decode(data)
        assert out.shape == picture.shape and out.dtype == np.uint8
        errors.append(float(((out.astype(float) - picture) ** 2).mean()))
        sizes.append(len(data))
    assert errors == sorted(errors) and sizes == sorted(sizes, reverse=True)


def test_compression_rounds_each_cosine_to_its_table() -> None:
    """One grey block: the decoded coefficients are multiples of the quality's table (ITU-T T.81, annex K, scaled)."""
    v, u = np.mgrid[0:8, 0:8]
    wave = 128 + 50 * np.cos((2 * u + 1) * 3 * np.pi / 16) * np.cos((2 * v + 1) * 1 * np.pi / 16) + 7 * np.cos((2 * u + 1) * 7 * np.pi / 16)
    block = np.repeat(np.round(wave).astype(np.uint8)[..., None], 3, axis=2)
    out = Compression.decode(Compression(50).encode(block))[..., 0].astype(np.float32) - 128
    given = cv2.dct(block[..., 0].astype(np.float32) - 128)
    got = cv2.dct(out)
    table = {(1, 3): 19, (0, 7): 61, (0, 0): 16}  # luminance table at quality 50, [row][column]
    for (row, column), step in table.items():
        assert got[row, column] == pytest.approx(np.round(given[row, column] / step) * step, abs=2.0)
