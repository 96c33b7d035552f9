"""Metrics where they have nothing to compare, or nothing to find: defined values, None or a sentence, never NaN."""

from __future__ import annotations

import json
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.capture.types import Views
from fieldfuse.errors import InputError
from fieldfuse.evaluation.metrics import DEPTH_KEYS, PSNR_CAP, depth_metrics, psnr, ssim
from fieldfuse.evaluation.perceptual import lpips, lpips_available
from fieldfuse.evaluation.score import nearest_image_scores, score_views
from tests.stability.hard import reference
from tests.stability.hard.errors import refused
from tests.stability.hard.ranges import QUICK
from tests.stability.hard.within import Within

GROUP = "metrics"
SHAPE = (24, 32, 3)


def pictures() -> dict[str, Array]:
    """Pictures that have broken metrics elsewhere."""
    rng = np.random.default_rng(0)
    one = np.zeros(SHAPE, np.uint8)
    one[12, 16] = 255
    damaged = rng.random(SHAPE)
    damaged[3], damaged[4], damaged[5] = np.nan, np.inf, -np.inf
    return {
        "black": np.zeros(SHAPE, np.uint8),
        "white": np.full(SHAPE, 255, np.uint8),
        "grey": np.full(SHAPE, 0.5, np.float32),
        "one bright pixel": one,
        "noise": (rng.random(SHAPE) * 255).astype(np.uint8),
        "beyond [0, 1]": rng.normal(size=SHAPE) * 1e6,
        "with NaN and infinities": damaged,
        "of denormal numbers": np.full(SHAPE, 1e-310),
    }


def unclear(value: Any) -> int:
    """How many numbers in nested results are NaN or infinite."""
    if isinstance(value, dict):
        return sum(unclear(entry) for entry in value.values())
    if isinstance(value, list | tuple):
        return sum(unclear(entry) for entry in value)
    return int(isinstance(value, float) and not math.isfinite(value))


def test_written_out(within: Within) -> None:
    """PSNR and SSIM against sums written out."""
    rng = np.random.default_rng(4)
    smooth = 0.5 + 0.4 * np.sin(np.arange(20)[:, None] / 3) * np.cos(np.arange(17) / 4)
    pictures = {
        "noise": (rng.random((20, 17)), rng.random((20, 17))),
        "almost alike": (smooth, smooth + 1e-6 * rng.normal(size=smooth.shape)),
        "constant": (np.full((20, 17), 0.3), np.full((20, 17), 0.30001)),
        "dark": (smooth * 1e-4, smooth * 1.2e-4),
    }
    for name, (first, second) in pictures.items():
        a, b = np.repeat(first[..., None], 3, axis=2), np.repeat(second[..., None], 3, axis=2)
        error = math.fsum((x - y) ** 2 for x, y in zip(first.ravel().tolist(), second.ravel().tolist(), strict=True)) / first.size
        wanted = min(PSNR_CAP, -10 * math.log10(max(error, 1e-30)))
        got, alike = psnr(a, b), ssim(a, b)
        assert got is not None and alike is not None
        within(f"{name}: PSNR, dB", abs(got - wanted), 1e-9)
        within(f"{name}: SSIM", abs(alike - reference.ssim(first.tolist(), second.tolist())), 1e-10)


def test_depths(within: Within) -> None:
    """Depth with NaN, infinities, 0 and 65535."""
    truth = np.linspace(0.5, 8, 300).reshape(15, 20)
    awkward = {
        "NaN": np.full_like(truth, np.nan),
        "infinite": np.full_like(truth, np.inf),
        "zero": np.zeros_like(truth),
        "negative": -truth,
        "65535": np.full_like(truth, 65535.0),
        "denormal": np.full_like(truth, 5e-324),
        "huge": np.full_like(truth, 1e308),
        "good": truth,
    }
    for name, depth in awkward.items():
        results = [depth_metrics(depth, other) for other in awkward.values()] + [depth_metrics(other, depth) for other in awkward.values()]
        within(f"{name} against all: NaN or infinity", float(unclear(results)), 0.0)
    same = depth_metrics(truth, truth)
    within("the same depth: errors", sum(same[key] for key in ("abs_err", "abs_rel", "rmse", "median_rel")), 0.0)
    within("the same depth: shares below 1", sum(1 - same[key] for key in ("delta_1", "delta_2", "delta_3", "coverage")), 0.0)
    none = depth_metrics(truth, truth, np.zeros_like(truth, dtype=bool))
    within("numbers for an empty mask", float(sum(none[key] is not None for key in DEPTH_KEYS)), 0.0)
    mixed = truth.copy()
    mixed[0], mixed[1], mixed[2] = np.nan, np.inf, 0
    seen = depth_metrics(mixed, truth)
    within("three of fifteen rows missing: coverage", abs(seen["coverage"] - 0.8), 1e-12)
    within("three of fifteen rows missing: error of the others", seen["abs_err"], 0.0)


