"""Metrics where they have nothing to compare, or nothing to find: defined values, None or a sentence, never NaN."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldfuse.camera import Array
from fieldfuse.evaluation.metrics import DEPTH_KEYS, PSNR_CAP, depth_metrics, psnr, ssim
from tests.stability.hard import reference
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
