"""Depth metrics: hand-made numbers, missing depth, ranges, symmetry and scale."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldfuse.errors import InputError
from fieldfuse.evaluation.metrics import DEPTH_KEYS, depth_metrics


def test_by_hand() -> None:
    truth = np.array([[1.0, 2.0, 4.0, 0.0]])
    rendered = np.array([[1.1, 2.0, 2.0, 3.0]])
    found = depth_metrics(rendered, truth)
    assert found["pixels"] == 3
    assert found["coverage"] == 1
    assert found["abs_err"] == pytest.approx((0.1 + 0 + 2) / 3)
    assert found["abs_rel"] == pytest.approx((0.1 + 0 + 0.5) / 3)
    assert found["rmse"] == pytest.approx(np.sqrt((0.01 + 4) / 3))
    assert found["median_rel"] == pytest.approx(0.1)
    assert found["delta_1"] == found["delta_2"] == pytest.approx(2 / 3)
    assert found["delta_3"] == pytest.approx(2 / 3)  # a factor 2 lies just outside 1.25³
    assert found["within_5_percent"] == pytest.approx(1 / 3)


def test_identical() -> None:
    depth = np.linspace(0.5, 3, 20).reshape(4, 5)
    found = depth_metrics(depth, depth)
    assert found["abs_err"] == found["rmse"] == found["abs_rel"] == found["median_rel"] == 0
    assert found["delta_1"] == found["within_5_percent"] == found["coverage"] == 1


@pytest.mark.parametrize("missing", [0.0, -1.0, 1e-300, np.nan, np.inf])
def test_missing_depth_is_not_compared(missing: float) -> None:
    truth = np.full((4, 5), 2.0)
    rendered = truth.copy()
    rendered[:2] = missing
    found = depth_metrics(rendered, truth)
    assert found["coverage"] == 0.5 and found["pixels"] == 10 and found["abs_err"] == 0
    swapped = depth_metrics(truth, rendered)
    assert swapped["coverage"] == 1 and swapped["pixels"] == 10


def test_empty_is_none_never_nan() -> None:
    full, nothing = np.ones((3, 3)), np.zeros((3, 3))
    for rendered, truth, valid in ((full, nothing, None), (nothing, nothing, None), (full, full, nothing.astype(bool))):
        assert depth_metrics(rendered, truth, valid) == {**dict.fromkeys(DEPTH_KEYS), "pixels": 0}
    unseen = depth_metrics(nothing, full)
    assert unseen["coverage"] == 0 and unseen["abs_err"] is None and unseen["delta_1"] is None
    assert depth_metrics(np.zeros((0, 0)), np.zeros((0, 0)))["coverage"] is None


def test_sizes_must_agree() -> None:
    with pytest.raises(InputError):
        depth_metrics(np.ones((3, 3)), np.ones((3, 4)))
    with pytest.raises(InputError, match="mask"):
        depth_metrics(np.ones((3, 3)), np.ones((3, 3)), np.ones((4, 3), dtype=bool))


@given(seed=st.integers(0, 10**6), scale=st.floats(1e-3, 1e3), noise=st.just(0.0) | st.floats(1e-3, 2), holes=st.floats(0, 1))
@settings(max_examples=80, deadline=None)
def test_ranges_symmetry_scale(seed: int, scale: float, noise: float, holes: float) -> None:
    rng = np.random.default_rng(seed)
    truth = rng.uniform(0.1, 5, (6, 7)) * (rng.random((6, 7)) >= holes)
    rendered = rng.uniform(0.1, 5, (6, 7)) * noise
    there, back = depth_metrics(rendered, truth), depth_metrics(truth, rendered)
    scaled = depth_metrics(rendered * scale, truth * scale)
    for key in ("delta_1", "delta_2", "delta_3", "within_5_percent", "coverage"):
        assert there[key] is None or 0 <= there[key] <= 1
    if there["pixels"] == 0:
        assert there["abs_err"] is None
        return
    assert there["delta_1"] <= there["delta_2"] <= there["delta_3"]
    assert 0 <= there["abs_err"] <= there["rmse"] * (1 + 1e-12)
    for key in ("abs_err", "rmse", "delta_3"):
        assert there[key] == pytest.approx(back[key])
    for key in ("abs_err", "rmse"):
        assert scaled[key] == pytest.approx(there[key] * scale)
    for key in ("abs_rel", "median_rel"):
        assert scaled[key] == pytest.approx(there[key])
