"""Phones with a depth sensor: Polycam's, Stray Scanner's, 3D Scanner App's folders, what is believed of depth, and what may be missing."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from fieldfuse.capture import open_capture
from fieldfuse.capture.images import load_depth, load_image
from fieldfuse.capture.select import select_frames
from fieldfuse.config import CaptureSettings
from fieldfuse.errors import InputError
from tests.capture.layouts import PHONE, quarter_size, write_polycam, write_scanner3d, write_stray
from tests.capture.made import eyes, left_out, pixel_error, render

WRITERS = {"polycam": write_polycam, "stray": write_stray, "scanner3d": write_scanner3d}


@pytest.mark.parametrize("layout", WRITERS)
def test_flags_and_depth(tmp_path: Path, layout: str) -> None:
    WRITERS[layout](tmp_path)
    capture = open_capture(tmp_path)
    assert capture.metric and capture.ordered and capture.up == (0, 1, 0) and capture.depth_scale == 1000
    assert capture.filmed == (layout == "stray")
    for frame, eye in zip(capture.frames, eyes(), strict=True):
        assert (frame.depth_intrinsics.width, frame.depth_intrinsics.height) == (40, 30)
        depth, true = load_depth(frame, capture), render(eye, quarter_size(PHONE))[1]
        assert (depth[:, :2] == 0).all()  # where the sensor does not believe itself
        np.testing.assert_allclose(depth[:, 2:], true[:, 2:], atol=6e-4)


def test_corrected_cameras_are_better_than_those_before(tmp_path: Path) -> None:
    write_polycam(tmp_path)
    assert open_capture(tmp_path / "keyframes").kind == "polycam"
    for name in ("corrected_images", "corrected_cameras"):
        (tmp_path / "keyframes" / name).rename(tmp_path / "keyframes" / name.replace("corrected_", "kept_"))
    (tmp_path / "keyframes" / "kept_images").rename(tmp_path / "keyframes" / "images")
    assert pixel_error(open_capture(tmp_path), eyes(), PHONE) > 1


def test_polycam_without_depth_or_camera(tmp_path: Path) -> None:
    write_polycam(tmp_path)
    place = tmp_path / "keyframes"
    (place / "depth" / "100333.png").unlink()
    (place / "corrected_cameras" / "100666.json").unlink()
    capture = open_capture(tmp_path)
    assert [frame.name for frame in capture.frames] == ["100000", "100333", "100999", "101332"]
    assert [frame.depth is None for frame in capture.frames] == [False, True, False, False]
    assert capture.frames[1].confidence is None and "1 of the 5 images" in capture.warnings[0]


@pytest.mark.parametrize(("key", "value"), [("t_12", None), ("fx", "wide"), ("width", 0.2), ("t_00", 7.0)])
def test_a_camera_that_cannot_be(tmp_path: Path, key: str, value: object) -> None:
    write_polycam(tmp_path)
    path = tmp_path / "keyframes" / "corrected_cameras" / "100333.json"
    data = json.loads(path.read_text()) | {key: value}
    path.write_text(json.dumps({name: entry for name, entry in data.items() if entry is not None}))
    left_out(open_capture(tmp_path), r"100333\.json")


def test_recordings_without_a_header(tmp_path: Path) -> None:
    write_stray(tmp_path, header=False)
    capture = open_capture(tmp_path)
    assert pixel_error(capture, eyes(), PHONE) < 1e-3 and all(frame.depth is not None for frame in capture.frames)


def test_depth_is_named_by_the_frame_and_the_video_counts_rows(tmp_path: Path) -> None:
    write_stray(tmp_path)
    for name in ("depth", "confidence"):
        for index in reversed(range(5)):
            (tmp_path / name / f"{index:06d}.png").rename(tmp_path / name / f"{index + 60:06d}.png")
    lines = (tmp_path / "odometry.csv").read_text().splitlines()
    (tmp_path / "odometry.csv").write_text(
        "\n".join([lines[0]] + [line.replace(f"{i:06d}", f"{i + 60:06d}") for i, line in enumerate(lines[1:])])
    )
    capture = open_capture(tmp_path)
    assert [frame.video_index for frame in capture.frames] == [0, 1, 2, 3, 4]
    assert [frame.depth.stem for frame in capture.frames] == [f"{i + 60:06d}" for i in range(5)]


def test_chosen_frames_keep_their_poses_and_depth(tmp_path: Path) -> None:
    write_stray(tmp_path)
    text = (tmp_path / "odometry.csv").read_text().splitlines()
    (tmp_path / "odometry.csv").write_text("\n".join(text[:-1]))  # the last frame of the video has no pose
    capture = open_capture(tmp_path)
    chosen = select_frames(capture, tmp_path / "run", CaptureSettings(max_frames=10))
    assert chosen.posed and chosen.has_depth and not chosen.filmed and chosen.kind == "stray" and 2 <= len(chosen.frames) <= 4
    for frame in chosen.frames:
        before = capture.frames[int(frame.name.removeprefix("frame_"))]
        np.testing.assert_array_equal(frame.world_from_camera, before.world_from_camera)
        assert (frame.depth, frame.confidence, frame.intrinsics) == (before.depth, before.confidence, before.intrinsics)
        assert np.abs(load_image(frame).astype(int) - load_image(before)).mean() < 6


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("odometry.csv", "timestamp, frame, x\n1, 2, 3\n", "9 numbers a row"),
        ("odometry.csv", "", "9 numbers a row"),
        ("odometry.csv", "0,0,0,0,0,0,0\n", "not a rotation"),
        ("odometry.csv", "0,0,0,0,0,0,1\n0,0,nan,0,0,0,1\n", "not finite"),
        ("odometry.csv", "0,0,0,0,0,0,1\n0,0,1\n", "different length"),
        ("odometry.csv", "h\n1,-3,0,0,0,0,0,0,1\n", "number is -3"),
        ("camera_matrix.csv", "1,0\n0,1", "3×3"),
        ("camera_matrix.csv", "a,b,c", "must hold numbers only"),
        ("camera_matrix.csv", "0,0,0\n0,0,0\n0,0,1", "camera_matrix"),
    ],
)
def test_files_that_say_something_else(tmp_path: Path, name: str, text: str, said: str) -> None:
    write_stray(tmp_path)
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=said):
        open_capture(tmp_path)


def test_confidence_of_another_size(tmp_path: Path) -> None:
    write_polycam(tmp_path)
    capture = open_capture(tmp_path)
    image = tmp_path / "keyframes" / "confidence" / "100000.png"
    image.write_bytes((tmp_path / "keyframes" / "corrected_images" / "100000.jpg").read_bytes())
    with pytest.raises(InputError, match=r"confidence .*100000\.png has the shape"):
        load_depth(capture.frames[0], capture)


# ------------------------------------------------------------------------------------------------ 3D Scanner App


def retold(path: Path, **changes: object) -> None:
    path.write_text(json.dumps({key: value for key, value in (json.loads(path.read_text()) | changes).items() if value is not None}))


def test_key_frames_alone_have_pictures_and_some_no_depth(tmp_path: Path) -> None:
    write_scanner3d(tmp_path)
    (tmp_path / "frame_00002.json").unlink()
    (tmp_path / "depth_00004.png").unlink()
    (tmp_path / "conf_00006.png").unlink()
    capture = open_capture(tmp_path)
    assert [frame.name for frame in capture.frames] == ["frame_00000", "frame_00004", "frame_00006", "frame_00008"]
    assert [frame.depth is None for frame in capture.frames] == [False, True, False, False]
    assert [frame.confidence is None for frame in capture.frames] == [False, True, True, False]
    assert capture.warnings == ("1 of the 5 images have no .json beside them and are left out",)


def test_a_pose_that_is_written_column_by_column(tmp_path: Path) -> None:
    write_scanner3d(tmp_path)
    for path in tmp_path.glob("frame_*.json"):
        retold(path, cameraPoseARFrame=np.reshape(json.loads(path.read_text())["cameraPoseARFrame"], (4, 4)).T.ravel().tolist())
    assert pixel_error(open_capture(tmp_path), eyes(), PHONE) < 1e-3


def test_pictures_smaller_than_what_the_intrinsics_are_for(tmp_path: Path) -> None:
    write_scanner3d(tmp_path)
    for path in tmp_path.glob("frame_*.json"):  # of 1920 × 1440
        retold(path, intrinsics=[12 * PHONE.fx, 0, 12 * PHONE.cx, 0, 12 * PHONE.fy, 12 * PHONE.cy, 0, 0, 1])
    assert pixel_error(open_capture(tmp_path), eyes(), PHONE) < 1e-3


@pytest.mark.parametrize(
    "changes",
    [
        {"cameraPoseARFrame": None},
        {"cameraPoseARFrame": [1, 2, 3]},
        {"cameraPoseARFrame": {"a": 1}},
        {"intrinsics": None},
        {"intrinsics": "wide"},
        {"intrinsics": [0] * 9},
        {"intrinsics": [128, 0, 59, 0, 128, 81, 0, 0, 1]},  # of a picture that was turned
    ],
)
def test_frames_of_3d_scanner_app_that_cannot_be(tmp_path: Path, changes: dict) -> None:
    write_scanner3d(tmp_path)
    retold(tmp_path / "frame_00002.json", **changes)
    left_out(open_capture(tmp_path), r"frame_00002\.json")