NUMBERS = st.sampled_from([0.0, -0.0, 1.0, 0.5, -1.0, 255.0, 65535.0, 1e-310, 1e-20, 1e20, 1e308, math.nan, math.inf, -math.inf])


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@QUICK
@given(st.lists(NUMBERS, min_size=2, max_size=2), st.integers(1, 14), st.integers(1, 14), st.booleans())
def test_metrics_are_numbers_or_none(values: list[float], height: int, width: int, striped: bool) -> None:
    first, second = (np.full((height, width, 3), value) for value in values)
    if striped:
        first[::2] = 0.25
    results = [psnr(first, second), ssim(first, second), depth_metrics(first[..., 0], second[..., 0])]
    assert unclear(results) == 0
    json.dumps(results, allow_nan=False)


def test_pairs(within: Within) -> None:
    """PSNR and SSIM of every pair of awkward pictures."""
    shown = pictures()
    numbers = [f(a, b) for f in (psnr, ssim) for a in shown.values() for b in shown.values()]
    missing = float(sum(number is None for number in numbers))
    within("NaN or infinity", float(unclear([number or 0.0 for number in numbers])), 0.0)
    within("no number", missing, 0.0)
    for name, picture in shown.items():
        same, alike = psnr(picture, picture), ssim(picture, picture)
        assert same is not None and alike is not None
        within(f"{name} with itself: PSNR below the cap", PSNR_CAP - same, 0.0)
        within(f"{name} with itself: SSIM below 1", abs(1 - alike), 1e-12)


def test_nothing_to_compare(within: Within) -> None:
    """Empty masks, single rows and columns, one pixel, nothing at all."""
    a, b = pictures()["noise"], pictures()["grey"]
    empty, full = np.zeros(SHAPE[:2], bool), np.ones(SHAPE[:2], bool)
    one = empty.copy()
    one[5, 7] = True
    within("numbers for an empty mask", float(sum(f(a, b, empty) is not None for f in (psnr, ssim, lpips))), 0.0)
    within("SSIM of one pixel", float(ssim(a, b, one) is not None), 0.0)
    within("no PSNR of one pixel", float(psnr(a, b, one) is None), 0.0)
    within("a full mask changes PSNR", abs((psnr(a, b, full) or 0) - (psnr(a, b) or 1)), 0.0)
    within("a mask of another size taken", refused(lambda: psnr(a, b, full[:-1]), InputError), 0.0)
    within("pictures of two sizes taken", refused(lambda: ssim(a, b[:-1]), InputError), 0.0)
    for shape in ((1, 32, 3), (24, 1, 3), (1, 1, 3), (10, 40, 3)):
        first, second = np.zeros(shape), np.full(shape, 0.25)
        within(f"{shape[1]}×{shape[0]}: PSNR, dB", abs((psnr(first, second) or 0) - 12.041199826559248), 1e-9)
        within(f"{shape[1]}×{shape[0]}: SSIM given", float(ssim(first, second) is not None), 0.0)
    within("numbers for pictures without pixels", float(psnr(np.zeros((0, 5, 3)), np.zeros((0, 5, 3))) is not None), 0.0)


def test_scores(within: Within) -> None:
    """Scores of views without depth, mask, training picture or pixel are JSON."""
    camera = Intrinsics(32, 24, 30.0, 30.0, 16.0, 12.0)
    shown = list(pictures().values())
    truth = [shown[index] for index in (0, 1, 3, 4)]
    empty = np.zeros(SHAPE[:2], bool)
    views = Views(
        [str(i) for i in range(4)],
        truth,
        [camera] * 4,
        np.tile(np.eye(4), (4, 1, 1)),
        np.ones(4, bool),
        valid=[None, empty, None, None],
        depths=[None, np.full(SHAPE[:2], np.nan, np.float32), np.zeros(SHAPE[:2], np.float32), np.ones(SHAPE[:2], np.float32)],
    )
    wrong = 0
    for picture in shown:
        for depth in (np.zeros(SHAPE[:2]), np.full(SHAPE[:2], np.nan)):
            for mask in (None, empty):
                rendered = SimpleNamespace(rgb=picture, depth=depth, **({} if mask is None else {"mask": mask}))
                result = score_views([rendered] * 4, views, range(4), [0.0] * 4)
                json.dumps(result, allow_nan=False)
                wrong += unclear(result)
    nearest = nearest_image_scores(views, range(4))
    json.dumps(nearest, allow_nan=False)
    nothing = score_views([], views, [])
    within("NaN or infinity", float(wrong + unclear(nearest) + unclear(nothing)), 0.0)
    within("a nearest picture where none is for training", float(nearest["psnr"] is not None), 0.0)
    within("a mean of nothing", float(nothing["psnr"] is not None), 0.0)


def test_perceptual(within: Within) -> None:
    """LPIPS of constant, identical and damaged pictures."""
    if not lpips_available():
        within("numbers without weights", float(lpips(pictures()["black"], pictures()["white"]) is not None), 0.0)
    big = {name: np.tile(picture, (2, 2, 1)) for name, picture in pictures().items()}
    numbers = [lpips(a, b) for a in list(big.values())[:6] for b in list(big.values())[5:]]
    own = [lpips(picture, picture) or 0.0 for picture in big.values()]
    within("NaN or infinity", float(unclear(numbers) + sum(number is None for number in numbers)), 0.0)
    within("pictures with themselves", float(max(own)), 1e-6)
    within("numbers of pictures too small", float(lpips(np.zeros((8, 8, 3)), np.ones((8, 8, 3))) is not None), 0.0)
