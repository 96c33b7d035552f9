"""Cameras read back by pycolmap, by plain json arithmetic, and by this project's own reader."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from fieldfuse.camera import Intrinsics, project
from fieldfuse.capture import open_capture
from fieldfuse.errors import InputError
from fieldfuse.export.cameras import colmap_model, quaternion, write_cameras
from fieldfuse.export.sparse import stored_points
from tests.export.samples import cameras

POINTS = np.random.default_rng(2).normal(size=(30, 3))


def test_colmap_projects_where_we_do(tmp_path: Path) -> None:
    names, intrinsics, poses = cameras()
    colours = np.random.default_rng(3).integers(0, 256, POINTS.shape).astype(np.uint8)
    write_cameras(tmp_path, names, intrinsics, poses, POINTS, colours)
    model = pycolmap.Reconstruction(str(tmp_path / "colmap"))
    assert len(model.images) == 7
    assert len(model.cameras) == 4
    by_name = {image.name: image for image in model.images.values()}
    assert set(by_name) == {name.replace(" ", "_") for name in names}
    for name, camera, pose in zip(names, intrinsics, poses, strict=True):
        image = by_name[name.replace(" ", "_")]
        matrix = np.asarray(image.cam_from_world().matrix())
        assert np.abs(matrix - np.linalg.inv(pose)[:3]).max() < 1e-9
        pixels, depth = project(camera, pose, POINTS)
        local = POINTS @ matrix[:, :3].T + matrix[:, 3]
        # Near the axis: outside the field of view a polynomial lens may fold, and both libraries may differ there.
        near = (depth > 0.5) & (np.hypot(local[:, 0], local[:, 1]) < 0.5 * local[:, 2])
        assert near.any()
        theirs = np.array([model.cameras[image.camera_id].img_from_cam(point) for point in local[near]])
        assert np.abs(theirs - pixels[near]).max() < 1e-6
    stored = np.array([model.points3D[i].xyz for i in sorted(model.points3D)])
    assert np.array_equal(stored, POINTS)
    assert np.array_equal([model.points3D[i].color for i in sorted(model.points3D)], colours)


def test_poses_have_opengl_axes_in_the_json(tmp_path: Path) -> None:
    names, intrinsics, poses = cameras()
    write_cameras(tmp_path, names, intrinsics, poses, POINTS)
    data = json.loads((tmp_path / "transforms.json").read_text())
    for frame, pose in zip(data["frames"], poses, strict=True):
        matrix = np.array(frame["transform_matrix"])
        assert np.allclose(matrix[:3, 3], pose[:3, 3])
        assert np.allclose(matrix[:3, 0], pose[:3, 0])  # right
        assert np.allclose(matrix[:3, 1], -pose[:3, 1])  # up
        assert np.allclose(matrix[:3, 2], -pose[:3, 2])  # back


def test_transforms_share_intrinsics_where_they_can(tmp_path: Path) -> None:
    names, intrinsics, poses = cameras()
    write_cameras(tmp_path, names, [intrinsics[1]] * 7, poses)
    data = json.loads((tmp_path / "transforms.json").read_text())
    assert {key: data[key] for key in ("w", "h", "fl_x", "fl_y", "cx", "cy", "k1", "p2")} == {
        "w": 640,
        "h": 480,
        "fl_x": 500.5,
        "fl_y": 510.25,
        "cx": 321.75,
        "cy": 238.5,
        "k1": -0.1,
        "p2": -2e-3,
    }
    assert data["camera_angle_x"] == pytest.approx(2 * np.arctan(320 / 500.5))
    assert data["camera_model"] == "OPENCV"
    assert data["frames"][3]["file_path"] == names[3]
    assert set(data["frames"][0]) == {"file_path", "transform_matrix"}
    write_cameras(tmp_path, names, intrinsics, poses)
    data = json.loads((tmp_path / "transforms.json").read_text())
    assert "fl_x" not in data
    assert [frame["w"] for frame in data["frames"]] == [640, 640, 800, 320, 640, 640, 800]
    write_cameras(tmp_path, names, [intrinsics[3]] * 7, poses)
    assert json.loads((tmp_path / "transforms.json").read_text())["camera_model"] == "OPENCV_FISHEYE"


def test_a_lens_that_nerfstudio_does_not_know_is_not_called_opencv(tmp_path: Path) -> None:
    """nerfstudio 1.1.5 takes one model for a file and knows OPENCV with k1, k2, p1, p2 and k3; its k4 is a term of the eighth power."""
    names, intrinsics, poses = cameras()
    six = replace(intrinsics[1], distortion=(-0.1, 0.02, 1e-3, -2e-3, 0.004))
    for lenses, model, others in (
        ([intrinsics[2]] * 7, "FULL_OPENCV", {None}),
        ([six] * 7, "OPENCV", {None}),
        (intrinsics, "FULL_OPENCV", {None, "OPENCV", "OPENCV_FISHEYE"}),
        ([intrinsics[i % 2] for i in range(7)], "OPENCV", {None}),
    ):
        write_cameras(tmp_path, names, lenses, poses)
        data = json.loads((tmp_path / "transforms.json").read_text())
        assert data["camera_model"] == model and {frame.get("camera_model") for frame in data["frames"]} == others
        assert lenses[0] is not six or data["k3"] == 0.004


def test_images_keep_their_names_of_the_model(tmp_path: Path) -> None:
    write_cameras(tmp_path, ["images/a.png"], [Intrinsics(8, 6, 7.0, 7.0, 4.0, 3.0)], np.eye(4)[None], names=["a.png"])
    model = pycolmap.Reconstruction(str(tmp_path / "colmap"))
    assert [image.name for image in model.images.values()] == ["a.png"]
    assert json.loads((tmp_path / "transforms.json").read_text())["frames"][0]["file_path"] == "images/a.png"


@pytest.mark.parametrize("kind", ["shared", "mixed"])
def test_our_own_reader_takes_what_we_write(tmp_path: Path, kind: str) -> None:
    names, intrinsics, poses = cameras()
    chosen = [intrinsics[1]] * 7 if kind == "shared" else [intrinsics[i % 2] for i in range(7)]
    for name in names:
        cv2.imwrite(str(tmp_path / name), np.zeros((480, 640, 3), np.uint8))
    write_cameras(tmp_path, names, chosen, poses)
    (tmp_path / "colmap").rename(tmp_path.parent / f"{tmp_path.name}-colmap")
    capture = open_capture(tmp_path)
    assert capture.kind == "transforms"
    for frame, camera, pose in zip(capture.frames, chosen, poses, strict=True):
        assert frame.world_from_camera is not None
        assert np.allclose(frame.world_from_camera, pose, atol=1e-9)
        assert frame.intrinsics is not None
        theirs, ours = (project(lens, pose, POINTS)[0] for lens in (frame.intrinsics, camera))
        assert np.allclose(theirs, ours, atol=1e-6, equal_nan=True)


def test_each_lens_gets_the_smallest_model_that_holds_it() -> None:
    _, intrinsics, _ = cameras(4)
    assert [colmap_model(camera)[0] for camera in intrinsics] == ["PINHOLE", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE"]
    assert colmap_model(Intrinsics(9, 9, 5, 5, 4, 4, "opencv", (0.0, 0.0)))[0] == "PINHOLE"
    assert colmap_model(Intrinsics(9, 9, 5, 5, 4, 4, "opencv", (0.1,)))[1] == [5, 5, 4, 4, 0.1, 0, 0, 0]


@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1))
def test_quaternions_of_any_rotation(numbers: list[float]) -> None:
    wanted = np.array(numbers) / np.linalg.norm(numbers)
    rotation = pycolmap.Rotation3d(wanted[[1, 2, 3, 0]]).matrix()
    found = quaternion(rotation)
    assert found[0] >= 0
    assert abs(abs(found @ wanted) - 1) < 1e-9


def test_lists_of_different_length_are_refused(tmp_path: Path) -> None:
    names, intrinsics, poses = cameras()
    with pytest.raises(InputError, match="7 names, 6 intrinsics and 7 poses"):
        write_cameras(tmp_path, names, intrinsics[:6], poses)
    assert not list(tmp_path.iterdir())


def test_points_go_with_the_cameras_as_other_programs_look_for_them(tmp_path: Path) -> None:
    colours = np.arange(3 * len(POINTS), dtype=np.uint8).reshape(-1, 3)
    write_cameras(tmp_path, ["a.png"], [Intrinsics(8, 6, 7.0, 7.0, 4.0, 3.0)], np.eye(4)[None], POINTS, colours)
    data = json.loads((tmp_path / "transforms.json").read_text())
    cloud = trimesh.load(tmp_path / data["ply_file_path"], process=False)
    np.testing.assert_allclose(cloud.vertices, POINTS, atol=1e-5)
    assert np.array_equal(np.asarray(cloud.colors)[:, :3], colours)
    stored = stored_points(tmp_path / data["ply_file_path"])
    assert stored is not None and len(stored[0]) == len(POINTS) and np.array_equal(stored[1], colours)
    write_cameras(tmp_path, ["a.png"], [Intrinsics(8, 6, 7.0, 7.0, 4.0, 3.0)], np.eye(4)[None])
    assert "ply_file_path" not in json.loads((tmp_path / "transforms.json").read_text())
    assert not (tmp_path / "points3D.ply").exists() and stored_points(tmp_path / "points3D.ply") is None
