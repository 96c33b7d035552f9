"""Semi-global matching, against its definition."""

from __future__ import annotations

import numpy as np
import pytest

from fieldfuse.camera import Array
from fieldfuse.stereo.smooth import PATHS, SOFT_EDGE, smoothed_planes


def slow_total(cost: Array, grey: Array, small: float, large: float) -> Array:
    """Costs along all paths, pixel by pixel from the definition."""
    height, width, planes = cost.shape
    total = np.zeros(cost.shape)
    for down, right in PATHS:
        line = np.full(cost.shape, np.nan)
        rows = range(height) if down >= 0 else range(height - 1, -1, -1)
        columns = range(width) if right >= 0 else range(width - 1, -1, -1)
        for y in rows:
            for x in columns:
                before = y - down, x - right
                if not (0 <= before[0] < height and 0 <= before[1] < width):
                    line[y, x] = cost[y, x]
                    continue
                past = line[before]
                jump = max(large / (1 + abs(grey[y, x] - grey[before]) / SOFT_EDGE), 1.5 * small)
                for d in range(planes):
                    options = [past[d], past.min() + jump]
                    options += [past[n] + small for n in (d - 1, d + 1) if 0 <= n < planes]
                    line[y, x, d] = cost[y, x, d] + min(options) - past.min()
        total += line
    return total


def test_semi_global_matching_against_its_definition() -> None:
    rng = np.random.default_rng(2)
    cost, grey = rng.random((7, 9, 6)).astype(np.float32), rng.uniform(0, 60, (7, 9)).astype(np.float32)
    total = slow_total(cost, grey, 0.05, 0.8)
    plane, margin = smoothed_planes(cost, grey, 0.05, 0.8)
    assert np.array_equal(np.abs(plane - total.argmin(axis=2)) <= 0.5, np.ones((7, 9), bool))
    best = total.argmin(axis=2)
    for y, x in np.ndindex(7, 9):
        apart = [total[y, x, d] for d in range(6) if abs(d - best[y, x]) > 1]
        assert margin[y, x] == pytest.approx((min(apart) - total[y, x].min()) / min(apart), abs=1e-4)


def test_fractions_of_a_plane() -> None:
    planes = np.arange(12)
    true = np.linspace(3.0, 8.0, 60).reshape(6, 10)
    cost = ((planes - true[..., None]) ** 2 / 400).astype(np.float32)
    plane, _ = smoothed_planes(cost, np.zeros((6, 10), np.float32), small=0.0, large=0.0)
    assert np.abs(plane - true).max() < 0.02
