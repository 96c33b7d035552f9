"""Poses as plain data: round trip, applied to a capture, given by the source."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fieldfuse.capture.types import Capture, Frame
from fieldfuse.errors import InputError, PoseError
from fieldfuse.poses.given import given_poses
from fieldfuse.poses.result import GIVEN, SFM, PoseResult, listed
from tests.poses.textured import CAMERA, arc


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
