"""7-Scenes: two cameras, units, files that do not belong together."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fieldfuse.capture import open_capture
from fieldfuse.capture.images import load_depth
from fieldfuse.capture.seven_scenes import read_seven_scenes
from fieldfuse.errors import InputError
from tests.capture.layouts import EIGHTH_585, rows, write_seven_scenes
from tests.capture.made import Pinhole, eyes, pixel_error, render, save_depth, save_picture
from tests.conftest import shared_data


def test_depth_has_a_camera_of_its_own_and_metres(tmp_path: Path) -> None:
    write_seven_scenes(tmp_path)
    capture = open_capture(tmp_path)
    assert capture.metric
    assert capture.ordered
    frame = capture.frames[0]
    assert frame.depth_intrinsics.fx == pytest.approx(585 / 8)
    assert frame.intrinsics.fx == pytest.approx(525 / 8)
    np.testing.assert_allclose(load_depth(frame, capture), render(eyes()[0], EIGHTH_585)[1], atol=6e-4)


def test_a_camera_file_replaces_the_depth_camera(tmp_path: Path) -> None:
    write_seven_scenes(tmp_path)
    (tmp_path / "camera-intrinsics.txt").write_text("600 0 320\n0 601 240\n0 0 1\n")
    camera = open_capture(tmp_path).frames[0].depth_intrinsics
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (75, 75.125, 40, 30)
    for text in ("600 0 320", "600 0 320 0 601 240 0 0 wide", "-600 0 320 0 601 240 0 0 1", "nan 0 320 0 601 240 0 0 1"):
        (tmp_path / "camera-intrinsics.txt").write_text(text)
        with pytest.raises(InputError, match=r"camera-intrinsics\.txt"):
            open_capture(tmp_path)


def test_a_camera_of_somebody_elses_is_the_colours_too(tmp_path: Path) -> None:
    write_seven_scenes(tmp_path)
    assert open_capture(tmp_path).warnings == (
        "no camera-intrinsics.txt was found; the usual cameras of 7-Scenes are used (525 pixels for colour, 585 for depth)",
    )
    for text in ("585 0 320\n0 585 240\n0 0 1\n", "73.125 0 40\n0 73.125 30\n0 0 1\n"):  # the set's own, and that for these pictures
        (tmp_path / "camera-intrinsics.txt").write_text(text)
        frame, capture = open_capture(tmp_path).frames[0], open_capture(tmp_path)
        assert (frame.intrinsics.fx, frame.depth_intrinsics.fx) == pytest.approx((525 / 8, 585 / 8))
        assert capture.warnings == ()
    (tmp_path / "camera-intrinsics.txt").write_text("616 0 320\n0 616 240\n0 0 1\n")
    frame = open_capture(tmp_path).frames[0]
    assert frame.intrinsics == frame.depth_intrinsics
    assert (frame.intrinsics.width, frame.intrinsics.fx, frame.intrinsics.cx) == (80, 77, 40)


def test_pictures_of_another_size_bring_their_own_camera(tmp_path: Path) -> None:
    write_seven_scenes(tmp_path)
    wide = Pinhole(160, 90, 112.5, 112.5, 80.0, 45.0)
    for index, eye in enumerate(eyes()):
        picture, depth = render(eye, wide)
        save_picture(tmp_path / f"frame-{index:06d}.color.png", picture)
        save_depth(tmp_path / f"frame-{index:06d}.depth.png", depth)
    with pytest.raises(InputError, match="another shape"):
        open_capture(tmp_path)
    (tmp_path / "camera-intrinsics.txt").write_text("112.5 0 80\n0 112.5 45\n0 0 1\n")
    capture = open_capture(tmp_path)
    assert capture.kind == "7scenes"
    assert capture.frames[0].depth_intrinsics == capture.frames[0].intrinsics
    assert pixel_error(capture, eyes(), wide) < 1e-3


def test_frames_whose_tracking_was_lost_are_left_out(tmp_path: Path) -> None:
    write_seven_scenes(tmp_path)
    (tmp_path / "camera-intrinsics.txt").write_text("585 0 320\n0 585 240\n0 0 1\n")
    (tmp_path / "frame-000003.pose.txt").write_text(rows(np.full((4, 4), -np.inf)))
    capture = open_capture(tmp_path)
    assert [frame.name[-1] for frame in capture.frames] == ["0", "1", "2", "4"]
    assert capture.warnings == ("1 frame left out because tracking was lost there (pose -inf or NaN)",)
    for path in tmp_path.glob("*.pose.txt"):
        path.write_text(rows(np.full((4, 4), -np.inf)))
    with pytest.raises(InputError, match="all 5 poses"):
        open_capture(tmp_path)


INFO = """m_versionNumber = 4
m_sensorName = StructureSensor
m_colorWidth = 640
m_colorHeight = 480
m_depthWidth = 320
m_depthHeight = 240
m_depthShift = 2000
m_calibrationColorIntrinsic = 583 0 320 0 0 584 240 0 0 0 1 0 0 0 0 1
m_calibrationColorExtrinsic = 1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1
m_calibrationDepthIntrinsic = 290 0 161.5 0 0 291 119.5 0 0 0 1 0 0 0 0 1
"""


def test_bundlefusion_tells_its_cameras_in_a_file_of_its_own(tmp_path: Path) -> None:
    write_seven_scenes(tmp_path)
    (tmp_path / "info.txt").write_text(INFO)
    capture = open_capture(tmp_path)
    colour, depth = capture.frames[0].intrinsics, capture.frames[0].depth_intrinsics
    assert (colour.fx, colour.fy, colour.cx, colour.cy) == (583 / 8, 73, 40, 30)
    assert (depth.fx, depth.fy, depth.cx, depth.cy) == (72.5, 72.75, 40.5, 30)
    assert (capture.depth_scale, capture.warnings) == (2000, ())
    (tmp_path / "info.txt").write_text("\n".join(line for line in INFO.splitlines() if "m_calibrationDepth" not in line))
    assert open_capture(tmp_path).frames[0].depth_intrinsics == colour
    (tmp_path / "info.txt").write_text("about = my holiday\n")  # somebody's notes
    assert open_capture(tmp_path).frames[0].intrinsics.fx == 525 / 8


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("583 0 320", "583 320", "must hold 16 numbers"),
        ("583 0 320", "-583 0 320", "must be positive"),
        ("583 0 320", "583 0 1320", "outside the 640×480 picture"),
        ("m_colorWidth = 640", "m_colorWidth = wide", "must hold numbers only;"),
        ("m_colorWidth = 640", "m_colorWidth = 0", "is not usable"),
        ("m_depthShift = 2000", "m_depthShift = 0", "must be positive"),
    ],
)
def test_a_broken_file_of_bundlefusion(tmp_path: Path, old: str, new: str, message: str) -> None:
    write_seven_scenes(tmp_path)
    (tmp_path / "info.txt").write_text(INFO.replace(old, new))
    with pytest.raises(InputError, match=rf"info\.txt.*{message}"):
        open_capture(tmp_path)


def test_pictures_and_poses_must_be_as_many(tmp_path: Path) -> None:
    write_seven_scenes(tmp_path)
    (tmp_path / "frame-000002.pose.txt").unlink()
    with pytest.raises(InputError, match="5 images but 4 poses"):
        open_capture(tmp_path)
    (tmp_path / "frame-000009.pose.txt").write_text(rows(np.eye(4)))
    with pytest.raises(InputError, match=r"no pose file frame-000002\.pose\.txt"):
        open_capture(tmp_path)


@pytest.mark.parametrize("pose", [np.full((4, 4), np.nan), np.full((4, 4), -np.inf), np.zeros((4, 4))])
def test_a_pose_that_holds_nothing_costs_its_frame_alone(tmp_path: Path, pose: np.ndarray) -> None:
    write_seven_scenes(tmp_path)
    count = len(open_capture(tmp_path).frames)
    (tmp_path / "frame-000003.pose.txt").write_text(rows(pose))
    capture = open_capture(tmp_path)
    assert len(capture.frames) == count - 1 and "frame-000003" not in {frame.name for frame in capture.frames}
    assert any("left out" in warning for warning in capture.warnings)


def test_no_frames(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    with pytest.raises(InputError, match="no frame-"):
        read_seven_scenes(tmp_path)


def test_redkitchen() -> None:
    capture = open_capture(shared_data("redkitchen"))
    assert (capture.kind, len(capture.frames), capture.frames[1].name) == ("7scenes", 200, "frame-000004")
    assert (capture.frames[0].depth_intrinsics.fx, capture.frames[0].intrinsics.fx) == (585, 525)
    assert capture.warnings == ()
