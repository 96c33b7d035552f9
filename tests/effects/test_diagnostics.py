"""Evidence and decisions on made-up points: each effect alone is found and nothing else; nothing is found where nothing is."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fieldfuse.effects import geometry, light
from fieldfuse.effects.adjust import LENS, POSES, ROWS, adjust, predict, residuals, scatter
from fieldfuse.effects.diagnostics import ORDER, Timing, _lens, _poses, _rows, diagnose_tracks
from fieldfuse.effects.evidence import blur_evidence
from fieldfuse.effects.light import EXPOSURE
from fieldfuse.effects.refine import believed, refined_poses
from tests.effects.seen import CAMERA, FRAMES, made


def drift(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    stops = rng.normal(0, 0.3, FRAMES)
    return np.exp2((stops - stops.mean())[:, None] + np.array([[0.05, 0.0, -0.05]]) * np.sin(np.arange(FRAMES))[:, None])


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_nothing_is_found_where_nothing_is(seed: int) -> None:
    found = diagnose_tracks(made(seed))
    assert found.there == frozenset(), [finding.reason for finding in found.findings.values() if finding.there]
    assert tuple(found.findings) == ORDER


@pytest.mark.parametrize(
    ("effect", "arguments", "seed"),
    [
        ("distortion", {"lens": (-0.12, 0.03)}, 4),
        ("rolling_shutter", {"rows": 0.3}, 5),
        ("poses", {"pose_error": 0.004}, 4),
        ("exposure", {"gain": drift(3)}, 5),
        ("vignetting", {"corner": 0.6}, 4),
    ],
)
def test_each_effect_alone_is_found_and_nothing_else(effect: str, arguments: dict, seed: int) -> None:
    found = diagnose_tracks(made(seed, **arguments))
    assert found.there == {effect}, [finding.reason for finding in found.findings.values() if finding.there]
    finding = found.findings[effect]
    assert finding.number > finding.threshold
    if finding.before is not None and finding.after is not None:
        assert finding.after < 0.8 * finding.before


def test_two_at_once() -> None:
    found = diagnose_tracks(made(6, lens=(-0.2, 0.05), pose_error=0.004, gain=drift(6), corner=0.5))
    assert found.there == {"distortion", "poses", "exposure", "vignetting"}
    assert found.explained is not None
    assert found.explained.problem.lens == pytest.approx((-0.2, 0.05), abs=0.02)


def test_lens_and_light_are_measured() -> None:
    lens = geometry.explain(made(7, lens=(-0.12, 0.03)))
    assert lens is not None and lens.problem.lens[0] == pytest.approx(-0.12, abs=0.015)
    seen = made(7, gain=drift(7), corner=0.6)
    found = light.explain(seen.light(), FRAMES)
    assert found.corner == pytest.approx(0.6, abs=0.03)
    gain = np.log2(found.evidence[EXPOSURE].parameters["gain"])
    np.testing.assert_allclose(gain, np.log2(drift(7)) - np.log2(drift(7)).mean(0), atol=0.03)


def test_gains_of_training_frames_have_mean_one_and_do_not_hang_on_the_others() -> None:
    seen, test = made(8, gain=drift(8)), np.arange(FRAMES) % 8 == 0
    gain, borrowed = light.frame_gains(seen.light(), FRAMES, ~test)
    np.testing.assert_allclose(np.log2(gain[~test]).mean(0), 0, atol=1e-9)
    changed = replace(seen, linear=np.where(test[seen.frame, None], 0.5 * seen.linear, seen.linear))
    other, changed_borrowed = light.frame_gains(changed.light(), FRAMES, ~test)
    np.testing.assert_array_equal(other[~test], gain[~test])
    np.testing.assert_allclose(other[test], 0.5 * gain[test], rtol=0.02)
    assert not borrowed and not changed_borrowed, "points that agree are believed, however far off they are"


def test_a_held_out_frame_whose_points_disagree_has_its_neighbours_gain() -> None:
    seen, test = made(8, gain=drift(8)), np.arange(FRAMES) % 8 == 0
    expected, _ = light.frame_gains(seen.light(), FRAMES, ~test)
    factor = np.exp2(np.random.default_rng(0).normal(1.0, 0.8, (len(seen.frame), 1)))
    torn = replace(seen, linear=np.where((seen.frame == 8)[:, None], factor * seen.linear, seen.linear))
    gain, borrowed = light.frame_gains(torn.light(), FRAMES, ~test)
    assert borrowed == [8]
    np.testing.assert_allclose(np.log2(gain[8]), np.log2(expected[[7, 9]]).mean(0), atol=1e-9)
    np.testing.assert_allclose(gain[test][[0]], expected[test][[0]])


def aligned(poses: np.ndarray, given: np.ndarray, use: np.ndarray) -> np.ndarray:
    """`poses` under the similarity that brings those in `use` (F,) bool closest to the given ones: mean turn, spread and place."""
    u, _, vt = np.linalg.svd(np.einsum("fij,fkj->ik", given[use, :3, :3], poses[use, :3, :3]))
    rotation = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    centre, target = poses[use, :3, 3].mean(0), given[use, :3, 3].mean(0)
    away, wanted = (poses[use, :3, 3] - centre) @ rotation.T, given[use, :3, 3] - target
    scale = float((away * wanted).sum() / max(float((away**2).sum()), 1e-30))
    out = poses.copy()
    out[:, :3, :3] = rotation @ poses[:, :3, :3]
    out[:, :3, 3] = scale * (poses[:, :3, 3] - centre) @ rotation.T + target
    return out


def test_refined_poses_are_better_and_stay_in_the_given_frame() -> None:
    true, wrong = made(9, noise=0.05), made(9, noise=0.05, pose_error=0.004)
    train = np.arange(FRAMES) % 8 != 0
    refined = refined_poses(wrong, train, frozenset({POSES}))
    poses, lens = refined.poses, refined.lens
    assert lens == (0.0, 0.0)

    def off(one: np.ndarray) -> float:
        """Radians between cameras' turns, once all are brought into one frame."""
        moved = aligned(one, true.poses, np.ones(FRAMES, dtype=bool))
        cosines = (np.einsum("fij,fij->f", moved[:, :3, :3], true.poses[:, :3, :3]) - 1) / 2
        return float(np.sqrt(np.mean(np.arccos(np.clip(cosines, -1, 1)) ** 2)))

    assert off(poses) < 0.2 * off(wrong.poses)
    np.testing.assert_allclose(aligned(poses[train], wrong.poses[train], np.ones(train.sum(), dtype=bool)), poses[train], atol=0.02)


