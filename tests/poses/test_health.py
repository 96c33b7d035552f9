"""The words for why poses fail, from plain numbers."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldfuse.poses.health import (
    components,
    failure,
    hopeless,
    rotation_residual,
    runs,
    shortfalls,
    standing,
    turned_only,
    way,
)
from fieldfuse.poses.job import GLOBAL, LOOSE


def picture(n: int, keypoints: int = 900, grey: int | None = None) -> dict[str, Any]:
    random = np.random.default_rng(n)
    thumbnail = random.integers(0, 255, 1024) if grey is None else np.full(1024, grey)
    return {
        "name": f"p{n:02d}",
        "width": 640,
        "height": 480,
        "keypoints": keypoints,
        "deviation": 40.0 if grey is None else 0.0,
        "thumbnail": thumbnail.tolist(),
    }


def pair(first: int, second: int, inliers: int = 100, homography: Any = None, moved: float = 60.0) -> dict[str, Any]:
    return {"first": first, "second": second, "inliers": inliers, "flat": homography is not None, "homography": homography, "moved": moved}


def model(pictures: list[int], angle: float = 12.0) -> dict[str, Any]:
    return {"pictures": pictures, "angle": angle, "attempt": "incremental"}


def facts(count: int, pairs: list[dict[str, Any]], found: dict[str, Any] | None, sizes: list[int] | None = None) -> dict[str, Any]:
    return {
        "pictures": [picture(n) for n in range(count)],
        "pairs": pairs,
        "attempts": [{"attempt": "incremental", "models": sizes or []}],
        "model": found,
    }


def homography(rotation: np.ndarray, focal: float, shift: np.ndarray | None = None, normal: np.ndarray | None = None) -> np.ndarray:
    k = np.array([[focal, 0, 320], [0, focal, 240], [0, 0, 1.0]])
    inner = rotation if shift is None else rotation + np.outer(shift, normal)
    out = k @ inner @ np.linalg.inv(k)
    return out / out[2, 2]


def rotations(seed: int, count: int, degrees: float) -> list[np.ndarray]:
    random = np.random.default_rng(seed)
    return [cv2.Rodrigues(np.radians(degrees) * v / np.linalg.norm(v))[0] for v in random.standard_normal((count, 3))]


WALL = [
    pair(i, i + 1, homography=homography(r, 600, np.array([0.4, 0, 0.1]), np.array([0, 0, 1.0])).tolist())
    for i, r in enumerate(rotations(2, 9, 5.0))
]


@settings(max_examples=30, deadline=None)
@given(st.floats(300, 2000), st.floats(2, 25), st.integers(0, 1000), st.floats(0.01, 100))
def test_turning_on_the_spot_is_recognised_at_any_zoom_and_scale_of_the_matrix(focal, degrees, seed, factor):
    matrices = np.array([homography(r, focal) * factor for r in rotations(seed, 12, degrees)])
    assert rotation_residual(matrices, 640, 480) < 0.03


@settings(max_examples=30, deadline=None)
@given(st.floats(400, 1500), st.integers(0, 1000), st.floats(0.15, 0.5))
def test_moving_before_a_wall_is_not_taken_for_turning(focal, seed, shift):
    random = np.random.default_rng(seed)
    normal = np.array([0.1, 0.1, 1.0]) / np.linalg.norm([0.1, 0.1, 1.0])
    matrices = []
    for rotation in rotations(seed, 12, 5.0):
        direction = np.append(random.standard_normal(2), 0.2)
        matrices.append(homography(rotation, focal, shift * direction / np.linalg.norm(direction), normal))
    assert rotation_residual(np.array(matrices), 640, 480) > 0.06


def test_the_verdict_names_turning_only_when_pairs_agree():
    turning = [pair(i, i + 1, homography=homography(r, 600).tolist()) for i, r in enumerate(rotations(1, 9, 8.0))]
    assert turned_only(facts(10, turning, None))
    assert "turned on the spot" in (failure(facts(10, turning, None)) or "")
    assert "turned on the spot" in (failure(facts(10, turning, model(list(range(10)), angle=2.0))) or "")
    mixed = turning[:3] + [pair(i, i + 1) for i in range(3, 9)]
    assert not turned_only(facts(10, mixed, None))
    assert failure(facts(10, mixed, model(list(range(10))))) is None


@pytest.mark.parametrize(("moved", "believed"), [(0.012, True), (0.15, False)])
def test_a_model_that_moves_farther_than_its_pairs_tell_has_a_wrong_lens(moved, believed):
    """Slowly along a far wall, 1.2% of its distance a picture: pairs alone look like turning, the model says how far it went."""
    shift, normal = np.array([0.012, 0, 0]), np.array([0, 0, 1.0])
    pairs = [pair(i, i + 1, homography=homography(r, 600, shift, normal).tolist()) for i, r in enumerate(rotations(3, 9, 2.0))]
    poses = np.tile(np.eye(4), (10, 1, 1))
    poses[:, 0, 3] = 7 * moved * np.arange(10)
    across = np.random.default_rng(0).uniform(-3, 3, (200, 2))
    found = {
        **model(list(range(10)), angle=7.0),
        "world_from_camera": poses.tolist(),
        "points": np.column_stack([across, np.full(200, 7.0)]).tolist(),
    }
    assert turned_only(facts(10, pairs, found)) and way(facts(10, pairs, found)) == pytest.approx(moved)
    reason = failure(facts(10, pairs, found))
    assert reason is None if believed else "turned on the spot" in str(reason)
    last_resort = {**found, "attempt": GLOBAL}
    assert "turned on the spot" in str(failure(facts(10, pairs, last_resort))), "no other mapper found a pair to begin with"


def test_a_few_pictures_of_many_by_looser_rules_are_no_model_where_pairs_are_flat():
    turning = [pair(i, i + 1, homography=homography(r, 600).tolist()) for i, r in enumerate(rotations(1, 9, 8.0))]
    placed = {**model([0, 1, 2, 3]), "attempt": LOOSE, "world_from_camera": np.tile(np.eye(4), (4, 1, 1)).tolist(), "points": [[0, 0, 7.0]]}
    assert "turned on the spot" in str(failure(facts(10, turning, placed)))
    assert "one plane" in str(failure(facts(10, WALL, placed)))
    assert failure(facts(10, WALL, {**placed, "pictures": list(range(5))})) is None
    half = [*turning[:5], *(pair(i, i + 1) for i in range(5, 9))]
    assert "for the most part" in str(failure(facts(10, half, {**placed, "pictures": list(range(10))})))
    assert failure(facts(10, half, model(list(range(10))))) is None
    assert failure(facts(10, WALL, {**placed, "attempt": "incremental"})) is None
    assert failure(facts(10, [pair(i, i + 1) for i in range(9)], placed)) is None


def test_each_failure_has_its_own_sentence():
    chain = [pair(i, i + 1) for i in range(9)]
    sentences = {
        "share enough features": failure(facts(10, [], None)),
        "hardly moved": failure(facts(10, [pair(i, i + 1, moved=0.5) for i in range(9)], None)),
        "too little parallax: rays": failure(facts(10, chain, model(list(range(10)), angle=0.4))),
        "one plane": failure(facts(10, WALL, None)),
        "overlap too little": failure(facts(10, [pair(0, 1), pair(4, 5)], None)),
        "no consistent geometry": failure(facts(10, chain, None)),
    }
    for words, sentence in sentences.items():
        assert sentence is not None and words in sentence and ". " not in sentence
    assert len({*sentences.values()}) == len(sentences)
    assert failure(facts(10, chain, model(list(range(10))))) is None


def test_hopeless_pictures_are_refused_before_matching():
    assert "identical" in (hopeless([{**picture(0), "name": str(n)} for n in range(10)]) or "")
    assert "one flat colour" in (hopeless([picture(n, keypoints=0, grey=0) for n in range(5)]) or "")
    assert "without texture" in (hopeless([picture(n, keypoints=5) for n in range(5)]) or "")
    assert "1 picture" in (hopeless([picture(0)]) or "") and hopeless([]) is not None
    assert hopeless([picture(n) for n in range(5)]) is None
    # The same scene at another size is no identical picture, and one rich pair is worth a try.
    assert hopeless([picture(0), {**picture(0), "width": 320}]) is None
    assert hopeless([picture(0), picture(1), picture(2, keypoints=0, grey=0)]) is None


def test_components_and_runs():
    groups = components(8, [pair(0, 1), pair(1, 2), pair(5, 6)])
    assert groups == [[0, 1, 2], [5, 6], [3], [4], [7]]
    assert runs(["a", "b", "c", "f", "x", "y"], [0, 1, 2, 5, 8, 9]) == ["a to c", "f", "x", "y"]


def test_missing_frames_are_grouped_by_cause():
    pairs = [pair(i, i + 1) for i in range(5)] + [pair(7, 8), pair(5, 6, inliers=16)]
    told = facts(10, pairs, model([0, 1, 2, 3, 4, 5]), sizes=[6, 2])
    told["pictures"][9]["keypoints"] = 3
    text = shortfalls(told)
    assert text[0] == "6 of 10 frames were registered; the scene split into models of 6, 2 frames"
    causes = " | ".join(text[1:])
    assert "too weakly or ambiguously to be placed: p06" in causes
    assert "no frame of the model (a gap in the overlap): p07, p08" in causes
    assert "too few features (dark, blurred or blank): p09" in causes
    bare = facts(10, [pair(i, i + 1) for i in range(9)], model(list(range(6))))
    for record in bare["pictures"][6:]:
        record["keypoints"] = 300
    assert "little texture (300 keypoints each, the others 900)" in shortfalls(bare)[1]
    assert shortfalls(facts(3, [], model([0, 1, 2]))) == []


def test_what_stands_against_what_moves_is_told_by_its_extent():
    def told(extent: float, standing_pairs: int, against: int) -> list[str]:
        stands = [(extent, n < against) if n < standing_pairs else None for n in range(30)]
        return standing(facts(31, [pair(n, n + 1) | {"stands": one} for n, one in enumerate(stands)], None))

    assert "turned before a standing camera" in told(0.5, 12, 6)[0] and "12 of 30" in told(0.5, 12, 6)[0]
    assert "watermark" in told(0.01, 30, 30)[0]
    assert told(0.5, 12, 2) == []  # far mountains, and an estimate or two that failed
    assert told(0.5, 2, 2) == []
    assert standing(facts(21, [pair(n, n + 1) for n in range(20)], None)) == []


def moved_features(world_turns: float, camera_turns: float, shift: tuple[float, ...], far: float, seed: int = 0) -> tuple[Any, Any]:
    """Pixels of an object's points, turned by some degrees or seen by a camera that moves, and of a background `far` away."""
    random = np.random.default_rng(seed)
    k = np.array([[600, 0, 320], [0, 600, 240], [0, 0, 1.0]])
    thing = random.uniform([-1, -1, 4], [1, 1, 6], (80, 3))
    wall = np.concatenate([random.uniform(-0.5, 0.5, (60, 2)), np.ones((60, 1))], axis=1) * far
    turn = cv2.Rodrigues(np.array([0, np.radians(world_turns), 0]))[0]
    after = np.concatenate([(thing - [0, 0, 5]) @ turn.T + [0, 0, 5], wall])
    after = after @ cv2.Rodrigues(np.array([0, np.radians(camera_turns), 0]))[0].T + shift
    seen = [points @ k.T for points in (np.concatenate([thing, wall]), after)]
    here, there = (points[:, :2] / points[:, 2:] for points in seen)
    return here, there + random.normal(0, 0.3, there.shape)


