"""Views of panoramas are one rig to structure from motion: one place an instant, exact intrinsics, whole instants in pairs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from fieldfuse.camera import Array, Intrinsics, invert
from fieldfuse.capture.sphere import announced, cut_images
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.config import PosesSettings
from fieldfuse.poses.job import Job, plan
from fieldfuse.poses.pairs import view_pairs
from fieldfuse.poses.sfm import find_poses
from tests.capture.spheres import room, walk
from tests.poses.textured import aligned_error

CAMERA = Intrinsics.equirectangular(576, 288)
SETTINGS = PosesSettings(max_features=1100)


@pytest.fixture(scope="module")
def cut(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    """Four panoramas, without poses, as views."""
    folder = tmp_path_factory.mktemp("panoramas")
    frames = []
    for number, pose in enumerate(walk(4)):
        path = folder / f"{number}.png"
        cv2.imwrite(str(path), cv2.cvtColor(room(CAMERA, pose, soft=1)[0], cv2.COLOR_RGB2BGR))
        frames.append(Frame(str(number), path, CAMERA))
    return cut_images(announced(Capture("photos", folder, tuple(frames))), folder / "run", 2)


def places(names: list[str], poses: Array, capture: Capture) -> dict[str, list[Array]]:
    """(4, 4) world from the panorama, by each of its views."""
    known = {frame.name: frame for frame in capture.frames}
    out: dict[str, list[Array]] = {}
    for name, pose in zip(names, poses, strict=True):
        frame = known[name]
        assert frame.instant is not None and frame.source_from_view is not None
        out.setdefault(frame.instant, []).append(pose @ invert(frame.source_from_view))
    return out


def test_every_instant_gets_one_place(cut: Capture, tmp_path: Path) -> None:
    result = find_poses(cut, tmp_path, SETTINGS, threads=1)
    assert result.registered == 28 and not result.missing
    assert set(result.intrinsics) == {frame.intrinsics for frame in cut.frames}
    found = places(result.names, result.world_from_camera, cut)
    for poses in found.values():
        np.testing.assert_allclose(poses, [poses[0]] * 7, atol=1e-9)
    mine, true = np.array([poses[0] for poses in found.values()]), walk(4)
    assert aligned_error(mine[:, :3, 3], true[:, :3, 3]) < 0.01
    turned = [np.linalg.norm(a[:3, :3].T @ mine[0, :3, :3] - b[:3, :3].T @ true[0, :3, :3]) for a, b in zip(mine, true, strict=True)]
    assert max(turned) < 0.01


def test_views_are_paired_across_instants_and_never_within(cut: Capture) -> None:
    job = plan(cut, Path("nowhere"), SETTINGS, 0, 1)
    assert job.rigged and [len(views) for views in job.instants] == [7] * 4 and job.max_features == 1024
    assert len(set(job.view_cameras.values())) == 7
    random = np.random.default_rng(0)
    vectors = random.normal(size=(28, 20, 128))
    vectors[7 * 3 + 2] = vectors[7 * 1 + 4]  # the fifth view of the second instant shows what the third of the fourth does
    sketches = [np.asarray(view / np.linalg.norm(view, axis=1, keepdims=True), np.float32) for view in vectors]
    pairs = view_pairs(job, sketches)
    assert (11, 23) in pairs and all(i // 7 != j // 7 for i, j in pairs)
    assert {(i % 7, j % 7) for i, j in pairs if j // 7 - i // 7 <= 2} - {(4, 2)} == {(view, view) for view in range(7)}


def test_the_job_survives_its_file(cut: Capture, tmp_path: Path) -> None:
    job = plan(cut, tmp_path, SETTINGS, 0, 1)
    job.save(tmp_path / "job.json")
    again = Job.load(tmp_path / "job.json")
    assert again.key() == job.key() and again.view_cameras == job.view_cameras
    turned = replace(cut.frames[0], source_from_view=np.diag([-1.0, -1.0, 1.0, 1.0]))
    assert plan(cut.with_frames([turned, *cut.frames[1:]]), tmp_path, SETTINGS, 0, 1).key() != job.key()
