"""RGB-D in folders of no published layout: what belongs together, the camera's file in all its forms, and the unit of depth."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from fieldfuse.camera import Array
from fieldfuse.capture import open_capture
from fieldfuse.capture.checks import check_capture
from fieldfuse.capture.images import load_depth
from fieldfuse.errors import InputError
from tests.capture.layouts import OFF_CENTRE, quaternion, rows
from tests.capture.made import eyes, render, save_picture
from tests.conftest import shared_data

K = OFF_CENTRE
FX, FY, CX, CY = K.fx, K.fy, K.cx - 0.5, K.cy - 0.5  # as files have it: pixel centres at whole numbers
ORB = f"%YAML:1.0\n# Camera\nCamera.fx: {FX}\nCamera.fy: {FY}\nCamera.cx: {CX}\nCamera.cy: {CY}\nCamera.k1: 0.0\n\nDepthMapFactor: 5000.0\n"
MATRIX = rows(np.array([[FX, 0, CX], [0, FY, CY], [0, 0, 1]]))
OPENCV_YAML = (
    "%YAML:1.0\n---\nimage_width: 80\nimage_height: 60\ncamera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n"
    f"   data: [ {FX}, 0., {CX}, 0.,\n       {FY}, {CY}, 0., 0., 1. ]\n"
)


def poses() -> list[Array]:
    return [eye.pose() for eye in eyes()]


def tum_row(pose: Array, *before: object) -> str:
    w, x, y, z = quaternion(pose[:3, :3])
    return " ".join(str(value) for value in (*before, *pose[:3, 3], x, y, z, w)) + "\n"


def write(
    root: Path,
    scale: float = 5000.0,
    colour: str = "raw_imgs/{:04d}_rgb_raw.png",
    depth: str = "depth_imgs/{:04d}_depth_raw.png",
    step: int = 1,
) -> None:
    for index, eye in enumerate(eyes()):
        picture, values = render(eye, K)
        save_picture(root / colour.format(index * step), picture)
        path = root / depth.format(index * step)
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".npy":
            np.save(path, values.astype(np.float32))
        else:
            cv2.imwrite(str(path), np.round(values * scale).astype(np.uint16))


def agrees(root: Path, scale: float) -> None:
    capture = check_capture(open_capture(root))
    assert capture.kind == "rgbd" and capture.posed and capture.depth_scale == pytest.approx(scale)
    for frame, eye, pose in zip(capture.frames, eyes(), poses(), strict=True):
        np.testing.assert_allclose(frame.world_from_camera, pose, atol=1e-6)
        camera = frame.intrinsics
        assert camera is not None and (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx((K.fx, K.fy, K.cx, K.cy))
        np.testing.assert_allclose(load_depth(frame, capture), render(eye, K)[1], atol=2e-3)


POSES = {
    "tum": ("truth_cam_poses.txt", lambda: "".join(tum_row(pose, 1341841278.8 + index) for index, pose in enumerate(poses()))),
    "no time": ("poses.txt", lambda: "".join(tum_row(pose) for pose in poses())),
    "names": ("poses.txt", lambda: "".join(reversed([tum_row(pose, f"{index:04d}_rgb_raw.png") for index, pose in enumerate(poses())]))),
    "numbers": ("poses.txt", lambda: "# comment\n" + "".join(reversed([tum_row(pose, index) for index, pose in enumerate(poses())]))),
    "4×4 rows": ("traj.txt", lambda: "".join(" ".join(map(str, pose.ravel())) + "\n" for pose in poses())),
    "columns": ("traj.txt", lambda: "".join(",".join(map(str, pose.T.ravel())) + "\n" for pose in poses())),
    "3×4 rows": ("groundtruth.txt", lambda: "".join(" ".join(map(str, pose[:3].ravel())) + "\n" for pose in poses())),
    "blocks": ("cam_poses.txt", lambda: "\n".join(rows(pose) for pose in poses())),
}


@pytest.mark.parametrize("how", POSES)
def test_poses_in_all_forms(tmp_path: Path, how: str) -> None:
    name, text = POSES[how]
    write(tmp_path)
    (tmp_path / name).write_text(text())
    (tmp_path / "TUM3.yaml").write_text(ORB)
    agrees(tmp_path, 5000)


def test_poses_one_a_file_and_images_of_every_tenth_frame(tmp_path: Path) -> None:
    write(tmp_path / "a", colour="color/{}.png", depth="depth/{}.png")
    for index, pose in enumerate(poses()):
        (tmp_path / "a/cam").mkdir(exist_ok=True)
        (tmp_path / f"a/cam/{index}.txt").write_text(rows(pose))
    (tmp_path / "a/camera.yaml").write_text(ORB)
    agrees(tmp_path / "a", 5000)
    write(tmp_path / "b", colour="color/{}.png", depth="depth/{}.png", step=10)
    longer = [poses()[min((index + 5) // 10, 4)] for index in range(45)]
    (tmp_path / "b/poses.txt").write_text("".join(tum_row(pose) for pose in longer))
    (tmp_path / "b/camera.yaml").write_text(ORB)
    agrees(tmp_path / "b", 5000)


CAMERAS = {
    "orb": ("TUM3.yaml", ORB.replace("DepthMapFactor", "Nothing")),
    "opencv": ("calib.yml", OPENCV_YAML),
    "3×3": ("intrinsics.txt", MATRIX),
    "4×4": ("intrinsic_color.txt", rows(np.array([[FX, 0, CX, 0], [0, FY, CY, 0], [0, 0, 1, 0], [0, 0, 0, 1]]))),
    "four": ("K.txt", f"{FX} {FY} {CX} {CY}"),
    "json": ("camera_info.json", json.dumps({"camera": {"fx": FX, "fy": FY, "cx": CX, "cy": CY, "w": 80, "h": 60}})),
    "open3d": ("intrinsic.json", json.dumps({"width": 80, "height": 60, "intrinsic_matrix": [FX, 0, 0, 0, FY, 0, CX, CY, 1]})),
    "K in json": ("calibration.json", json.dumps({"K": [[FX, 0, CX], [0, FY, CY], [0, 0, 1]]}, indent=1)),
}


@pytest.mark.parametrize("how", CAMERAS)
def test_cameras_in_all_forms_and_the_unit_that_fits_the_poses(tmp_path: Path, how: str) -> None:
    write(tmp_path, 1000.0, "rgb/{:03d}.png", "depth/{:03d}.png")
    (tmp_path / "poses.txt").write_text(POSES["no time"][1]())
    name, text = CAMERAS[how]
    (tmp_path / name).write_text(text)
    agrees(tmp_path, 1000)


def test_the_unit_of_depth_is_found_by_the_poses(tmp_path: Path) -> None:
    write(tmp_path / "five", 5000.0)
    write(tmp_path / "floats", depth="depth/{}.npy", colour="rgb/{}.png")
    for root, scale in ((tmp_path / "five", 5000), (tmp_path / "floats", 1)):
        (root / "poses.txt").write_text(POSES["no time"][1]())
        (root / "intrinsics.txt").write_text(MATRIX)
        agrees(root, scale)
    assert any("5000 for each unit of the poses is taken, which fits the poses" in one for one in open_capture(tmp_path / "five").warnings)


def test_folders_as_deep_video_mvs_has_them(tmp_path: Path) -> None:
    write(tmp_path, 1000.0, "images/{:05d}.png", "depth/{:05d}.png")
    np.savetxt(tmp_path / "poses.txt", np.array(poses()).reshape(5, 16))
    np.savetxt(tmp_path / "K.txt", np.array([[FX, 0, CX], [0, FY, CY], [0, 0, 1]]))
    agrees(tmp_path, 1000)


@pytest.mark.parametrize(("camera", "scale"), [({"width": 80, "height": 60, "depth_scale": 5000}, 5000), ({}, 1000)])
def test_without_poses_they_are_to_be_found(tmp_path: Path, camera: dict[str, float], scale: float) -> None:
    """Folders as cameras of Intel and Microsoft are recorded into."""
    write(tmp_path, scale, "rgb/{:05d}.png", "depth/{:05d}.png")
    (tmp_path / "camera_intrinsics.json").write_text(json.dumps({**camera, "fx": FX, "fy": FY, "cx": CX, "cy": CY}))
    capture = open_capture(tmp_path)
    assert capture.kind == "rgbd" and not capture.posed and capture.metric and capture.has_depth
    assert "there is no list of poses, and they are found from the images" in capture.warnings[0]
    np.testing.assert_allclose(load_depth(capture.frames[0], capture), render(eyes()[0], K)[1], atol=2e-3)


def test_without_a_camera_it_is_asked_for_by_name(tmp_path: Path) -> None:
    write(tmp_path, 1000.0, "rgb/{:05d}.png", "depth/{:05d}.png")
    capture = open_capture(tmp_path)
    assert capture.kind == "photos"
    wanted = 'write them to intrinsics.json ({"width": 80, "height": 60, "fx": …'
    assert any(wanted in one and "depth maps in depth/ are not used" in one for one in capture.warnings)
    for file in (tmp_path / "depth").iterdir():
        cv2.imwrite(str(file), np.full((60, 80), 99, np.uint8))
    assert not any("are not used" in one for one in open_capture(tmp_path).warnings), "pictures of depth are none"


def test_what_does_not_belong_together_is_said_in_one_sentence(tmp_path: Path) -> None:
    write(tmp_path)
    (tmp_path / "poses.txt").write_text(POSES["no time"][1]())
    with pytest.raises(InputError, match=r"no camera; add intrinsics\.txt"):
        open_capture(tmp_path)
    (tmp_path / "TUM3.yaml").write_text(ORB.replace("5000", "-1"))
    with pytest.raises(InputError, match="depth factor is -1"):
        open_capture(tmp_path)
    (tmp_path / "TUM3.yaml").write_text(ORB)
    (tmp_path / "poses.txt").write_text("".join(tum_row(pose) for pose in poses()[:3]))
    with pytest.raises(InputError, match=r"5 images but poses.txt 3 poses"):
        open_capture(tmp_path)


def test_a_pose_that_is_no_number_costs_its_frame_alone(tmp_path: Path) -> None:
    write(tmp_path)
    (tmp_path / "TUM3.yaml").write_text(ORB)
    lines = POSES["tum"][1]().splitlines(keepends=True)
    (tmp_path / "poses.txt").write_text("".join([lines[0], "1341841279.8 nan nan nan nan nan nan nan\n", *lines[2:]]))
    capture = open_capture(tmp_path)
    assert len(capture.frames) == 4
    assert "1 of 5 images have no (finite) pose and are not used" in capture.warnings


@pytest.mark.parametrize("text", ["a:" + "\n" * 200_000, "a" * 250_000, "k:[" * 60_000, "] " * 100_000, "\n rows:" * 30_000])
def test_hostile_camera_files_take_no_time(tmp_path: Path, text: str) -> None:
    write(tmp_path)
    (tmp_path / "poses.txt").write_text(POSES["no time"][1]())
    (tmp_path / "camera.yaml").write_text(text)
    with pytest.raises(InputError, match="no camera"):
        open_capture(tmp_path)


def test_a_real_folder() -> None:
    capture = open_capture(shared_data("zoo/fr3-cabinet"))
    assert capture.kind == "rgbd" and len(capture.frames) == 58 and capture.depth_scale == 5000
    assert check_capture(capture).has_depth
