"""What evidence speaks for is corrected only where no bound, no check of held-out frames and no trial speaks against it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fieldfuse.camera import Array
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.config import EffectsSettings
from fieldfuse.effects import decide as module
from fieldfuse.effects.adjust import POSES, ROWS
from fieldfuse.effects.correct import STOPS, Corrections, apart, beyond, beyond_depth, bounded_gains
from fieldfuse.effects.decide import FEWEST_TRIED, TRIED, Decision, Trial, better, decide, tried_frames
from fieldfuse.effects.diagnostics import Diagnostics, diagnose_tracks
from fieldfuse.effects.light import EXPOSURE
from fieldfuse.effects.refine import refined_poses
from fieldfuse.effects.tracks import Tracks
from tests.effects.seen import CAMERA, FRAMES, made

TRAIN = np.arange(FRAMES) % 5 != 2


def far_off(poses: Array, given: Array) -> float:
    """Degrees and hundredths of a unit by which the worst pose is off."""
    way, turn = apart(poses, given)
    return float(max(turn.max(), 100 * way.max()))


def test_held_out_frames_are_placed_right_beside_a_rolling_shutter() -> None:
    """Rows read one after the other explain the points of training frames; placed frames must not pay for it."""
    true, seen = made(3, rows=0.4), made(3, rows=0.4, pose_error=0.004)
    refined = refined_poses(seen, TRAIN, frozenset({POSES, ROWS}))
    given, after = apart(seen.poses, true.poses)[1], apart(refined.poses, true.poses)[1]
    assert after[~TRAIN].max() < 2 * max(after[TRAIN].max(), 0.2), (given, after)
    assert not refined.fails


def test_a_held_out_frame_whose_points_are_wrong_goes_with_its_neighbours() -> None:
    seen = made(4, pose_error=0.003)
    bad = int(np.flatnonzero(~TRAIN)[1])
    rng = np.random.default_rng(0)
    pixel = np.where((seen.frame == bad)[:, None], rng.uniform(0, [CAMERA.width, CAMERA.height], seen.pixel.shape), seen.pixel)
    refined = refined_poses(replace(seen, pixel=pixel), TRAIN, frozenset({POSES}))
    assert refined.borrowed == 1 and not refined.fails
    assert far_off(refined.poses[[bad]], seen.poses[[bad]]) < 1.5


def test_refinement_fails_where_most_held_out_frames_cannot_be_placed() -> None:
    seen = made(4, pose_error=0.003)
    rng = np.random.default_rng(0)
    pixel = np.where(~TRAIN[seen.frame, None], rng.uniform(0, [CAMERA.width, CAMERA.height], seen.pixel.shape), seen.pixel)
    assert refined_poses(replace(seen, pixel=pixel), TRAIN, frozenset({POSES})).fails


def test_frames_set_aside_are_placed_as_if_held_out() -> None:
    seen, aside = made(5, pose_error=0.004, noise=0.05), np.arange(FRAMES) == 6
    refined = refined_poses(seen, TRAIN, frozenset({POSES}), aside=aside)
    assert refined.aside is not None
    assert np.array_equal(refined.aside[~aside], refined.poses[~aside])
    assert 0 < far_off(refined.aside[aside], refined.poses[aside]) < 0.5


def corrected(**parts: Any) -> dict[str, str]:
    given = {f"{number}": np.eye(4) for number in range(5)}
    return beyond(Corrections(**parts), [CAMERA], given, 2.0)


def test_no_correction_is_larger_than_cameras_explain() -> None:
    turned = np.eye(4)
    turned[:3, :3] = Rotation.from_rotvec(np.array([[0.0, np.radians(14), 0.0]])).as_matrix()[0]
    near = np.eye(4)
    near[0, 3] = 0.2
    names = [f"{number}" for number in range(5)]
    assert corrected(gain=dict.fromkeys(names, (1.0, 1.0, 1.0)), corner=0.6, lens=(0.02, 0.0), poses=dict.fromkeys(names, near)) == {}
    assert set(corrected(poses=dict.fromkeys(names, turned))) == {"poses"}
    assert set(corrected(corner=0.05)) == {"vignetting"}
    assert set(corrected(lens=(1.5, 0.0))) == {"distortion"}
    wild = {name: (2.0 ** (6 * (number % 2)),) * 3 for number, name in enumerate(names)}
    assert set(corrected(gain=wild)) == {"exposure"}


def test_single_frames_have_their_gains_bounded() -> None:
    gain = {f"{number}": (1.0, 1.0, 1.0) for number in range(30)} | {"dark": (0.01, 0.01, 0.01)}
    kept = bounded_gains(gain)
    assert kept is not None and kept["0"] == (1.0, 1.0, 1.0)
    assert kept["dark"] == pytest.approx((2**-STOPS,) * 3)
    assert bounded_gains({}) == {}


def test_no_depth_camera_stands_where_none_can() -> None:
    def standing(way: float, degrees: float = 0.0) -> Array:
        pose = np.eye(4)
        pose[0, 3] = way
        pose[:3, :3] = Rotation.from_rotvec(np.array([[0.0, np.radians(degrees), 0.0]])).as_matrix()[0]
        return pose

    assert beyond_depth(standing(0.05, 2), metric=True, depth=2.0) is None
    assert "24.4 cm" in (beyond_depth(standing(0.244), metric=True, depth=2.0) or "")
    assert "8.0°" in (beyond_depth(standing(0.01, 8), metric=True, depth=2.0) or "")
    assert beyond_depth(standing(1.0), metric=False, depth=20.0) is None
    assert beyond_depth(standing(1.0), metric=False, depth=2.0) is not None


def test_frames_of_a_trial_are_training_frames() -> None:
    train = [index for index in range(200) if index % 8]
    chosen, aside = tried_frames(train, 200)
    assert len(chosen) == TRIED and set(chosen) <= set(train) and set(np.flatnonzero(aside)) <= set(chosen)
    assert 6 <= aside.sum() <= 10
    few, none = tried_frames(train[: FEWEST_TRIED - 1], 200)
    assert len(few) == FEWEST_TRIED - 1 and not none.any()
    assert tried_frames([], 3)[0] == []


def test_a_gain_that_hangs_on_one_frame_is_no_win() -> None:
    before = np.full(8, 20.0)
    assert better(before, before + 0.5) == pytest.approx(0.5)
    assert better(before, before + np.array([-5.0, 6.0, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5])) < 0.1


@pytest.fixture(scope="module")
def walked() -> tuple[Tracks, Diagnostics]:
    """What is seen on a made-up walk with drifting exposure and poses that are off, and what its training frames speak for."""
    seen = made(9, noise=0.05, pose_error=0.004, points=200, gain=np.exp2(0.4 * np.sin(np.arange(FRAMES)))[:, None] * np.ones(3))
    kept = seen.rows(TRAIN[seen.frame])
    which = np.flatnonzero(TRAIN)
    own = replace(
        kept,
        names=[seen.names[k] for k in which],
        cameras=[CAMERA] * len(which),
        poses=seen.poses[which],
        times=seen.times[which],
        scale=seen.scale[which],
        frame=(np.cumsum(TRAIN) - 1)[kept.frame],
    )
    return replace(seen, images=tuple(np.full((24, 32), 120, np.uint8) for _ in seen.names)), diagnose_tracks(own)


Decisions = dict[str, Decision]
Walked = tuple[Tracks, Diagnostics]


def decided(
    walked: Walked, monkeypatch: pytest.MonkeyPatch, scores: dict[str, float] | None, **settings: list[str]
) -> tuple[Decisions, Corrections, list[Corrections]]:
    """Decisions by name, where trials give 20 dB and so many more for each effect that is corrected in them; None: they give nothing."""
    seen, found = walked
    monkeypatch.setattr(module, "gather", lambda *_, **__: seen)
    frames = [Frame(name, Path(f"{name}.png"), CAMERA, pose) for name, pose in zip(seen.names, seen.poses, strict=True)]
    asked: list[Corrections] = []

    def trials(some: Capture, aside: Array) -> Trial:
        assert len(some.frames) == TRAIN.sum() and aside.any() and some.points is not None

        def trial(option: Corrections, seed: int = 0) -> Array | None:
            asked.append(option)
            if scores is None:
                return None
            parts = {POSES: bool(option.poses), EXPOSURE: bool(option.gain)}
            return np.full(4, 20.0) + sum(scores[name] for name, there in parts.items() if there)

        return trial

    got = decide(Capture("transforms", Path(), tuple(frames)), ~TRAIN, EffectsSettings(**settings), found=found, trials=trials)
    return {one.finding.effect: one for one in got.decisions}, got.corrections, asked


def test_what_a_trial_shows_to_be_better_is_corrected(walked: Walked, monkeypatch: pytest.MonkeyPatch) -> None:
    found, corrections, asked = decided(walked, monkeypatch, {POSES: 1.0, EXPOSURE: 0.5})
    assert found[POSES].on and found[EXPOSURE].on and found[POSES].decided_by == found[EXPOSURE].decided_by == "trial"
    assert found[EXPOSURE].trial == {"without": 21.0, "with": 21.5}
    assert corrections.poses and corrections.gain
    assert asked[0] == Corrections() and len(asked) == 3


def test_what_a_trial_shows_to_be_worse_is_not(walked: Walked, monkeypatch: pytest.MonkeyPatch) -> None:
    found, corrections, _ = decided(walked, monkeypatch, {POSES: -2.0, EXPOSURE: 0.5})
    assert not found[POSES].on and found[EXPOSURE].on
    assert not corrections.poses and corrections.gain
    assert "18.00 dB with it and 20.00 dB without" in found[POSES].note
    data = found[POSES].to_dict()
    assert data["decided_by"] == "trial" and data["trial"] == {"without": 20.0, "with": 18.0} and data["on"] is False


@pytest.mark.parametrize(("first", "later", "wanted", "seeds"), [
    (0.08, 0.8, True, {0, 1, 2}), (0.12, 0.0, False, {0, 1, 2}), (0.03, 0.8, False, {0}), (0.5, 0.0, True, {0})
])  # fmt: skip
def test_a_near_tie_is_decided_by_more_seeds(
    first: float, later: float, wanted: bool, seeds: set[int], walked: Walked, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What one seed decides clearly is not tried again."""
    seen, found = walked
    monkeypatch.setattr(module, "gather", lambda *_, **__: seen)
    frames = [Frame(name, Path(f"{name}.png"), CAMERA, pose) for name, pose in zip(seen.names, seen.poses, strict=True)]
    tried: set[int] = set()

    def score(option: Corrections, seed: int = 0) -> Array:
        tried.add(seed)
        return np.full(4, 20.0 + (first if seed == 0 else later) * bool(option.gain))

    settings = EffectsSettings(off=["poses"])
    got = decide(Capture("transforms", Path(), tuple(frames)), ~TRAIN, settings, found=found, trials=lambda some, aside: score)
    assert tried == seeds and {one.finding.effect: one.on for one in got.decisions}[EXPOSURE] is wanted


