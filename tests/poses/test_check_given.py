"""Given poses against the images: each usual mistake is undone, wrong cameras are left out, and what is right or merely inexact passes."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fieldfuse.camera import Array, invert
from fieldfuse.capture import open_capture
from fieldfuse.capture.photos import with_unposed
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.errors import PoseError
from fieldfuse.export.cameras import write_colmap
from fieldfuse.poses import check_given as module
from fieldfuse.poses.check_given import LEAST_MATCHES, best_fitting, check_given, choose_images, same_poses
from fieldfuse.poses.mistakes import FILE_AXES, readings
from fieldfuse.poses.points import Features
from fieldfuse.poses.result import PoseResult, given_poses
from fieldfuse.poses.two_view import deviation, find_matches
from tests.conftest import shared_data
from tests.poses.textured import CAMERA, arc, render

COUNT = 12
RIGHT = arc(COUNT, 70.0)
RANDOM = np.random.default_rng(7)


def capture_of(poses: Array, folder: Path, kind: str = "colmap") -> Capture:
    return Capture(kind, folder, tuple(Frame(f"{n:02d}", folder / f"{n:02d}.png", CAMERA, pose) for n, pose in enumerate(poses)))


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("given")
    for n, pose in enumerate(RIGHT):
        cv2.imwrite(str(out / f"{n:02d}.png"), render(pose)[0])
    return out


@pytest.fixture(scope="module")
def known() -> dict[str, Features]:
    """Features, found once for all tests."""
    return {}


@pytest.fixture(scope="module", autouse=True)
def matched_once() -> Iterator[None]:
    """Matching does not look at poses, so what several tests match is matched once."""
    found: dict[Any, Any] = {}

    def find(capture: Capture, frames: Any, links: Any = (), **options: Any) -> Any:
        cameras = tuple((capture.frames[i].image, capture.frames[i].intrinsics) for i in frames)
        key = (cameras, tuple(links), tuple(options.get("alike") or ()))
        if key not in found:
            found[key] = find_matches(capture, frames, links, **options)
        return found[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "find_matches", find)
        yield


@pytest.fixture(scope="module")
def check(folder, known) -> Callable[..., PoseResult]:
    def of(poses: Array, kind: str = "colmap", convention: str = "auto", focal: float = 1.0) -> PoseResult:
        capture = capture_of(poses, folder, kind)
        frames = [replace(f, intrinsics=replace(CAMERA, fx=focal * CAMERA.fx, fy=focal * CAMERA.fy)) for f in capture.frames]
        capture = capture.with_frames(frames)
        return check_given(capture, given_poses(capture), convention, known=known)

    return of


def turned(poses: Array, rotation: Array) -> Array:
    out = poses.copy()
    out[:, :3, :3] = out[:, :3, :3] @ rotation
    return out


def with_parts(poses: Array, rotation: Array | None = None, centre: Array | None = None) -> Array:
    out = poses.copy()
    out[:, :3, :3] = poses[:, :3, :3] if rotation is None else rotation
    out[:, :3, 3] = poses[:, :3, 3] if centre is None else centre
    return out


def reordered(poses: Array, order: list[int]) -> Array:
    """Poses whose quaternions, w x y z, are read in another order."""
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]][:, order]
    return with_parts(poses, Rotation.from_quat(quaternions[:, [1, 2, 3, 0]]).as_matrix())


def shaken(poses: Array, degrees: float) -> Array:
    turns = np.array([cv2.Rodrigues(np.radians(degrees) * v)[0] for v in RANDOM.normal(size=(len(poses), 3)) / np.sqrt(3)])
    return with_parts(poses, turns @ poses[:, :3, :3])


def same_geometry(found: Array, right: Array) -> bool:
    """Whether two sets of poses are the same up to a move of the world and its scale."""
    one, other = (invert(poses[0]) @ poses for poses in (found, right))
    scale = np.linalg.norm(other[-1, :3, 3]) / np.linalg.norm(one[-1, :3, 3])
    return bool(np.allclose(one[:, :3, :3], other[:, :3, :3], atol=1e-6) and np.allclose(scale * one[:, :3, 3], other[:, :3, 3], atol=1e-6))


MISTAKES = {
    "inverted": invert(RIGHT),
    "OpenGL axes": turned(RIGHT, np.diag([1.0, -1, -1])),
    "inverted, OpenGL axes": turned(invert(turned(RIGHT, np.diag([1.0, -1, -1]))), np.eye(3)),
    "images turned by 180°": turned(RIGHT, np.diag([-1.0, -1, 1])),
    "x forward, y left, z up": turned(RIGHT, np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])),
    "rows for columns": with_parts(RIGHT, np.swapaxes(RIGHT[:, :3, :3], 1, 2)),
    "rows for columns, world-to-camera": invert(with_parts(invert(RIGHT), RIGHT[:, :3, :3])),
    "quaternion x y z w": reordered(RIGHT, [1, 2, 3, 0]),
    "quaternion x y z w, world-to-camera": invert(reordered(invert(RIGHT), [1, 2, 3, 0])),
    "quaternion w x y z": reordered(RIGHT, [3, 0, 1, 2]),
    "centre for translation": invert(with_parts(invert(RIGHT), centre=RIGHT[:, :3, 3])),
    "translation for centre": with_parts(RIGHT, centre=invert(RIGHT)[:, :3, 3]),
    "positions negated": with_parts(RIGHT, centre=-RIGHT[:, :3, 3]),
    "y and z of positions swapped": with_parts(RIGHT, centre=RIGHT[:, [0, 2, 1], 3]),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_usual_mistake_is_found_undone_and_told(check, mistake):
    result = check(MISTAKES[mistake])
    assert same_geometry(result.world_from_camera, RIGHT)
    assert len(result.warnings) == 1 and "do not fit its images as they came" in result.warnings[0]
    assert result.agreement is not None and result.agreement["share"] > 0.9 and result.agreement["reading"]


@pytest.mark.parametrize("kind", ["transforms", "llff", "colmap"])
def test_inverses_are_undone_in_the_axes_of_the_file(check, kind):
    axes = np.eye(4)
    axes[:3, :3] = FILE_AXES.get(kind, np.eye(3))
    file = RIGHT @ axes.T  # right matrices with the file's camera axes
    result = check(invert(file) @ axes, kind)  # as the reader of that kind takes their inverses
    assert np.allclose(result.world_from_camera, RIGHT, atol=1e-9)  # the very world of the file, whose axes have a meaning


def test_as_is_keeps_the_poses_and_says_that_they_do_not_fit(check):
    result = check(MISTAKES["inverted"], convention="as_is")
    assert np.array_equal(result.world_from_camera, MISTAKES["inverted"]) and "kept as they came" in result.warnings[0]
    shuffled = RIGHT[RANDOM.permutation(COUNT)]
    assert np.array_equal(check(shuffled, convention="as_is").world_from_camera, shuffled)


def test_right_poses_pass_in_silence(check):
    result = check(RIGHT)
    assert np.array_equal(result.world_from_camera, RIGHT) and result.warnings == []
    assert result.agreement is not None and result.agreement["share"] > 0.9 and result.agreement["pairs"] > 20


@pytest.mark.parametrize("degrees", [0.1, 1.0, 3.0])
def test_noisy_poses_are_never_refused_nor_read_otherwise(check, degrees):
    poses = shaken(RIGHT, degrees)
    result = check(poses)
    assert np.array_equal(result.world_from_camera, poses)
    assert all("inexact" in text for text in result.warnings) and (degrees > 0.5 or not result.warnings)


@pytest.mark.parametrize("factor", [0.95, 1.05])
def test_slightly_wrong_focal_lengths_are_left_to_refinement(check, factor):
    result = check(RIGHT, focal=factor)
    assert result.warnings == [] and result.intrinsics[0].fx == factor * CAMERA.fx


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_a_focal_length_of_another_image_size_is_found(check, factor):
    result = check(RIGHT, focal=factor)
    assert result.intrinsics[0].fx == pytest.approx(CAMERA.fx, rel=0.15) and "focal length" in result.warnings[0]


@pytest.mark.parametrize("poses", [RIGHT[RANDOM.permutation(COUNT)], RIGHT[::-1].copy()], ids=["shuffled", "reversed"])
def test_poses_of_other_images_are_refused_for_what_they_are(check, poses):
    with pytest.raises(PoseError, match=r"do not fit its images: \d+% of .* matches .* --poses sfm"):
        check(poses)


@pytest.mark.parametrize("wrong", [np.eye(4), RIGHT[0] @ np.diag([1.0, -1, -1, 1])], ids=["identity", "turned"])
def test_a_few_wrong_cameras_are_left_out_by_name(check, wrong):
    poses = RIGHT.copy()
    poses[[4, 9]] = wrong
    result = check(poses)
    assert result.missing == ["04", "09"] and "04, 09" in result.warnings[0]
    assert np.array_equal(result.world_from_camera, np.delete(RIGHT, [4, 9], axis=0)) and result.registered == COUNT - 2


def test_a_camera_far_away_is_left_out(check):
    poses = RIGHT.copy()
    poses[5, :3, 3] *= 500
    assert check(poses).missing == ["05"]


def test_frames_before_tracking_began_share_a_pose_and_are_left_out_however_many(check):
    poses = RIGHT.copy()
    poses[:4] = np.eye(4)
    result = check(poses)
    assert result.missing == ["00", "01", "02", "03"] and "one and the same pose" in result.warnings[0]


def test_the_same_image_twice_has_the_same_pose_rightly(folder, known, tmp_path):
    poses = np.concatenate([RIGHT, RIGHT[3:4]])
    frames = [*capture_of(RIGHT, folder).frames, Frame("12", folder / "03.png", CAMERA, RIGHT[3])]
    capture = Capture("colmap", folder, tuple(frames))
    result = check_given(capture, given_poses(capture), known=known)
    assert result.missing == [] and result.warnings == [] and len(result.world_from_camera) == len(poses)


def test_images_without_texture_prove_nothing(tmp_path):
    for n in range(4):
        cv2.imwrite(str(tmp_path / f"{n:02d}.png"), np.full((240, 320), 90 + n, np.uint8))
    capture = capture_of(RIGHT[[3, 1, 2, 0]], tmp_path)
    result = check_given(capture, given_poses(capture))
    assert result.agreement is None and result.warnings == [] and result.registered == 4


def test_three_images_are_too_few_to_refuse(folder, known):
    capture = capture_of(RIGHT, folder)
    few = capture.with_frames([replace(capture.frames[i], world_from_camera=RIGHT[j]) for i, j in ((0, 9), (1, 3), (2, 11))])
    result = check_given(few, given_poses(few), known=known)
    assert len(result.warnings) == 1 and "may be inexact or wrong" in result.warnings[0]


def test_wrong_cameras_among_many_are_searched_for_when_one_is_met(check, monkeypatch):
    monkeypatch.setattr(module, "MOST_IMAGES", 6)
    poses = RIGHT.copy()
    poses[[6, 7]] = poses[[6, 7]] @ np.diag([1.0, -1, -1, 1])
    assert set(check(poses).missing) == {"06", "07"}


def test_of_several_pose_sources_the_one_that_fits_is_chosen(folder):
    candidates = [capture_of(poses, folder) for poses in (RIGHT[::-1].copy(), shaken(RIGHT, 2.0), RIGHT)]
    assert best_fitting(candidates) == 2


def test_of_several_colmap_models_the_one_that_fits_the_images_is_read(folder, tmp_path):
    root = tmp_path / "scene"
    shutil.copytree(folder, root / "images")
    names = [f"{n:02d}.png" for n in range(len(RIGHT))]
    for number, poses in enumerate((RIGHT[::-1], RIGHT)):
        write_colmap(root / "sparse" / str(number), names, [CAMERA] * len(RIGHT), poses)
    first, best = open_capture(root), open_capture(root, choose=best_fitting)
    assert np.allclose([frame.world_from_camera for frame in first.frames], RIGHT[::-1], atol=1e-6)
    assert np.allclose([frame.world_from_camera for frame in best.frames], RIGHT, atol=1e-6)


def test_matches_are_found_without_poses_and_mirrored_ones_count_as_behind(folder, known):
    capture = capture_of(RIGHT, folder)
    matches = find_matches(capture, range(COUNT), known=known)
    again = find_matches(capture_of(RIGHT[::-1].copy(), folder), range(COUNT), known=known)
    assert np.array_equal(matches.pairs, again.pairs) and np.array_equal(matches.here, again.here)
    assert len(matches.pair) > LEAST_MATCHES and np.median(deviation(RIGHT, matches)) < 0.3
    assert np.median(deviation(MISTAKES["positions negated"], matches)) > 2  # the same epipolar lines, and every point behind


def test_readings_hold_the_right_poses_once_and_never_the_given_ones():
    for reading in readings(RIGHT, "transforms"):
        assert reading.focal != 1 or reading.centred or not np.allclose(reading.poses, RIGHT)
        assert np.allclose(np.linalg.det(reading.poses[:, :3, :3]), 1)


def test_the_images_looked_at_are_few_and_hold_the_odd_ones():
    poses = np.tile(np.eye(4), (400, 1, 1))
    poses[:, 0, 3] = np.arange(400)
    poses[[77, 78, 79]] = np.eye(4)
    poses[301, 1, 3] = 1e6
    chosen = choose_images(poses, same_poses(poses))
    assert len(chosen) <= 40 and {77, 78, 301} <= set(chosen)


@pytest.mark.parametrize("name", ["llff_fern_8", "zoo/bart-toy", "scannet_sample_11"])
def test_right_captures_raise_no_alarm(name):
    capture = open_capture(shared_data(name))
    result = check_given(capture, given_poses(capture))
    assert result.warnings == [] and result.missing == [] and result.agreement is not None and result.agreement["share"] > 0.9


def test_a_model_of_a_few_of_many_images_is_refused_and_finding_poses_takes_all_of_them(folder, tmp_path):
    for n in range(40):
        (tmp_path / f"{n:02d}.png").write_bytes((folder / "00.png").read_bytes())
    few = capture_of(RIGHT[:3], tmp_path)
    few = replace(few, extra={"unregistered": 37}, warnings=("37 pictures beside these are not in the model and are left out", "another"))
    with pytest.raises(PoseError, match=r"of 3 of 40 images only.*--poses sfm"):
        given_poses(few)
    whole = with_unposed(few)
    assert [frame.name for frame in whole.frames] == [f"{n:02d}" for n in range(40)] and whole.warnings == ("another",)
    assert sum(frame.world_from_camera is not None for frame in whole.frames) == 3 and with_unposed(whole) is whole
    assert given_poses(replace(few, extra={"unregistered": 2})).registered == 3
