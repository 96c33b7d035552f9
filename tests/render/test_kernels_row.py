"""Rows of features as vectors, against NumPy: any number of channels, and nothing beside the row is touched."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numba import njit

from fieldfuse.backends.numba import rows as row
from fieldfuse.backends.numba.common import LEAF


@njit(**{**LEAF, "cache": False})
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
