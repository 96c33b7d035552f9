"""Evidence of exposure and vignetting in simulated captures and made-up tracks: found when it is there, and of the right size.

In one capture each hides some of the other, so they are judged together.
"""

from __future__ import annotations

import numpy as np
import pytest

from fieldfuse.effects.effect_specs import preset
from fieldfuse.effects.evidence import without_points_and_frames
from fieldfuse.effects.light import BOTH, EXPOSURE, MARGIN, VIGNETTING, LightTracks, explain, exposure_evidence, spread, vignetting_evidence
from fieldfuse.simulate.materials import TextureBank, texture_bank
from tests.effects.filmed import FRAMES, Filmed, film_tracks

SEEDS = (11, 12)
MANY = 30  # frames of what is made up


@pytest.fixture(scope="module")
def bank() -> TextureBank:
    return texture_bank(size=256)


@pytest.fixture(scope="module")
def clean(bank: TextureBank) -> list[Filmed]:
    return [film_tracks(bank, seed, []) for seed in SEEDS]


def test_constants_are_taken_out_exactly() -> None:
    """Made-up values of points plus frames leave nothing, and give the frames' constants back."""
    rng = np.random.default_rng(0)
    frame, point = rng.integers(0, 7, 900), rng.integers(0, 5000, 900) // 10
    frames, points = rng.normal(0, 1, (7, 2)), rng.normal(0, 3, (500, 2))
    frames -= frames.mean(0)
    left, constants = without_points_and_frames(frames[frame] + points[point], frame, point, rng.uniform(0.5, 1, 900), 7)
    np.testing.assert_allclose(left, 0, atol=2e-4)
    np.testing.assert_allclose(constants, frames, atol=2e-4)


def test_dark_clipped_and_single_observations_are_not_used() -> None:
    linear = np.full((6, 3), 0.4)
    linear[1, 2], linear[2, 0] = 0.95, 0.001
    used = LightTracks(linear, np.arange(6), np.array([0, 0, 0, 5, 5, 7]), np.zeros(6)).usable()
    assert used.frame.tolist() == [3, 4] and used.point.tolist() == [0, 0]


def test_a_clean_capture_gives_no_evidence(clean: list[Filmed]) -> None:
    for filmed in clean:
        for found in (exposure_evidence(filmed.tracks, FRAMES), vignetting_evidence(filmed.tracks, FRAMES)):
            assert not found.found, found.reason


@pytest.mark.parametrize(("seed", "strength"), [(12, "weak"), (11, "medium"), (12, "strong")])
def test_exposure_drift_is_found_and_measured(bank: TextureBank, seed: int, strength: str) -> None:
    filmed = film_tracks(bank, seed, [f"exposure:{strength}"])
    found = exposure_evidence(filmed.tracks, FRAMES)
    assert found.found, found.reason
    truth = np.log2([filmed.film.shot(index).facts["exposure"]["gain"] for index in range(0, FRAMES, 4)])
    got = np.log2(found.parameters["gain"])[::4]
    off = (got - got.mean(0)) - (truth - truth.mean(0))
    assert np.abs(off).max() < 0.12 * preset("exposure", strength).stops + 0.05
    assert not vignetting_evidence(filmed.tracks, FRAMES).found


@pytest.mark.parametrize(("seed", "strength"), [(11, "weak"), (12, "medium"), (11, "strong")])
def test_vignetting_is_found_and_measured(bank: TextureBank, seed: int, strength: str) -> None:
    filmed = film_tracks(bank, seed, [f"vignetting:{strength}"])
    found = vignetting_evidence(filmed.tracks, FRAMES)
    assert found.found, found.reason
    assert found.parameters["corner"] == pytest.approx(preset("vignetting", strength).corner, abs=0.06)


def test_vignetting_is_not_taken_for_drift(bank: TextureBank) -> None:
    """Along a corridor points move outwards in every frame; with the vignetting that was found taken out, no drift is left."""
    filmed = film_tracks(bank, 32, ["vignetting:medium"], kind="corridor")
    found = vignetting_evidence(filmed.tracks, FRAMES)
    left = filmed.tracks.without_vignetting(found.parameters["corner"])
    before, after = exposure_evidence(filmed.tracks, FRAMES), exposure_evidence(left, FRAMES)
    assert found.found and before.number > 0.06
    assert not after.found, after.reason
    assert not vignetting_evidence(left, FRAMES).found


def test_too_little_to_tell_is_said(clean: list[Filmed]) -> None:
    tracks = clean[0].tracks
    few = LightTracks(tracks.linear[:5], tracks.frame[:5], tracks.point[:5], tracks.radius[:5])
    for found in (exposure_evidence(few, FRAMES), vignetting_evidence(few, FRAMES)):
        assert not found.found and "too few" in found.reason


# ------------------------------------------------------------------------------------------- both together


def wandering(stops: float, corner: float, noise: float, seed: int = 0) -> LightTracks:
    """Points that wander over neighbouring pictures, which differ by `stops` and lose light to `corner`; `noise` stops an observation."""
    rng = np.random.default_rng(seed)
    points, long = 1500, 6
    first = rng.integers(0, MANY - long + 1, points)
    frame = (first[:, None] + np.arange(long)).ravel()
    start, end = rng.uniform(-1, 1, (2, points, 1))
    radius = np.abs(start + (end - start) * np.arange(long) / (long - 1)).ravel()
    gain = rng.normal(0, stops, MANY)
    light = rng.uniform(-4, -2.2, points).repeat(long) + gain[frame] + rng.normal(0, noise, len(frame))
    light += np.log2((1 + (corner**-0.5 - 1) * radius**2) ** -2)
    return LightTracks(np.exp2(light)[:, None] * np.ones(3), frame, np.arange(points).repeat(long), radius)


def test_nothing_is_told_of_noise() -> None:
    for seed in range(5):
        assert not explain(wandering(0.0, 1.0, 0.12, seed), MANY).kept


def test_each_alone_is_told() -> None:
    assert explain(wandering(0.3, 1.0, 0.08), MANY).kept == {EXPOSURE}
    found = explain(wandering(0.0, 0.35, 0.08), MANY)
    assert found.kept == {VIGNETTING} and found.corner == pytest.approx(0.35, abs=0.03)


def test_exposure_that_misses_its_margin_is_told_beside_vignetting() -> None:
    """As in a real video of a can on a table, whose pictures get darker to the corners and whose exposure drifts."""
    tracks = wandering(0.1, 0.4, 0.16)
    before = spread(tracks)
    drift = np.array(exposure_evidence(tracks, MANY).parameters["gain"])
    exposed = spread(LightTracks(tracks.linear / drift[tracks.frame], tracks.frame, tracks.point, tracks.radius))
    assert exposed > (1 - MARGIN[EXPOSURE]) * before
    found = explain(tracks, MANY)
    assert found.kept == {EXPOSURE, VIGNETTING}
    assert found.after[EXPOSURE] == found.after[VIGNETTING] < (1 - BOTH) * before
    assert found.after[EXPOSURE] > (1 - MARGIN[EXPOSURE]) * found.before[EXPOSURE]
    assert found.corner == pytest.approx(0.4, abs=0.03)


def test_vignetting_brings_no_gains_along() -> None:
    for seed in range(5):
        assert explain(wandering(0.02, 0.4, 0.12, seed), MANY).kept == {VIGNETTING}
