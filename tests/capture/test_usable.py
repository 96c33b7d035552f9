"""One bad part does not stop a good whole: what is wrong with single frames costs these alone."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fieldfuse.capture import open_capture
from fieldfuse.capture.checks import check_capture
from fieldfuse.capture.poses import checked_pose, lenient_poses
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.capture.usable import without
from fieldfuse.errors import InputError
from tests.capture.layouts import LAYOUTS
from tests.pipelines.made import circle, make_room

COUNT = 10
EVERY = [name for name in LAYOUTS if name not in ("sens", "stray", "record3d")]  # those hold their images in one file


@pytest.fixture
def room(tmp_path: Path) -> Path:
    make_room(tmp_path / "room", COUNT)
    return tmp_path / "room"


def changed(room: Path, *which: int, by: object) -> Path:
    """The capture with other matrices at some frames of its transforms.json: `by` makes them of what is there."""
    path = room / "transforms.json"
    data = json.loads(path.read_text())
    for number in which:
        entry = data["frames"][number]
        entry["transform_matrix"] = by(np.array(entry["transform_matrix"])).tolist()  # type: ignore[operator]
    path.write_text(json.dumps(data))
    return room


def scaled(factor: float):  # type: ignore[no-untyped-def]
    def change(pose: np.ndarray) -> np.ndarray:
        pose[:3, :3] *= factor
        return pose

    return change


@pytest.mark.parametrize("fill", [np.nan, 0.0])
def test_a_few_poses_that_hold_nothing_cost_their_frames(room: Path, fill: float) -> None:
    whole = open_capture(room)
    capture = open_capture(changed(room, 2, 7, by=lambda pose: np.full((4, 4), fill)))
    assert len(capture.frames) == COUNT - 2 and len(whole.frames) == COUNT
    assert any(f"2 frames of {COUNT} are left out" in warning for warning in capture.warnings)


def test_too_many_of_them_refuse_the_capture(room: Path) -> None:
    with pytest.raises(InputError, match=rf"not finite.*3 of {COUNT} poses hold nothing usable"):
        open_capture(changed(room, 2, 5, 7, by=lambda pose: np.full((4, 4), np.nan)))


def test_a_uniform_scale_is_taken_out_of_rotations(room: Path) -> None:
    whole = open_capture(room)
    capture = open_capture(changed(room, *range(COUNT), by=scaled(0.4)))
    assert any("scaled by 0.4" in warning for warning in capture.warnings)
    for one, other in zip(capture.frames, whole.frames, strict=True):
        np.testing.assert_allclose(one.world_from_camera, other.world_from_camera, atol=1e-9)


def test_rounded_rotations_are_made_rigid(room: Path) -> None:
    capture = open_capture(changed(room, *range(COUNT), by=lambda pose: pose.round(2)))
    assert any("rounded?" in warning for warning in capture.warnings)
    for frame in capture.frames:
        turn = np.asarray(frame.world_from_camera)[:3, :3]
        np.testing.assert_allclose(turn.T @ turn, np.eye(3), atol=1e-12)


def test_a_sheared_rotation_costs_its_frame_and_several_the_capture(room: Path) -> None:
    def sheared(pose: np.ndarray) -> np.ndarray:
        pose[:3, :3] = pose[:3, :3] @ np.array([[1, 0.3, 0], [0, 1, 0], [0, 0, 1]])
        return pose

    capture = open_capture(changed(room, 3, by=sheared))
    assert len(capture.frames) == COUNT - 1 and "sheared" in capture.warnings[0]
    with pytest.raises(InputError, match=r"sheared.*\(3 of 10 poses"):
        open_capture(changed(room, 5, 6, by=sheared))


@pytest.mark.parametrize("scale", [1e-4, 25.0])
def test_no_uniform_scale_is_too_small(scale: float, room: Path) -> None:
    def scaled(pose: np.ndarray) -> np.ndarray:
        pose[:3, :3] *= scale
        return pose

    capture = open_capture(changed(room, *range(COUNT), by=scaled))
    assert capture.warnings == (f"the rotations of 10 poses were scaled by {scale:.4g}, which was removed",)


def test_outside_of_readers_poses_are_checked_as_strictly_as_before() -> None:
    turn = np.eye(4)
    turn[:3, :3] = 0.4 * Rotation.from_rotvec(np.array([[0.1, 0.2, 0.3]])).as_matrix()[0]
    with pytest.raises(InputError, match="not rigid"):
        checked_pose(turn, "here")
    with lenient_poses() as notes:
        assert np.isnan(checked_pose(np.full((4, 4), np.nan), "here")).all()
        np.testing.assert_allclose(checked_pose(turn, "here")[:3, :3] * 0.4, turn[:3, :3], atol=1e-12)
    assert notes.scales == pytest.approx([0.4]) and notes.unusable == ["here: the pose holds a value that is not finite; "
                                                                       "remove this frame or correct it"]
    with pytest.raises(InputError, match="not finite"):
        checked_pose(np.full((4, 4), np.nan), "here")


def test_what_is_left_out_is_named() -> None:
    frames = tuple(Frame(f"{number}", Path(f"{number}.png"), world_from_camera=pose) for number, pose in enumerate(circle(10)))
    capture = Capture("photos", Path("/here"), frames)
    assert without(capture, {}) is capture
    less = without(capture, {"3": "3.png is empty; copy it again"})
    assert [frame.name for frame in less.frames] == [str(number) for number in range(10) if number != 3]
    assert less.warnings == ("1 frame of 10 is left out (3): 3.png is empty",)
    with pytest.raises(InputError, match=r"empty; copy it again \(3 frames of 10|3 of 10"):
        without(capture, dict.fromkeys("345", "3.png is empty; copy it again"))
    with pytest.raises(InputError, match="empty"):
        without(Capture("photos", Path("/here"), frames[:3]), {"1": "1.png is empty"})


@pytest.mark.parametrize("layout", EVERY)
@pytest.mark.parametrize("which", [0, 2])
def test_an_empty_or_damaged_image_costs_its_frame_in_every_layout(layout: str, which: int, tmp_path: Path) -> None:
    folder = tmp_path / layout
    LAYOUTS[layout][1](folder)
    frames = open_capture(folder).frames
    image, whole = frames[which].image, frames[which].image.read_bytes()
    for data in (b"", whole[: len(whole) // 3]):
        image.write_bytes(data)
        capture = check_capture(open_capture(folder))
        assert {frame.name for frame in capture.frames} == {frame.name for frame in frames} - {frames[which].name}
        assert any("left out" in warning and image.name in warning for warning in capture.warnings)
    for frame in frames:
        frame.image.write_bytes(b"")
    with pytest.raises(InputError):
        check_capture(open_capture(folder))


@pytest.mark.parametrize("data", [None, b"", b"no image"])
def test_a_lost_depth_map_costs_no_frame(data: bytes | None, tmp_path: Path) -> None:
    make_room(tmp_path / "room", COUNT, depth=True)
    frames = open_capture(tmp_path / "room").frames
    path = frames[4].depth
    assert path is not None
    path.unlink() if data is None else path.write_bytes(data)
    capture = check_capture(open_capture(tmp_path / "room"))
    assert len(capture.frames) == COUNT and sum(frame.depth is None for frame in capture.frames) == 1
    assert any("without depth" in warning or "do not exist" in warning or "not found" in warning for warning in capture.warnings)
