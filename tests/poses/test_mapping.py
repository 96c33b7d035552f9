"""The last adjustment of a model: it brings cameras to where the pictures say, and drops points that got lost."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest

from fieldfuse.config import PosesSettings
from fieldfuse.poses import mapping
from fieldfuse.poses.job import Job
from fieldfuse.poses.sfm import find_poses
from tests.poses.textured import aligned_error, arc, render, write_capture

POSES = arc(8)


def silent(done: float, total: float, note: str) -> None:
    pass


@pytest.fixture(scope="module")
def job(tmp_path_factory) -> Job:
    out = tmp_path_factory.mktemp("corner")
    find_poses(write_capture(out / "photos", [render(pose)[0] for pose in POSES]), out, PosesSettings(max_features=800), seed=3, threads=1)
    return Job.load(out / "sparse" / "job.json")


@pytest.fixture
def model(job) -> mapping.Model:
    model, attempts = mapping.map_pictures(job, silent)
    assert model is not None and attempts == [{"attempt": mapping.STRICT, "models": [8]}]
    return model


def centres(model: mapping.Model) -> np.ndarray:
    return np.array(mapping.plain(model)["world_from_camera"])[:, :3, 3]


def test_cameras_come_to_where_the_pictures_say(job, model):
    for image_id in model.registered[2:6]:
        frame = model.reconstruction.frame(model.reconstruction.image(image_id).frame_id)
        pose = frame.rig_from_world
        frame.rig_from_world = pycolmap.Rigid3d(pose.rotation, np.asarray(pose.translation) + 0.03 * (-1) ** image_id)
    moved = aligned_error(centres(model), POSES[:, :3, 3])
    mapping.finish(job, model, silent)
    found = centres(model)
    assert moved > 0.01 and aligned_error(found, POSES[:, :3, 3]) < 0.004
    mapping.finish(job, model, silent)
    assert np.abs(centres(model) - found).max() < 2e-4, "it was at its end"


def test_points_that_got_lost_are_dropped_and_told_of_no_more(job, model):
    before = model.reconstruction.num_points3D()
    points = model.reconstruction.points3D
    far = min(points, key=lambda i: (points[i].track.length(), i))  # few pictures would call it back
    camera = model.reconstruction.image(points[far].track.elements[0].image_id).projection_center()
    points[far].xyz = camera + 1e4 * (points[far].xyz - camera)
    mapping.finish(job, model, silent)
    left = set(model.reconstruction.points3D)
    assert far not in left and len(left) > 0.95 * before
    plain = mapping.plain(model)
    assert np.isfinite(plain["error"]) and plain["error"] < 1.0
    assert np.isfinite(plain["points"]).all() and max(plain["point_errors"]) < 4.0
