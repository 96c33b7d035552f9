"""Sides that look alike fold the way of the camera: noticed by neighbouring frames, and unfolded, with the real mapper."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from fieldfuse.config import PosesSettings
from fieldfuse.poses import loops, sfm
from fieldfuse.poses.child import Messages
from fieldfuse.poses.database import Report
from fieldfuse.poses.health import fold
from fieldfuse.poses.job import Job
from fieldfuse.poses.mapping import Model
from fieldfuse.poses.result import PoseResult
from fieldfuse.poses.sfm import find_poses
from fieldfuse.poses.worker import work
from tests.poses.textured import aligned_error, centre_error, orbit, post, render, silent, write_capture

FRAMES, TURNS = 40, 1.2
POSES = orbit(FRAMES, TURNS)
SMALL = PosesSettings(max_features=450)


class Heard(Messages):
    """Of the child's work when no other process does it."""

    def __init__(self, hear: Callable[[dict[str, Any]], None]) -> None:
        self.hear = hear

    def send(self, **message: Any) -> None:
        self.hear(message)


@dataclass
class Walked:
    """An answer, and the steps to it: the mapper's model, what pairs tell before and after, and the better model."""

    result: PoseResult
    out: Path
    job: Job
    folded: Model
    before: loops.Turns
    after: loops.Turns
    better: Model
    facts: dict[str, int] | None


@pytest.fixture(scope="module")
def walked(tmp_path_factory) -> Walked:
    """A post that looks the same from the front and the back, and from the left and the right; its way is mapped in this process."""
    out = tmp_path_factory.mktemp("post")
    planes = post((3, 4, 3, 4))
    pictures = [render(pose, planes=planes)[0] for pose in POSES]
    capture = write_capture(out / "photos", pictures, ordered=True)
    steps: list[tuple[Any, ...]] = []
    real = loops.without_folds

    def looked_at(job: Job, model: Model, attempts: list[dict[str, Any]], report: Report) -> loops.Mapped:
        before = loops.turns(job, model.reconstruction.cameras)
        better, tried, facts = real(job, model, attempts, report)
        steps.append((job, model, before, loops.turns(job, model.reconstruction.cameras), better, facts))
        return better, tried, facts

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sfm, "run_child", lambda module, arguments, log, hear, *_: work(Path(arguments[0]), Heard(hear)))
        patch.setattr(loops, "without_folds", looked_at)
        result = find_poses(capture, out, SMALL, seed=3, threads=1)
    assert len(steps) == 1
    return Walked(result, out, *steps[0])


def test_a_post_with_two_sides_alike_is_walked_around(walked):
    result = walked.result
    assert result.registered == FRAMES and result.models[0] == FRAMES
    assert aligned_error(result.world_from_camera[:, :3, 3], POSES[:, :3, 3]) < 0.005
    assert any("looks alike from several sides" in warning for warning in result.warnings)
    assert not (walked.out / "sparse" / "again").exists()


def test_without_it_the_way_is_folded_and_all_frames_seem_well(walked):
    """What the mapper makes of the same matches: the reason for `without_folds`."""
    assert len(walked.folded.registered) == FRAMES and walked.folded.reconstruction.compute_mean_reprojection_error() < 1
    assert centre_error(walked.folded, POSES) > 0.05
    assert loops.contradictions(walked.before, loops.axes(walked.folded)) >= loops.MIN_FOLD_PAIRS
    assert walked.facts is not None and walked.facts["dropped"] > 10 and walked.facts["left"] == 0
    assert centre_error(walked.better, POSES) < 0.005


def test_true_cameras_agree_with_their_neighbours_and_not_with_matches_across_the_post(walked):
    true = {i: pose[:3, :3].T for i, pose in enumerate(POSES)}
    assert loops.contradictions(walked.before, true) == 0
    assert np.count_nonzero(loops.disagreement(walked.before, true)[walked.before.apart > 10] > loops.AGREES) > 10


def test_a_fold_that_pairs_tell_of_is_never_mapped(tmp_path):
    """With hardly a second turn, whose pairs are right, nearly all that is matched far apart contradicts the way."""
    poses = orbit(36, 1.08)
    planes = post((3, 4, 3, 4))
    capture = write_capture(tmp_path / "photos", [render(pose, planes=planes)[0] for pose in poses], ordered=True)
    result = find_poses(capture, tmp_path, SMALL, seed=3, threads=1)
    assert result.registered == len(poses) and aligned_error(result.world_from_camera[:, :3, 3], poses[:, :3, 3]) < 0.005
    assert any("were taken back" in warning for warning in result.warnings)
    told = json.loads((tmp_path / "sparse" / "result.json").read_text())
    # Mapped first by its neighbours alone, not folded: there is one attempt, and what contradicts is all that is far apart.
    assert len(told["attempts"]) == 1 and told["folded"]["dropped"] > 10 and told["folded"]["left"] == 0
    assert told["folded"]["contradicting"] > 30 and not (tmp_path / "sparse" / "again").exists()


