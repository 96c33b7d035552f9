"""Evidence from simulated captures with known effects: found when it is there, not found when it is not, and of the right size."""

from __future__ import annotations

import numpy as np
import pytest

from fieldfuse.effects.effect_specs import preset
from fieldfuse.effects.evidence import without_points_and_frames
from fieldfuse.effects.light import LightTracks, exposure_evidence, vignetting_evidence
from fieldfuse.simulate.materials import TextureBank, texture_bank
from tests.effects.filmed import FRAMES, Filmed, film_tracks

SEEDS = (11, 12)


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


def test_both_together(bank: TextureBank) -> None:
    filmed = film_tracks(bank, SEEDS[0], ["exposure:strong", "vignetting:medium", "sensor_noise:medium"])
    assert exposure_evidence(filmed.tracks, FRAMES).found
    found = vignetting_evidence(filmed.tracks, FRAMES)
    assert found.found and found.parameters["corner"] == pytest.approx(0.62, abs=0.08)


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