def test_what_the_user_wants_is_corrected_whatever_trials_say(walked: Walked, monkeypatch: pytest.MonkeyPatch) -> None:
    found, corrections, _ = decided(walked, monkeypatch, {POSES: -2.0, EXPOSURE: -2.0}, on=["poses"])
    assert found[POSES].on and corrections.poses
    assert not found[EXPOSURE].on and not corrections.gain


def test_evidence_decides_where_no_trial_is_possible(walked: Walked, monkeypatch: pytest.MonkeyPatch) -> None:
    found, _, _ = decided(walked, monkeypatch, None)
    assert found[POSES].on and "a trial was not possible" in found[POSES].note and found[POSES].decided_by == "evidence"


def test_poses_that_place_nothing_are_not_used(walked: Walked, monkeypatch: pytest.MonkeyPatch) -> None:
    seen, found = walked
    anywhere = np.random.default_rng(0).uniform(0, [CAMERA.width, CAMERA.height], seen.pixel.shape)
    shaken = replace(seen, pixel=np.where(TRAIN[seen.frame, None], seen.pixel, anywhere))
    decisions, corrections, _ = decided((shaken, found), monkeypatch, {POSES: 1.0, EXPOSURE: 0.5})
    assert not decisions[POSES].on and decisions[POSES].decided_by == "check" and not corrections.poses
    assert "held-out frames cannot be placed" in decisions[POSES].note
