"""Exposure and vignetting in one capture: each hides some of the other, so they are judged together."""

from __future__ import annotations

import numpy as np
import pytest

from fieldfuse.effects.light import BOTH, EXPOSURE, MARGIN, VIGNETTING, LightTracks, explain, exposure_evidence, spread

FRAMES = 30


def made(stops: float, corner: float, noise: float, seed: int = 0) -> LightTracks:
    """Points that wander over neighbouring pictures, which differ by `stops` and lose light to `corner`; `noise` stops an observation."""
    rng = np.random.default_rng(seed)
    points, long = 1500, 6
    first = rng.integers(0, FRAMES - long + 1, points)
    frame = (first[:, None] + np.arange(long)).ravel()
    start, end = rng.uniform(-1, 1, (2, points, 1))
    radius = np.abs(start + (end - start) * np.arange(long) / (long - 1)).ravel()
    gain = rng.normal(0, stops, FRAMES)
    light = rng.uniform(-4, -2.2, points).repeat(long) + gain[frame] + rng.normal(0, noise, len(frame))
    light += np.log2((1 + (corner**-0.5 - 1) * radius**2) ** -2)
    return LightTracks(np.exp2(light)[:, None] * np.ones(3), frame, np.arange(points).repeat(long), radius)


def test_nothing_is_told_of_noise() -> None:
    for seed in range(5):
        assert not explain(made(0.0, 1.0, 0.12, seed), FRAMES).kept


def test_each_alone_is_told() -> None:
    assert explain(made(0.3, 1.0, 0.08), FRAMES).kept == {EXPOSURE}
    found = explain(made(0.0, 0.35, 0.08), FRAMES)
    assert found.kept == {VIGNETTING} and found.corner == pytest.approx(0.35, abs=0.03)


def test_exposure_that_misses_its_margin_is_told_beside_vignetting() -> None:
    """As in a real video of a can on a table, whose pictures get darker to the corners and whose exposure drifts."""
    tracks = made(0.1, 0.4, 0.16)
    before = spread(tracks)
    drift = np.array(exposure_evidence(tracks, FRAMES).parameters["gain"])
    exposed = spread(LightTracks(tracks.linear / drift[tracks.frame], tracks.frame, tracks.point, tracks.radius))
    assert exposed > (1 - MARGIN[EXPOSURE]) * before
    found = explain(tracks, FRAMES)
    assert found.kept == {EXPOSURE, VIGNETTING}
    assert found.after[EXPOSURE] == found.after[VIGNETTING] < (1 - BOTH) * before
    assert found.after[EXPOSURE] > (1 - MARGIN[EXPOSURE]) * found.before[EXPOSURE]
    assert found.corner == pytest.approx(0.4, abs=0.03)


def test_vignetting_brings_no_gains_along() -> None:
    for seed in range(5):
        assert explain(made(0.02, 0.4, 0.12, seed), FRAMES).kept == {VIGNETTING}
