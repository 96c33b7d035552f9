"""Small parts of the compiled kernels: numbers of two bytes, distances to bricks, rows of features as vectors."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit
from scipy.ndimage import distance_transform_cdt

from fieldfuse.backends.numba import common as K
from fieldfuse.backends.numba import rows as row
from fieldfuse.backends.numba.volume import chessboard_distance
from fieldfuse.render.numba_renderer import FARTHEST


@njit
def halves(values: np.ndarray, out: np.ndarray) -> None:
    for i in range(len(values)):
        out[i] = K.to_half(values[i])


@njit
def numbers(values: np.ndarray, out: np.ndarray) -> None:
    for i in range(len(values)):
        out[i] = K.of_half(values[i])


@settings(max_examples=200, deadline=None)
@given(st.lists(st.floats(width=32, allow_nan=False), min_size=1, max_size=40))
def test_numbers_of_two_bytes_are_those_of_torch(values: list[float]) -> None:
    """bfloat16, ties to the even one, infinities and numbers that round to them included; and the way back is exact."""
    given = np.array(values, np.float32)
    got, back = np.empty(len(given), np.uint16), np.empty(len(given), np.float32)
    halves(given, got)
    numbers(got, back)
    expected = torch.from_numpy(given).bfloat16()
    np.testing.assert_array_equal(got.view(np.int16), expected.view(torch.int16).numpy())
    np.testing.assert_array_equal(back, expected.float().numpy())


@settings(max_examples=40, deadline=None)
@given(st.tuples(*[st.integers(1, 12)] * 3), st.sampled_from([0.0, 0.01, 0.2, 1.0]), st.integers(0, 1000))
def test_distances_of_bricks_are_those_of_the_chessboard(shape: tuple[int, int, int], share: float, seed: int) -> None:
    filled = np.random.default_rng(seed).random(shape) < share
    bricks = np.where(filled, np.uint8(0), np.uint8(FARTHEST))
    chessboard_distance(bricks, FARTHEST)
    exact = distance_transform_cdt(~filled, metric="chessboard") if filled.any() else np.full(shape, FARTHEST)
    np.testing.assert_array_equal(bricks, np.minimum(exact, FARTHEST))


@njit(**{**K.LEAF, "cache": False})
def _all(width: Any, table: Any, rows: Any, weights: Any, mean: Any, sums: Any, out: Any) -> Any:
    for at in range(len(rows)):
        row.mix(width, table, rows, weights, at, out)
        row.add_to(width, mean, out, at, weights[at, 0])
    row.put_row(width, sums, np.int64(1), mean, np.float32(0.5))
    row.add_row(width, sums, np.int64(1), mean, np.float32(0.25))
    return row.product_with(width, sums, np.int64(1), mean)


@pytest.mark.parametrize("channels", [3, 16])
def test_rows_against_numpy(channels: int) -> None:
    rng = np.random.default_rng(channels)
    table, weights = (rng.normal(size=shape).astype(np.float32) for shape in ((20, channels), (6, 8)))
    rows = rng.integers(0, 20, (6, 8), dtype=np.int32)
    mean, sums, out = (np.full(shape, np.float32(7)) for shape in (channels, (3, channels), (7, channels)))
    found = _all((0,) * channels, table, rows, weights, mean, sums, out)
    mixed = np.einsum("sk,skc->sc", weights.astype(float), table[rows])
    wanted = 7 + weights[:, 0].astype(float) @ mixed
    np.testing.assert_allclose(out[:6], mixed, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(mean, wanted, rtol=1e-5, atol=1e-3)
    np.testing.assert_allclose(sums[1], 0.75 * mean, rtol=1e-6)
    assert (sums[[0, 2]] == 7).all() and (out[6] == 7).all()
    assert found == pytest.approx(float((sums[1].astype(float) * mean).sum()), rel=1e-5)
