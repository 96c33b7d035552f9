"""Small parts of the compiled kernels."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit
from scipy.ndimage import distance_transform_cdt

from fieldfuse.backends.numba import common as K
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