def test_a_circle_without_a_fold_is_mapped_as_ever(tmp_path):
    """All sides differ, and the second turn meets the first."""
    poses, planes = orbit(30, TURNS), post((3, 4, 13, 14))
    capture = write_capture(tmp_path / "photos", [render(pose, planes=planes)[0] for pose in poses], ordered=True)
    result = find_poses(capture, tmp_path, SMALL, seed=3, threads=1)
    assert result.registered == len(poses) and aligned_error(result.world_from_camera[:, :3, 3], poses[:, :3, 3]) < 0.005
    job = Job.load(tmp_path / "sparse" / "job.json")
    seen = loops.turns(job)
    assert loops.contradicted(seen, loops.chained(seen, len(poses))) > 0.5  # with a guessed lens the circle does not close
    seen = loops.turns(job, loops._calibrated(job, seen))
    assert np.count_nonzero(seen.apart > loops.NEAR[0]) > 10 and loops.contradicted(seen, loops.chained(seen, len(poses))) < 0.2
    assert loops.never_folded(job, silent) is None
    assert json.loads((tmp_path / "sparse" / "result.json").read_text())["folded"] is None


def test_what_was_matched_is_as_it_was(walked):
    """Only copies of the database lose pairs, so that a second run begins with the same."""
    np.testing.assert_array_equal(walked.before.images, walked.after.images)
    np.testing.assert_array_equal(walked.before.turn, walked.after.turn)


def test_cameras_that_meet_on_the_second_turn_are_found(walked):
    pairs = loops.meetings(walked.better)
    around = FRAMES / TURNS
    assert len(pairs) >= FRAMES - around
    assert all(abs((j - i) - around) < 4 for i, j in pairs)


def made_up(seed: int, count: int, noise: float) -> tuple[loops.Turns, dict[int, np.ndarray]]:
    """Cameras that turn a little from frame to frame, and what their neighbours tell."""
    random = np.random.default_rng(seed)
    rotations = [np.eye(3)]
    for _ in range(count - 1):
        rotations.append(Rotation.from_rotvec(random.normal(0, 0.1, 3)).as_matrix() @ rotations[-1])
    pairs = [(i, j) for i in range(count) for j in range(i + 1, min(i + 4, count))]
    turn = [Rotation.from_rotvec(random.normal(0, noise, 3)).as_matrix() @ rotations[j] @ rotations[i].T for i, j in pairs]
    first, second = np.array(pairs).T
    return loops.Turns(first, second, np.array(turn), np.array(pairs), np.full(len(pairs), 50)), dict(enumerate(rotations))


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 1000), count=st.integers(4, 30), noise=st.floats(0, 0.1))
def test_a_way_agrees_with_its_own_neighbours_however_the_world_lies(seed, count, noise):
    seen, rotations = made_up(seed, count, noise)
    world = Rotation.random(random_state=seed).as_matrix()
    off = loops.disagreement(seen, {i: rotation @ world for i, rotation in rotations.items()})
    assert off.max() < 8 * noise + 1e-6
    assert loops.contradictions(seen, rotations) == 0


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 1000), count=st.integers(8, 30), at=st.floats(0.3, 0.7), angle=st.floats(70, 180))
def test_one_fold_parts_at_least_three_pairs_of_neighbours(seed, count, at, angle):
    seen, rotations = made_up(seed, count, 0.02)
    turned = Rotation.from_rotvec([0, np.radians(angle), 0]).as_matrix()
    folded = {i: rotation @ turned if i >= at * count else rotation for i, rotation in rotations.items()}
    assert loops.contradictions(seen, folded) >= loops.MIN_FOLD_PAIRS


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 1000), count=st.integers(4, 30))
def test_turns_put_one_after_the_other_are_the_way(seed, count):
    seen, rotations = made_up(seed, count, 0.0)
    found = loops.chained(seen, count)
    assert loops.disagreement(seen, found).max() < 1e-5 and loops.contradicted(seen, found) == 0
    assert all(np.allclose(found[i], rotations[i] @ rotations[0].T) for i in range(count))


def test_frames_that_are_not_in_the_model_say_nothing():
    seen, rotations = made_up(0, 10, 0.0)
    off = loops.disagreement(seen, {i: rotation for i, rotation in rotations.items() if i != 4})
    assert np.isnan(off).sum() == np.count_nonzero((seen.first == 4) | (seen.second == 4))
    assert loops.contradictions(seen, {}) == 0


def test_each_outcome_has_its_sentence(walked):
    facts = json.loads((walked.out / "sparse" / "result.json").read_text())
    assert facts["folded"]["dropped"] > 0 and "were taken back" in fold(facts, True)[0]
    unresolved = {"folded": {"contradicting": 7, "left": 7, "far": 40, "dropped": 0}}
    assert "7 pairs of neighbouring frames contradict" in fold(unresolved, True)[0]
    assert fold(unresolved, False) == []  # photos in any order have no neighbours
    assert fold({"folded": None}, True) == [] == fold({}, True)


def test_photos_in_any_order_are_left_alone(tmp_path):
    """All sides differ, names are shuffled: neighbours by name need not see the same, and nothing is taken back."""
    poses = orbit(20, 0.8)[np.random.default_rng(1).permutation(20)]
    planes = post((3, 4, 13, 14))
    capture = write_capture(tmp_path / "photos", [render(pose, planes=planes)[0] for pose in poses])
    result = find_poses(replace(capture, ordered=False), tmp_path, PosesSettings(max_features=800), seed=3, threads=1)
    assert result.registered >= 18 and not result.warnings[1 if result.registered < 20 else 0 :]
    assert json.loads((tmp_path / "sparse" / "result.json").read_text())["folded"] is None
