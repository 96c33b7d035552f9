"""Effects on light: each forward model against its formula at known pixels, each inverse against its forward model."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldfuse.camera import Intrinsics
from fieldfuse.effects.effect_specs import STRENGTHS, preset
from fieldfuse.effects.models import Compression, Exposure, MotionBlur, SensorNoise, decode_srgb, encode_srgb, to_bytes
from fieldfuse.effects.scenery import Background, Highlights
from fieldfuse.tone import share, square_radius

CAMERA = Intrinsics(40, 30, 35.0, 35.0, 20.0, 15.0)


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


def test_bytes_are_rounded_to_the_nearest() -> None:
    assert to_bytes(torch.tensor([0.0, 0.4999 / 255, 0.501 / 255, 1.0, 2.0])).tolist() == [0, 0, 1, 255, 255]


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
    square = square_radius(CAMERA)
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
