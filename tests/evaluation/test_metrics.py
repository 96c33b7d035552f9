"""Image and depth metrics: numbers known by hand, another library's, masks, ranges and symmetry; slow loops: `tests/stability/hard`."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldfuse.errors import InputError
from fieldfuse.evaluation.metrics import C1, DEPTH_KEYS, PSNR_CAP, depth_accuracy, depth_metrics, psnr, right_half_psnr, ssim
from tests.evaluation.samples import picture, ripple

# scikit-image 0.26 on `picture()` and `ripple(picture())`: peak_signal_noise_ratio(data_range=1) and structural_similarity(
# channel_axis=2, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1).
SKIMAGE_PSNR = 23.492674743623496
SKIMAGE_SSIM = 0.41511622025452893


def test_numbers_known_by_hand_and_of_scikit_image() -> None:
    image, dark, grey = picture(), np.full((5, 7, 3), 0.2), np.full((4, 4, 3), 0.5)
    assert psnr(image, image) == PSNR_CAP == 100 and ssim(image, image) == pytest.approx(1, abs=1e-12)
    assert psnr(dark + 0.1, dark) == pytest.approx(20)
    assert psnr(np.ones((4, 4, 3)), np.zeros((4, 4, 3))) == pytest.approx(0, abs=1e-12)
    assert psnr(np.full((4, 4, 3), 30, np.uint8), np.full((4, 4, 3), 40, np.uint8)) == pytest.approx(20 * np.log10(25.5))
    assert psnr(grey + 1e-9, grey) == PSNR_CAP and psnr(grey + 1e-4, grey) == pytest.approx(80)
    assert psnr(np.full_like(grey, np.nan), grey) == pytest.approx(-20 * np.log10(0.5))  # what is not finite counts as black
    assert ssim(np.zeros((20, 20, 3)), np.ones((20, 20, 3))) == pytest.approx(C1 / (1 + C1))
    assert psnr(ripple(image), image) == pytest.approx(SKIMAGE_PSNR, rel=1e-9)
    assert ssim(ripple(image), image) == pytest.approx(SKIMAGE_SSIM, rel=1e-9)


def test_masks_hide_differences_and_what_is_left_decides() -> None:
    truth = picture(40, 60)
    rendered = truth.copy()
    rendered[:, :20] = 0
    valid = np.arange(60) >= np.full((40, 1), 20)
    assert psnr(rendered, truth, valid) == PSNR_CAP and ssim(rendered, truth, valid) == pytest.approx(1, abs=1e-9)
    valid[:, 10:] = True
    assert psnr(rendered, truth, valid) < 30 and ssim(rendered, truth, valid) < 0.95  # type: ignore[operator]
    nothing = np.zeros((40, 60), bool)
    assert psnr(truth, truth, nothing) is None and ssim(truth, truth, nothing) is None
    nothing[:, :10] = True  # no whole window fits
    assert ssim(truth, truth, nothing) is None and psnr(truth, truth, nothing) == PSNR_CAP
    assert ssim(picture(10, 40), picture(10, 40)) is None


def test_sizes_must_agree() -> None:
    with pytest.raises(InputError, match="render at the size"):
        psnr(picture(20, 20), picture(20, 21))
    with pytest.raises(InputError, match="mask"):
        ssim(picture(20, 20), picture(20, 20), np.ones((20, 19), dtype=bool))
    with pytest.raises(InputError, match="height, width, 3"):
        psnr(np.zeros((20, 20)), np.zeros((20, 20)))
    with pytest.raises(InputError, match="both must be"):
        depth_metrics(np.ones((3, 3)), np.ones((3, 4)))
    with pytest.raises(InputError, match="mask"):
        depth_metrics(np.ones((3, 3)), np.ones((3, 3)), np.ones((4, 3), dtype=bool))


@given(seed=st.integers(0, 10**6), height=st.integers(11, 24), width=st.integers(11, 24), noise=st.floats(0, 2))
@settings(max_examples=40, deadline=None)
def test_ranges_and_symmetry(seed: int, height: int, width: int, noise: float) -> None:
    rng = np.random.default_rng(seed)
    first = rng.random((height, width, 3))
    second = first + noise * rng.standard_normal(first.shape)
    valid = rng.random((height, width)) < 0.9
    for metric, low, high in ((psnr, 0, PSNR_CAP), (ssim, -1, 1)):
        value = metric(first, second)
        assert value is not None and low <= value <= high and value == pytest.approx(metric(second, first), abs=1e-9)
        partly = metric(first, second, valid)
        assert partly is None or low <= partly <= high


@given(small=st.floats(0.001, 0.2), factor=st.floats(1.1, 3))
@settings(max_examples=25, deadline=None)
def test_more_noise_scores_lower(small: float, factor: float) -> None:
    noise = np.random.default_rng(0).standard_normal((24, 24, 3))
    truth = np.full((24, 24, 3), 0.5) + 0.1 * np.sin(np.arange(24) / 3)[:, None, None]
    near, far = truth + small * noise, truth + small * factor * noise
    assert psnr(near, truth) > psnr(far, truth) and ssim(near, truth) > ssim(far, truth)  # type: ignore[operator]


def test_the_left_half_corrects_colour_and_the_right_half_is_scored() -> None:
    rng = np.random.default_rng(0)
    truth = rng.uniform(0.2, 0.8, (20, 30, 3))
    assert right_half_psnr(0.5 * truth @ (np.eye(3) + 0.1) + 0.05, truth) > 80  # type: ignore[operator]
    blurred = np.broadcast_to(truth.mean((0, 1)), truth.shape) + rng.normal(0, 0.01, truth.shape)
    assert right_half_psnr(blurred, truth) < 20  # type: ignore[operator]
    rendered = truth.copy()
    rendered[:, 15:] *= 0.5  # only the half that is scored is wrong, which takes no part in the fit
    wrong = float(-10 * np.log10(((rendered - truth)[:, 15:] ** 2).mean()))
    assert right_half_psnr(rendered, truth) == pytest.approx(wrong, abs=1e-6)
    assert right_half_psnr(truth, truth, np.zeros((20, 30), dtype=bool)) is None


def test_depth_by_hand() -> None:
    found = depth_metrics(np.array([[1.1, 2.0, 2.0, 3.0]]), np.array([[1.0, 2.0, 4.0, 0.0]]))
    expected = {"abs_err": 2.1 / 3, "abs_rel": 0.6 / 3, "rmse": np.sqrt(4.01 / 3), "median_rel": 0.1, "within_5_percent": 1 / 3}
    expected |= {"delta_1": 2 / 3, "delta_2": 2 / 3, "delta_3": 2 / 3, "coverage": 1, "pixels": 3}  # a factor 2 is just outside 1.25³
    assert found == pytest.approx(expected)
    depth = np.linspace(0.5, 3, 20).reshape(4, 5)
    same = depth_metrics(depth, depth)
    assert same["abs_err"] == same["rmse"] == same["abs_rel"] == 0 and same["delta_1"] == same["coverage"] == 1


@pytest.mark.parametrize("missing", [0.0, -1.0, 1e-300, np.nan, np.inf])
def test_missing_depth_is_not_compared(missing: float) -> None:
    truth = np.full((4, 5), 2.0)
    rendered = truth.copy()
    rendered[:2] = missing
    found, swapped = depth_metrics(rendered, truth), depth_metrics(truth, rendered)
    assert found["coverage"] == 0.5 and found["pixels"] == 10 and found["abs_err"] == 0
    assert swapped["coverage"] == 1 and swapped["pixels"] == 10


def test_depth_of_nothing_is_none() -> None:
    full, nothing = np.ones((3, 3)), np.zeros((3, 3))
    for rendered, truth, valid in ((full, nothing, None), (nothing, nothing, None), (full, full, nothing.astype(bool))):
        assert depth_metrics(rendered, truth, valid) == {**dict.fromkeys(DEPTH_KEYS), "pixels": 0}
    unseen = depth_metrics(nothing, full)
    assert unseen["coverage"] == 0 and unseen["abs_err"] is None and unseen["delta_1"] is None
    assert depth_metrics(np.zeros((0, 0)), np.zeros((0, 0)))["coverage"] is None


@given(seed=st.integers(0, 10**6), scale=st.floats(1e-3, 1e3), noise=st.just(0.0) | st.floats(1e-3, 2), holes=st.floats(0, 1))
@settings(max_examples=60, deadline=None)
def test_depth_ranges_symmetry_scale(seed: int, scale: float, noise: float, holes: float) -> None:
    rng = np.random.default_rng(seed)
    truth = rng.uniform(0.1, 5, (6, 7)) * (rng.random((6, 7)) >= holes)
    rendered = rng.uniform(0.1, 5, (6, 7)) * noise
    there, back = depth_metrics(rendered, truth), depth_metrics(truth, rendered)
    scaled = depth_metrics(rendered * scale, truth * scale)
    if there["pixels"] == 0:
        assert there["abs_err"] is None
        return
    assert 0 <= there["delta_1"] <= there["delta_2"] <= there["delta_3"] <= 1 and 0 <= there["coverage"] <= 1
    assert 0 <= there["abs_err"] <= there["rmse"] * (1 + 1e-12)
    for key in ("abs_err", "rmse", "delta_3"):
        assert there[key] == pytest.approx(back[key])
    for key, factor in (("abs_err", scale), ("rmse", scale), ("abs_rel", 1), ("median_rel", 1)):
        assert scaled[key] == pytest.approx(there[key] * factor)


def test_depth_accuracy_counts_what_is_missing_as_wrong() -> None:
    truth, rendered = np.full((2, 2), 1.0), np.array([[1.005, 1.03], [0, np.nan]])
    assert depth_accuracy(rendered, truth, 1.0) == {"abs_err": pytest.approx(0.0175), "acc_1": 0.25, "acc_5": 0.5}
    assert depth_accuracy(rendered, truth, 1.0, np.array([[True, False], [False, False]]))["acc_1"] == 1
    assert depth_accuracy(rendered, np.zeros((2, 2)), 1.0) == {"abs_err": None, "acc_1": None, "acc_5": None}
