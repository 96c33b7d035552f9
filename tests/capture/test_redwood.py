"""Redwood/Open3D: both forms of the camera file, the log's index, and numbers that do not match."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from fieldfuse.capture import open_capture
from fieldfuse.capture.detect import detect_kind
from fieldfuse.errors import InputError
from tests.capture.layouts import OFF_CENTRE, rows, write_redwood, write_scannet
from tests.capture.made import Pinhole, eyes, pixel_error, render, save_depth, save_picture
from tests.conftest import shared_data


def test_flags(tmp_path: Path) -> None:
    write_redwood(tmp_path)
    capture = open_capture(tmp_path)
    assert capture.metric
    assert capture.ordered
    assert capture.depth_scale == 1000
    assert all(frame.depth is not None and frame.depth_intrinsics is None for frame in capture.frames)


def test_the_plain_form_and_its_depth_scale(tmp_path: Path) -> None:
    write_redwood(tmp_path)
    c = OFF_CENTRE
    plain = {"width": 80, "height": 60, "fx": c.fx, "fy": c.fy, "cx": c.cx - 0.5, "cy": c.cy - 0.5, "depth_scale": 5000.0}
    (tmp_path / "camera_intrinsics.json").rename(tmp_path / "camera.json")
    (tmp_path / "camera.json").write_text(json.dumps(plain))
    capture = open_capture(tmp_path)
    assert capture.depth_scale == 5000
    assert pixel_error(capture, eyes(), c) < 1e-3


def test_without_a_camera_file_the_sensor_default_is_named(tmp_path: Path) -> None:
    write_redwood(tmp_path)
    (tmp_path / "camera_intrinsics.json").unlink()
    capture = open_capture(tmp_path)
    camera = capture.frames[0].intrinsics
    assert (camera.fx, camera.cx, camera.cy) == pytest.approx((525 / 8, 40, 30))
    assert "PrimeSense" in capture.warnings[0]


def test_the_index_of_the_log_counts_not_its_order(tmp_path: Path) -> None:
    write_redwood(tmp_path)
    entries = [f"{i} {i} {i + 1}\n{rows(eye.pose())}" for i, eye in enumerate(eyes())]
    (tmp_path / "trajectory.log").write_text("".join(reversed(entries)))
    assert pixel_error(open_capture(tmp_path), eyes(), OFF_CENTRE) < 1e-3
    from_one = [f"{i + 1} {i + 1} {i + 2}\n{rows(eye.pose())}" for i, eye in enumerate(eyes())]
    (tmp_path / "trajectory.log").write_text("".join(from_one))
    assert pixel_error(open_capture(tmp_path), eyes(), OFF_CENTRE) < 1e-3


PUBLISHED = {  # the log, the pictures' folder, the depth's, the camera's file
    "Open3D's sample": ("trajectory.log", "color", "depth", "camera_primesense.json"),
    "Open3D's living room": ("livingroom1-traj.txt", "color", "depth", None),
    "Redwood's site": ("office2-traj.txt", "office2-color", "office2-depth-clean", None),
    "Redwood's site, noisy": ("office2-traj.txt", "office2-color", "office2-depth-simulated", None),
    "lounge": ("lounge_trajectory.log", "color", "depth", None),
    "bedroom": ("bedroom.log", "image", "depth", None),
    "Open3D's reconstruction system": ("scene/trajectory.log", "color", "depth", "intrinsic.json"),
    "fountain": ("scene/key.log", "image", "depth", None),
}


@pytest.mark.parametrize("name", PUBLISHED)
def test_what_is_published_is_read_as_it_is_unpacked(tmp_path: Path, name: str) -> None:
    log, pictures, depth, camera = PUBLISHED[name]
    write_redwood(tmp_path)
    (tmp_path / "scene").mkdir()
    (tmp_path / "trajectory.log").rename(tmp_path / log)
    (tmp_path / "color").rename(tmp_path / pictures)
    (tmp_path / "depth").rename(tmp_path / depth)
    (tmp_path / "camera_intrinsics.json").rename(tmp_path / (camera or "elsewhere.txt"))
    step = f"0 1 5\n{rows(np.eye(4))}"
    (tmp_path / "odometry.log").write_text(step * 4)
    (tmp_path / "rgbd.match").write_text("5 0 1\n")
    (tmp_path / "dist-model.txt").write_text("1 2 3\n")
    (tmp_path / "run.log").write_text("10:02 started\n")
    (tmp_path / "pairs.log").write_text(step * 4)
    capture = open_capture(tmp_path)
    assert (capture.kind, capture.has_depth, bool(capture.warnings)) == ("redwood", True, camera is None)
    if camera:
        assert pixel_error(capture, eyes(), OFF_CENTRE) < 1e-3
    for frame, eye in zip(capture.frames, eyes(), strict=True):
        np.testing.assert_allclose(frame.world_from_camera, eye.pose(), atol=1e-9)
        assert frame.depth.parent.name == depth and frame.depth.stem == frame.image.stem


def test_one_trajectory_is_meant_and_one_depth(tmp_path: Path) -> None:
    write_redwood(tmp_path)
    (tmp_path / "trajectory.log").rename(tmp_path / "livingroom1-traj.txt")
    (tmp_path / "depth_noisy").mkdir()
    for path in (tmp_path / "depth").iterdir():
        (tmp_path / "depth_noisy" / path.name).write_bytes(path.read_bytes())
    assert open_capture(tmp_path).warnings == ("the depth in depth/ is used, that in depth_noisy/ is left out",)
    text = (tmp_path / "livingroom1-traj.txt").read_text()
    (tmp_path / "livingroom2-traj.txt").write_text(text)
    with pytest.raises(InputError, match=r"holds livingroom1-traj\.txt, livingroom2-traj\.txt; call the one .* trajectory\.log"):
        open_capture(tmp_path)


def test_what_open3d_left_beside_a_scan_does_not_replace_its_poses(tmp_path: Path) -> None:
    write_redwood(tmp_path / "redwood")
    write_scannet(tmp_path / "scan")
    (tmp_path / "scan" / "scene").mkdir()
    (tmp_path / "redwood" / "trajectory.log").rename(tmp_path / "scan" / "scene" / "trajectory.log")
    assert detect_kind(tmp_path / "scan") == "scannet"


def test_other_logs_make_no_trajectory(tmp_path: Path) -> None:
    write_redwood(tmp_path)
    (tmp_path / "trajectory.log").rename(tmp_path / "odometry.log")
    (tmp_path / "pairs.log").write_text(f"0 1 5\n{rows(np.eye(4))}")
    (tmp_path / "wrong.log").write_bytes(b"\xff\xfe0 0 1\n")
    (tmp_path / "digits.log").write_text("0 0 1\n" + "1" * 100_000)
    assert detect_kind(tmp_path) != "redwood"


def test_depth_at_another_size_has_a_scaled_camera(tmp_path: Path) -> None:
    write_redwood(tmp_path)
    for index, eye in enumerate(eyes()):
        save_depth(tmp_path / f"depth/{index:05d}.png", render(eye, Pinhole(40, 30, 35.5, 36.5, 21.125, 13.75))[1])
    camera = open_capture(tmp_path).frames[0].depth_intrinsics
    assert (camera.width, camera.fx, camera.cx) == (40, 35.5, 21.125)


def test_numbers_that_do_not_match(tmp_path: Path) -> None:
    write_redwood(tmp_path)
    (tmp_path / "depth/00004.png").unlink()
    with pytest.raises(InputError, match="5 images but 4 depth images"):
        open_capture(tmp_path)
    save_picture(tmp_path / "color/00009.jpg", render(eyes()[0], OFF_CENTRE)[0])
    with pytest.raises(InputError, match="6 images but 5 poses"):
        open_capture(tmp_path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "whole entries"),
        ("0 0 1\n1 0 0", "whole entries"),
        ("0 0 1\nx", "numbers only"),
        ("".join(f"{i} {i} {i}\n{rows(np.diag([1.0, 1, 0, 1]))}" for i in range(5)), r"trajectory\.log, entry 0.*singular"),
    ],
)
def test_broken_logs(tmp_path: Path, text: str, message: str) -> None:
    write_redwood(tmp_path)
    (tmp_path / "trajectory.log").write_text(text)
    with pytest.raises(InputError, match=message):
        open_capture(tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"intrinsic_matrix": [1, 2, 3]}, "nine numbers"),
        ({"intrinsic_matrix": [-70.0, 0, 0, 0, 70, 0, 40, 30, 1]}, "must be positive"),
        ({"intrinsic_matrix": None}, "must hold 'fx'"),
        ({"intrinsic_matrix": None, "fx": "a"}, "'fx' must be a finite number"),
        ({"width": None}, "is not usable"),
        ({"width": 10**400}, "'width' must be a finite number"),
        ({"depth_scale": -1}, "'depth_scale'"),
    ],
)
def test_broken_cameras(tmp_path: Path, change: dict, message: str) -> None:
    write_redwood(tmp_path)
    path = tmp_path / "camera_intrinsics.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    with pytest.raises(InputError, match=message):
        open_capture(tmp_path)


def test_living_room() -> None:
    capture = open_capture(shared_data("redwood_livingroom1"))
    assert (capture.kind, len(capture.frames), capture.depth_scale) == ("redwood", 105, 1000)
    assert (capture.frames[0].intrinsics.cx, capture.frames[0].intrinsics.cy) == (320, 240)


def test_a_principal_point_outside_the_picture(tmp_path: Path) -> None:
    write_redwood(tmp_path)
    camera = {"width": 80, "height": 60, "fx": 71, "fy": 73, "cx": 169, "cy": 110}
    (tmp_path / "camera_intrinsics.json").write_text(json.dumps(camera))
    with pytest.raises(InputError, match=r"camera_intrinsics\.json.*outside the 80×60 picture"):
        open_capture(tmp_path)
