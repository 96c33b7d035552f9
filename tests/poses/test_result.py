"""Poses as plain data: round trip, applied to a capture, given by the source, scaled to metres by depth maps."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from fieldfuse.camera import Similarity, pixel_grid, unproject
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.errors import InputError, PoseError
from fieldfuse.poses.result import GIVEN, SFM, PoseResult, given_poses, listed, scale_to_depth
from tests.poses.textured import CAMERA, arc, render


def capture(count: int = 6) -> Capture:
    frames = [Frame(f"f{n}", Path(f"/nowhere/f{n}.png"), CAMERA, pose) for n, pose in enumerate(arc(count))]
    return Capture("transforms", Path("/nowhere"), tuple(frames), metric=True, up=(0.0, -1.0, 0.0), points=np.ones((4, 3)))


def test_round_trip_through_json():
    result = replace(given_poses(capture()), point_errors=np.array([0.1, 0.2, 1 / 3, 4.0]), seconds={"total": 1.5}, warnings=["one"])
    back = PoseResult.from_dict(json.loads(json.dumps(result.to_dict(), allow_nan=False)))
    np.testing.assert_allclose(back.world_from_camera, result.world_from_camera, atol=1e-15)
    np.testing.assert_allclose(back.point_errors, result.point_errors, rtol=1e-3)
    assert back.intrinsics == result.intrinsics and back.names == result.names and back.warnings == ["one"]
    assert (back.source, back.registered, back.total, back.models, back.metric) == (GIVEN, 6, 6, [6], True)


@pytest.mark.parametrize("damage", [{"names": 3}, {"world_from_camera": [[1]]}, {"intrinsics": []}, {"models": None}])
def test_a_damaged_file_is_refused(damage):
    with pytest.raises(InputError):
        PoseResult.from_dict({**given_poses(capture()).to_dict(), **damage})


def test_given_poses_leave_out_what_has_none():
    whole = capture()
    holed = whole.with_frames([replace(f, world_from_camera=None) if f.name == "f2" else f for f in whole.frames])
    result = given_poses(holed)
    assert result.missing == ["f2"] and result.registered == 5 and "f2" in result.warnings[0]
    applied = result.apply(holed)
    assert applied.posed and [f.name for f in applied.frames] == ["f0", "f1", "f3", "f4", "f5"]
    assert applied.up == (0.0, -1.0, 0.0) and applied.metric and applied.points is not None


def test_given_poses_need_two_cameras_on_two_spots():
    whole = capture()
    with pytest.raises(PoseError, match=r"poses\.source=sfm"):
        given_poses(whole.with_frames(whole.frames[:1]))
    with pytest.raises(PoseError, match="one spot"):
        given_poses(whole.with_frames([replace(f, world_from_camera=np.eye(4)) for f in whole.frames]))


def test_found_poses_replace_everything_the_source_said_about_space():
    found = replace(given_poses(capture()), source=SFM, points=np.zeros((7, 3)), metric=False, names=["f1", "f3"])
    found = replace(found, intrinsics=found.intrinsics[:2], world_from_camera=found.world_from_camera[:2], registered=2)
    applied = found.apply(capture())
    assert applied.up is None and not applied.metric and applied.points.shape == (7, 3) and len(applied.frames) == 2
    np.testing.assert_array_equal(applied.frames[1].world_from_camera, found.world_from_camera[1])


def test_poses_of_another_capture_are_refused():
    with pytest.raises(InputError, match="f5"):
        given_poses(capture()).apply(capture(5))


def test_long_lists_are_cut():
    assert listed(["a", "b"]) == "a, b"
    assert listed([str(n) for n in range(20)], most=3) == "0, 1, 2 and 17 more"


@pytest.fixture(scope="module")
def measured(tmp_path_factory) -> tuple[Capture, PoseResult]:
    """Five views with depth in metres, and poses and points of them in a frame a seventh as large."""
    folder: Path = tmp_path_factory.mktemp("depth")
    frames, points, poses = [], [], arc(5)
    for n, pose in enumerate(poses):
        _, depth = render(pose)
        cv2.imwrite(str(folder / f"{n}.png"), np.round(depth * 1000).astype(np.uint16))
        frames.append(Frame(str(n), folder / f"{n}.png", depth=folder / f"{n}.png", depth_intrinsics=CAMERA))
        pick = np.random.default_rng(n).choice(320 * 240, 60, replace=False)
        z = depth.ravel()[pick].astype(np.float64)
        points.append(unproject(CAMERA, pose, pixel_grid(320, 240)[pick][z > 0], z[z > 0]))
    small = Similarity(1 / 7, np.eye(3), np.zeros(3))
    result = PoseResult(
        SFM, 5, 5, [str(n) for n in range(5)], [CAMERA] * 5, small.poses(poses), models=[5], points=small.points(np.concatenate(points))
    )
    return Capture("tum", folder, tuple(frames), metric=True), result


def test_scale_comes_from_the_depth_maps(measured):
    capture, result = measured
    scaled = scale_to_depth(result, capture)
    np.testing.assert_allclose(scaled.world_from_camera[:, :3, 3], arc(5)[:, :3, 3], rtol=0.01)
    np.testing.assert_allclose(scaled.points, 7 * result.points, rtol=0.01)
    assert scaled.metric and not scaled.warnings


def test_depth_that_disagrees_is_told_and_not_used(measured):
    capture, result = measured
    # As if the depth maps belonged to other pictures.
    shuffled = capture.with_frames([replace(f, depth=capture.frames[(n * 2 + 1) % 5].depth) for n, f in enumerate(capture.frames)])
    torn = replace(result, points=result.points * np.random.default_rng(0).uniform(0.3, 3, (len(result.points), 1)))
    told = scale_to_depth(torn, shuffled)
    assert "disagree on scale" in told.warnings[0] and not told.metric
    np.testing.assert_array_equal(told.world_from_camera, result.world_from_camera)


def test_too_few_points_are_told(measured):
    capture, result = measured
    told = scale_to_depth(replace(result, points=result.points[:5]), capture)
    assert "too few points" in told.warnings[0] and not told.metric