@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_refined_poses_stay_where_the_given_ones_are(seed: int) -> None:
    """No turn or move of them all together would bring them nearer to what is believed: a Newton step of its cost is next to nothing."""
    seen, train = made(seed, pose_error=0.004), np.arange(FRAMES) % 8 != 0
    poses = refined_poses(seen, train, frozenset({POSES})).poses[train]
    belief = replace(believed(geometry.open_problem(seen)[0], 1.0, 1.0), poses=seen.poses[train])
    centre = poses[:, :3, 3].mean(0)

    def cost(step: np.ndarray) -> float:
        """Of all poses turned about their middle by `step[:3]` and moved by `step[3:]`."""
        turn, moved = Rotation.from_rotvec(step[None, :3]).as_matrix()[0], poses.copy()
        moved[:, :3, :3] = turn @ poses[:, :3, :3]
        moved[:, :3, 3] = (poses[:, :3, 3] - centre) @ turn.T + centre + step[3:]
        return belief.cost(moved)

    still = cost(np.zeros(6))
    for step in 1e-3 * np.eye(6):
        ahead, back = cost(step), cost(-step)
        assert abs(0.5e-3 * (ahead - back) / (ahead + back - 2 * still)) < 3e-3


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_depths_do_not_drift_where_a_lens_is_a_little_off(seed: int) -> None:
    """Pictures alone take a slow turn for a slow move there, and all depths are 3% to 5% too large; the given poses hold them."""
    true, seen = made(seed), made(seed, pose_error=0.004, lens=(0.02, 0.0))
    whole, _ = geometry.open_problem(seen)

    def depths(poses: np.ndarray) -> np.ndarray:
        return np.asarray(predict(adjust(replace(whole, poses=poses)).problem)[0][:, 2])

    exact = depths(true.poses)
    alone = aligned(adjust(whole, frozenset({POSES}), steps=30).problem.poses, seen.poses, np.ones(FRAMES, dtype=bool))
    refined = refined_poses(seen, np.ones(FRAMES, dtype=bool), frozenset({POSES})).poses
    assert np.median(depths(alone) / exact) > 1.028
    assert abs(np.median(depths(refined) / exact) - 1) < 0.02