@pytest.mark.parametrize("seed", range(4))
def test_an_object_turned_before_a_standing_camera_contradicts_its_background(seed):
    pytest.importorskip("pycolmap")
    from fieldfuse.poses.database import stands

    found = stands(*moved_features(20, 0, (0, 0, 0), 9, seed))
    assert found is not None and found[0] > 0.2
    sideways = stands(*moved_features(0, 0, (0.5, 0.1, 0), 1e5, seed))  # before far mountains
    forward = stands(*moved_features(0, 0, (0, 0, -0.8), 1e5, seed))
    assert all(one is None or not one[1] for one in (sideways, forward))
    assert stands(*moved_features(0, 4, (0.4, 0, 0), 9, seed)) is None  # a camera that moves and turns: nothing stands still
    assert stands(*moved_features(0, 0, (0, 0, 0), 9, seed)) is None  # nothing moves


def test_an_object_turned_about_the_line_of_sight_leaves_no_point_to_go_away_from():
    pytest.importorskip("pycolmap")
    from fieldfuse.poses.database import stands

    random = np.random.default_rng(3)
    thing, rest = random.uniform(220, 420, (80, 2)), random.uniform(0, 640, (60, 2))
    turn = cv2.Rodrigues(np.array([0, 0, np.radians(30)]))[0][:2, :2]
    found = stands(np.concatenate([thing, rest]), np.concatenate([(thing - 320) @ turn.T * [1, 0.6] + 320, rest]))
    assert found is not None and found[1] and found[0] > 0.3
