"""PSNR and SSIM against constants known by hand and another library's numbers; against slow loops: `tests/stability/hard`."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldfuse.errors import InputError
from fieldfuse.evaluation.metrics import C1, PSNR_CAP, psnr, ssim
from tests.evaluation.samples import picture, ripple

# scikit-image 0.26 on `picture()` and `ripple(picture())`: peak_signal_noise_ratio(data_range=1) and structural_similarity(
# channel_axis=2, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1).
SKIMAGE_PSNR = 23.492674743623496
SKIMAGE_SSIM = 0.41511622025452893


def test_identical_pictures() -> None:
    image = picture()
    assert psnr(image, image) == PSNR_CAP == 100
    assert ssim(image, image) == pytest.approx(1, abs=1e-12)


def test_psnr_of_a_constant_difference() -> None:
    dark = np.full((5, 7, 3), 0.2)
    assert psnr(dark + 0.1, dark) == pytest.approx(20)
    assert psnr(np.ones((4, 4, 3)), np.zeros((4, 4, 3))) == pytest.approx(0, abs=1e-12)
    assert psnr(np.full((4, 4, 3), 30, np.uint8), np.full((4, 4, 3), 40, np.uint8)) == pytest.approx(20 * np.log10(25.5))


def test_psnr_near_identical_is_capped() -> None:
    image = np.full((4, 4, 3), 0.5)
    assert psnr(image + 1e-9, image) == PSNR_CAP
    assert psnr(image + 1e-4, image) == pytest.approx(80)


def test_agrees_with_scikit_image() -> None:
    image = picture()
    assert psnr(ripple(image), image) == pytest.approx(SKIMAGE_PSNR, rel=1e-9)
    assert ssim(ripple(image), image) == pytest.approx(SKIMAGE_SSIM, rel=1e-9)


def test_ssim_of_black_and_white() -> None:
    assert ssim(np.zeros((20, 20, 3)), np.ones((20, 20, 3))) == pytest.approx(C1 / (1 + C1))


def test_masks_hide_differences() -> None:
    truth = picture(40, 60)
    rendered = truth.copy()
    rendered[:, :20] = 0
    valid = np.zeros((40, 60), dtype=bool)
    valid[:, 20:] = True
    assert psnr(rendered, truth, valid) == PSNR_CAP
    assert ssim(rendered, truth, valid) == pytest.approx(1, abs=1e-9)
    valid[:, 10:] = True
    partly = psnr(rendered, truth, valid)
    assert partly is not None and partly < 30
    assert ssim(rendered, truth, valid) < 0.95  # type: ignore[operator]


def test_nothing_to_compare_is_none() -> None:
    image, nothing = picture(20, 20), np.zeros((20, 20), dtype=bool)
    assert psnr(image, image, nothing) is None
    assert ssim(image, image, nothing) is None
    thin = nothing.copy()
    thin[:, :10] = True  # no whole window fits
    assert ssim(image, image, thin) is None
    assert psnr(image, image, thin) == PSNR_CAP
    assert ssim(picture(10, 40), picture(10, 40)) is None


def test_what_is_not_finite_counts_as_black() -> None:
    truth = np.full((12, 12, 3), 0.5)
    broken = truth.copy()
    broken[:] = np.nan
    assert psnr(broken, truth) == pytest.approx(-20 * np.log10(0.5))
    broken[:] = np.inf
    assert np.isfinite(ssim(broken, truth))  # type: ignore[arg-type]


def test_sizes_must_agree() -> None:
    with pytest.raises(InputError, match="render at the size"):
        psnr(picture(20, 20), picture(20, 21))
    with pytest.raises(InputError, match="mask"):
        ssim(picture(20, 20), picture(20, 20), np.ones((20, 19), dtype=bool))
    with pytest.raises(InputError, match="height, width, 3"):
        psnr(np.zeros((20, 20)), np.zeros((20, 20)))


@given(seed=st.integers(0, 10**6), height=st.integers(11, 24), width=st.integers(11, 24), noise=st.floats(0, 2))
@settings(max_examples=60, deadline=None)
def test_ranges_and_symmetry(seed: int, height: int, width: int, noise: float) -> None:
    rng = np.random.default_rng(seed)
    first = rng.random((height, width, 3))
    second = first + noise * rng.standard_normal(first.shape)
    valid = rng.random((height, width)) < 0.9
    for metric, low, high in ((psnr, 0, PSNR_CAP), (ssim, -1, 1)):
        value = metric(first, second)
        assert value is not None and low <= value <= high
        assert value == pytest.approx(metric(second, first), abs=1e-9)
        partly = metric(first, second, valid)
        assert partly is None or low <= partly <= high


@given(small=st.floats(0.001, 0.2), factor=st.floats(1.1, 3))
@settings(max_examples=25, deadline=None)
def test_more_noise_scores_lower(small: float, factor: float) -> None:
    noise = np.random.default_rng(0).standard_normal((24, 24, 3))
    truth = np.full((24, 24, 3), 0.5) + 0.1 * np.sin(np.arange(24) / 3)[:, None, None]
    near, far = truth + small * noise, truth + small * factor * noise
    assert psnr(near, truth) > psnr(far, truth)  # type: ignore[operator]
    assert ssim(near, truth) > ssim(far, truth)  # type: ignore[operator]