def test_held_out_frames_move_nothing_of_the_others() -> None:
    seen, train = made(10, pose_error=0.004), np.arange(FRAMES) % 8 != 0
    before = refined_poses(seen, train, frozenset({POSES})).poses
    rng = np.random.default_rng(0)
    moved = np.where(train[seen.frame, None], seen.pixel, seen.pixel + rng.normal(0, 1.0, seen.pixel.shape))
    after = refined_poses(replace(seen, pixel=moved), train, frozenset({POSES})).poses
    assert np.abs(after[train] - before[train]).max() < 2e-3
    assert np.abs(after[~train] - before[~train]).max() > 0


def test_adjusting_points_alone_lowers_the_residual_to_the_noise() -> None:
    problem, _ = geometry.open_problem(made(11, noise=0.2))
    rng = np.random.default_rng(1)
    shaken = replace(problem, points=problem.points + rng.normal(0, 0.02, problem.points.shape))
    fitted = adjust(shaken)
    assert scatter(residuals(shaken)) > 1.0
    assert fitted.scatter < 0.25


def test_frames_that_are_less_sharp_than_others_are_told() -> None:
    rng = np.random.default_rng(3)
    frame, point = (index.ravel() for index in np.meshgrid(np.arange(12), np.arange(200)))
    depth = np.exp(rng.normal(0, 0.3, len(frame)))
    slope = 0.01 * depth * np.exp2(rng.normal(0, 0.2, len(frame)) + 0.5 * rng.normal(0, 1, 200)[point])
    light = np.full((len(frame), 3), 0.3)
    even = blur_evidence(slope, depth, frame, point, 12, light)
    blurred = blur_evidence(np.where(frame == 5, 0.4, 1.0) * slope, depth, frame, point, 12, light)
    assert not even.found and blurred.found, (even.reason, blurred.reason)
    assert int(np.argmin(blurred.parameters["sharpness"])) == 5


def test_too_little_to_tell() -> None:
    seen = made(12, points=20)
    found = diagnose_tracks(seen)
    assert found.there == frozenset() and all("too few" in finding.reason for finding in found.findings.values())


def test_readout_is_told_in_shares_of_a_step() -> None:
    found = geometry.explain(made(13, rows=0.4, noise=0.05))
    assert found is not None and "rolling_shutter" in found.kept
    assert CAMERA.height == 240 and np.abs(found.problem.motion[:, :3]).max() > 0.005


@pytest.mark.parametrize(("share", "there"), [(0.6, True), (2.0, False)])
def test_no_shutter_takes_longer_than_from_picture_to_picture(share: float, there: bool) -> None:
    """What fits few photos like the rows of a shutter is none when reading them would have to begin before the picture before."""
    random = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (6, 1, 1))
    for number in range(1, 6):
        poses[number, :3, :3] = Rotation.from_rotvec(random.normal(0, 0.1, 3)).as_matrix() @ poses[number - 1, :3, :3]
    steps = geometry.steps_of(poses, np.arange(6.0))
    problem = SimpleNamespace(motion=share * steps, poses=poses)
    found = SimpleNamespace(problem=problem, choices={ROWS: geometry.Choice(1.0, 0.5, True)})
    finding = _rows(found, np.arange(6.0))  # type: ignore[arg-type]
    assert finding.there is there and f"{share:.2f} of the time between two pictures" in finding.reason
    assert ("more slowly" in finding.reason) is there


@pytest.mark.parametrize(("after", "words"), [(0.66, ("lowers", "lower", "34% less")), (1.34, ("raises", "raise", "34% more"))])
def test_what_makes_held_out_points_worse_is_said_to_do_so(after: float, words: tuple[str, str, str]) -> None:
    found = SimpleNamespace(choices=dict.fromkeys((LENS, ROWS, POSES), geometry.Choice(1.0, after, False)), profile=[0.0])
    told = [_lens(found).reason, _rows(found, np.zeros(0)).reason, _poses(found).reason]  # type: ignore[arg-type]
    for reason, word in zip(told, words, strict=True):
        assert f" {word}" in reason and "34%" in reason and "-34" not in reason


def test_seconds_of_several_effects_are_split_evenly_and_add_up(monkeypatch: pytest.MonkeyPatch) -> None:
    now = iter([10.0, 13.0, 20.0, 21.0])
    monkeypatch.setattr("fieldfuse.effects.diagnostics.time.monotonic", lambda: next(now))
    timing = Timing()
    with timing.by("poses", "distortion"):
        pass
    with pytest.raises(ValueError, match="stop"), timing.by("poses"):
        raise ValueError("stop")
    assert timing.of("poses") == 2.5 and timing.of("distortion") == 1.5 and timing.of("exposure") == 0
