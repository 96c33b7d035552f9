"""Small parts of the compiled kernels."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from toolkit.render import kernels as K


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
