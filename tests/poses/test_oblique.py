"""Few photos that stand far apart: whether matches agree with the places found, and what oblique views add; with the real mapper."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tests.conftest import shared_data
from tests.poses.textured import aligned_error, arc, render, turning, write_capture
from toolkit.capture import open_capture
from toolkit.config import PosesSettings
from toolkit.poses import database as store
from toolkit.poses import placing
from toolkit.poses.agreement import agreement, epipolar_distance, leave_out
from toolkit.poses.features import sift, tilted
from toolkit.poses.health import doubts
from toolkit.poses.job import MAX_OBLIQUE, Job, plan
from toolkit.poses.mapping import Model, plain
from toolkit.poses.match import match
from toolkit.poses.pairs import exhaustive_pairs
from toolkit.poses.sfm import find_poses


def silent(done: float, total: float, note: str) -> None:
    pass


def matched(folder: Path, poses: np.ndarray) -> Job:
    capture = write_capture(folder / "photos", [render(pose)[0] for pose in poses])
    job = plan(capture, folder / "sparse", PosesSettings(), seed=3, threads=1)
    Path(job.folder).mkdir()
    database = store.open_database(job)
    store.extract(job, database, silent)
    database.close()
    match(job, exhaustive_pairs(len(poses)), silent)
    return job


def error(model: Model, poses: np.ndarray) -> float:
    found = plain(model)
    return aligned_error(np.array(found["world_from_camera"])[:, :3, 3], poses[found["pictures"], :3, 3])


# ------------------------------------------------------------------------------------------- agreement


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 1000), off=st.floats(1e-4, 1e-2))
def test_matches_of_one_point_agree_and_others_are_as_far_as_they_are_moved(seed, off):
    random = np.random.default_rng(seed)
    rotation, translation = Rotation.from_rotvec(random.normal(0, 0.3, 3)).as_matrix(), random.normal(0, 0.5, 3)
    points = random.uniform([-1, -1, 4], [1, 1, 6], (50, 3))
    moved = points @ rotation.T + translation
    here, there = points[:, :2] / points[:, 2:], moved[:, :2] / moved[:, 2:]
    assert epipolar_distance(here, there, rotation, translation).max() < 1e-9
    # Two cameras side by side: lines are rows, and half of the distance between rows is each picture's.
    rows = epipolar_distance(here, here + np.array([0.1, off]), np.eye(3), np.array([1.0, 0, 0]))
    np.testing.assert_allclose(rows, off / np.sqrt(2), rtol=1e-6)


def test_a_picture_put_elsewhere_is_told(tmp_path):
    poses = arc(5, 60)
    job = matched(tmp_path, poses)
    model, facts = placing.place(job, silent)
    assert model is not None and error(model, poses) < 0.01
    assert facts["agreement"] == agreement(job, model) and set(facts["agreement"]) == set(range(5))
    assert min(facts["agreement"].values()) > 0.95
    assert not (Path(job.folder) / placing.OBLIQUE).exists()  # there is no reason to
    image = model.reconstruction.image(model.registered[3])
    pose = image.cam_from_world()
    shifted = pycolmap.Rigid3d(pose.rotation, np.asarray(pose.translation) + np.array([0.0, 0.4, 0.0]))
    model.reconstruction.frame(image.frame_id).rig_from_world = shifted
    shares = agreement(job, model)
    assert min(shares, key=shares.__getitem__) == 3 and shares[3] < 0.3
    assert leave_out(model, shares, shares[3]) == shares and leave_out(model, shares, 0.99) == shares  # nobody, and too many
    assert set(leave_out(model, shares, shares[3] + 0.01)) == {0, 1, 2, 4} == set(plain(model)["pictures"])


def test_places_that_may_be_wrong_are_named():
    pictures = [{"name": name} for name in ("a", "b", "c")]
    told = doubts({"agreement": {"0": 0.9, "2": 0.5}, "pictures": pictures})  # as JSON has it
    assert told == ["the places of 1 of 2 frames contradict many of their matches and may be wrong: c; add photos from between"]
    assert doubts({"agreement": {"0": 0.9}, "pictures": pictures}) == doubts({"agreement": {}}) == doubts({}) == []


# --------------------------------------------------------------------------------------------- oblique views


def test_oblique_views_find_what_is_seen_from_the_side():
    front = render(arc(1, 0)[0])[0][..., 0]
    wide = np.array([[0.4, 0, 40], [0.1, 1, 0]], np.float32)  # as a wall is seen from 66° to its side
    side = cv2.warpAffine(front, wide, (front.shape[1], front.shape[0]), flags=cv2.INTER_AREA, borderValue=90)

    def right(find) -> int:
        """Matches by the ratio test that are where the warp puts them."""
        (first, one), (second, other) = find(front, 2048), find(side, 2048)
        pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(one.astype(np.float32), other.astype(np.float32), k=2)
        good = np.array([(a.queryIdx, a.trainIdx) for a, b in pairs if a.distance < 0.8 * b.distance]).reshape(-1, 2)
        expected = (first[good[:, 0], :2] - 0.5) @ wide[:, :2].T + wide[:, 2] + 0.5
        return int(np.count_nonzero(np.linalg.norm(expected - second[good[:, 1], :2], axis=1) < 2))

    assert right(tilted) > 3 * right(sift)
    keypoints, descriptors = tilted(front, 300)
    assert keypoints.shape == (300, 4) and descriptors.shape == (300, 128) and descriptors.dtype == np.uint8
    np.testing.assert_array_equal(keypoints, tilted(front, 300)[0])
    assert len(tilted(np.full((64, 64), 90, np.uint8), 300)[0]) == 0


def test_photos_without_a_place_are_looked_at_obliquely(tmp_path, monkeypatch):
    poses = arc(4, 135)
    job = matched(tmp_path, poses)
    before, _ = placing._mapped(job, silent)
    assert before is not None and len(before.registered) < 4  # the reason to look again
    notes: list[str] = []
    model, facts = placing.place(job, lambda done, total, note: notes.append(note))
    assert model is not None and len(model.registered) >= len(before.registered) and error(model, poses) < 0.01
    assert min(facts["agreement"].values()) > 0.9 and any("seen obliquely" in note for note in notes)
    again = plain(placing.place(job, silent)[0])  # from the features that are there
    assert again == plain(model)
    monkeypatch.setattr(placing, "_obliquely", lambda *_: pytest.fail("was looked at obliquely"))
    assert "agreement" not in placing.place(replace(job, sequential=True), silent)[1]
    many = replace(job, pictures=job.pictures * 4)
    assert len(many.pictures) > MAX_OBLIQUE and "agreement" not in placing.place(many, silent)[1]


def test_a_camera_that_turns_on_the_spot_stays_refused(tmp_path):
    from toolkit.errors import PoseError

    with pytest.raises(PoseError, match="turned on the spot"):
        find_poses(write_capture(tmp_path / "photos", turning(6)), tmp_path, PosesSettings(max_features=400), seed=3, threads=1)


def test_six_photos_of_a_real_capture(tmp_path):
    """Without oblique views one of them gets a place that is off by two thirds of the cameras' spread, and nothing tells."""
    given_poses = open_capture(shared_data("fox_540x960"))
    names = ["0006", "0021", "0033", "0052", "0081", "0105"]
    (tmp_path / "photos").mkdir()
    for name in names:
        (tmp_path / "photos" / f"{name}.jpg").symlink_to(shared_data(f"fox_540x960/images/{name}.jpg"))
    result = find_poses(open_capture(tmp_path / "photos"), tmp_path, PosesSettings(max_features=2048), seed=0, threads=1)
    true = {frame.name: frame.world_from_camera for frame in given_poses.frames}
    assert result.registered == 6 and not any("contradict" in warning for warning in result.warnings)
    assert aligned_error(result.world_from_camera[:, :3, 3], np.array([true[name] for name in result.names])[:, :3, 3]) < 0.01
