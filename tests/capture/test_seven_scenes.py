"""7-Scenes: two cameras, units, files that do not belong together."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.capture.layouts import EIGHTH_585, rows, write_seven_scenes
from tests.capture.made import eyes, render
from tests.conftest import shared_data
from toolkit.capture import open_capture
from toolkit.capture.images import load_depth
from toolkit.capture.seven_scenes import read_seven_scenes
from toolkit.errors import InputError


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


def test_frames_without_depth_are_kept(tmp_path: Path) -> None:
    write_seven_scenes(tmp_path)
    (tmp_path / "frame-000002.depth.png").unlink()
    frames = open_capture(tmp_path).frames
    assert [frame.depth is None for frame in frames] == [False, False, True, False, False]


def test_pictures_and_poses_must_be_as_many(tmp_path: Path) -> None:
    write_seven_scenes(tmp_path)
    (tmp_path / "frame-000002.pose.txt").unlink()
    with pytest.raises(InputError, match="5 pictures but 4 poses"):
        open_capture(tmp_path)
    (tmp_path / "frame-000009.pose.txt").write_text(rows(np.eye(4)))
    with pytest.raises(InputError, match=r"no pose file frame-000002\.pose\.txt"):
        open_capture(tmp_path)


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        (np.full((4, 4), np.nan), "not finite"),
        (np.zeros((4, 4)), "singular"),
        (np.diag([2.0, 2, 2, 1]), "not rigid"),
        (np.diag([-1.0, 1, 1, 1]), "mirrors"),
        (np.eye(3), "4×4 matrix is expected"),
    ],
)
def test_a_bad_pose_names_its_frame(tmp_path: Path, pose: np.ndarray, message: str) -> None:
    write_seven_scenes(tmp_path)
    (tmp_path / "frame-000003.pose.txt").write_text(rows(pose))
    with pytest.raises(InputError, match=rf"frame-000003\.pose\.txt.*{message}"):
        open_capture(tmp_path)


def test_no_frames(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    with pytest.raises(InputError, match="no frame-"):
        read_seven_scenes(tmp_path)


def test_redkitchen() -> None:
    capture = open_capture(shared_data("redkitchen"))
    assert (capture.kind, len(capture.frames), capture.frames[1].name) == ("7scenes", 200, "frame-000004")
    assert (capture.frames[0].depth_intrinsics.fx, capture.frames[0].intrinsics.fx) == (585, 525)
