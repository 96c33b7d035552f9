"""Folders of pinhole images: read by pycolmap, by nerfstudio's rules, and by this project's own readers; images show what the lens saw."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from fieldfuse.camera import FISHEYE, OPENCV, Array, Intrinsics, distort, pixel_grid
from fieldfuse.capture import open_capture
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.export.sparse import colours_in
from fieldfuse.export.undistorted import file_names, write_undistorted
from tests.export.samples import cameras

POINTS = np.random.default_rng(0).normal(size=(40, 3))
COLOURS = np.random.default_rng(1).integers(0, 256, (40, 3)).astype(np.uint8)
PLAIN = Intrinsics(96, 64, 80.0, 82.0, 47.0, 33.0)
BENT = Intrinsics(96, 64, 80.0, 82.0, 47.0, 33.0, OPENCV, (0.25, 0.05, 2e-3, -1e-3))
ROUND = Intrinsics(96, 64, 70.0, 70.0, 48.0, 32.0, FISHEYE, (0.02, -0.01, 0.0, 0.0))


def places(camera: Intrinsics) -> Array:
    """(H, W, 3) uint8 image whose red and green are where each pixel lies in it."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    return np.stack([2.0 * (u + 0.5), 3.0 * (v + 0.5), np.full(u.shape, 50.0)], axis=-1).round().astype(np.uint8)


@pytest.fixture
def posed(tmp_path: Path) -> Capture:
    """Three lenses; names with folders, spaces and dots; one JPEG; the image of a mask beside one."""
    _, _, poses = cameras(4)
    frames = []
    for index, (name, camera) in enumerate((("a/one.x.png", PLAIN), ("a/two 2.png", BENT), ("b/three.png", ROUND), ("b/four.jpg", PLAIN))):
        path = tmp_path / "in" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), places(camera)[..., ::-1])
        frames.append(Frame(name.rsplit(".", 1)[0], path, camera, poses[index]))
    return Capture("transforms", tmp_path / "in", tuple(frames))


def looked_up(target: Intrinsics, source: Intrinsics) -> tuple[Array, Array]:
    """Where each pixel of the pinhole camera lies in the image of the lens, (H, W, 2), and whether it lies in it."""
    grid = pixel_grid(target.width, target.height)
    ideal = (grid - [target.cx, target.cy]) / [target.fx, target.fy]
    pixel = distort(source, ideal) * [source.fx, source.fy] + [source.cx, source.cy]
    inside = ((pixel >= 0) & (pixel <= [source.width, source.height])).all(axis=1)
    return pixel.reshape(target.height, target.width, 2), inside.reshape(target.height, target.width)


def test_images_masks_and_models_of_every_program(posed: Capture, tmp_path: Path) -> None:
    out = tmp_path / "out"
    files = write_undistorted(out, posed, POINTS, COLOURS, np.array([True, False, False, False]))
    names = ["a_one_x.png", "a_two_2.png", "b_three.png", "b_four.jpg"]
    assert set(files) == {path for path in out.rglob("*") if path.is_file()}
    assert sorted(path.name for path in (out / "images").iterdir()) == sorted(names)
    assert (out / "images" / "b_four.jpg").read_bytes() == posed.frames[3].image.read_bytes()
    # COLMAP and 3DGS: text and binary are the same model.
    (tmp_path / "text").mkdir()
    for path in (out / "sparse" / "0").glob("*.txt"):
        (tmp_path / "text" / path.name).write_bytes(path.read_bytes())
    for model in (pycolmap.Reconstruction(str(out / "sparse" / "0")), pycolmap.Reconstruction(str(tmp_path / "text"))):
        by_name = {image.name: image for image in model.images.values()}
        assert set(by_name) == set(names)
        for frame, name in zip(posed.frames, names, strict=True):
            assert frame.world_from_camera is not None and frame.intrinsics is not None
            assert np.abs(by_name[name].cam_from_world().matrix() - np.linalg.inv(frame.world_from_camera)[:3]).max() < 1e-12
            camera = model.cameras[by_name[name].camera_id]
            assert camera.model.name == "PINHOLE" and (camera.width, camera.height) == (96, 64)
            assert np.array_equal(camera.params, [frame.intrinsics.fx, frame.intrinsics.fy, frame.intrinsics.cx, frame.intrinsics.cy])
        order = sorted(model.points3D)
        assert np.array_equal([model.points3D[i].xyz for i in order], POINTS)
        assert np.array_equal([model.points3D[i].color for i in order], COLOURS)
    # nerfstudio 1.1.5: masks are there for all or none, and a file that names one split has to name all.
    data = json.loads((out / "transforms.json").read_text())
    assert data["camera_model"] == "OPENCV" and data["applied_transform"] == np.eye(4)[:3].tolist()
    assert data["test_filenames"] == data["val_filenames"] == ["images/a_one_x.png"] and len(data["train_filenames"]) == 3
    assert (out / data["ply_file_path"]).is_file()
    for frame, entry in zip(posed.frames, data["frames"], strict=True):
        image, mask = cv2.imread(str(out / entry["file_path"])), cv2.imread(str(out / entry["mask_path"]), cv2.IMREAD_UNCHANGED)
        assert image is not None and mask is not None and set(np.unique(mask)) <= {0, 255}
        assert frame.intrinsics is not None and frame.world_from_camera is not None
        assert np.allclose(np.array(entry["transform_matrix"]) @ np.diag([1, -1, -1, 1]), frame.world_from_camera, atol=1e-15)
        assert [entry[key] for key in ("k1", "k2", "p1", "p2")] == [0, 0, 0, 0]
        wanted, inside = looked_up(frame.intrinsics.pinhole(), frame.intrinsics)
        assert np.abs(image[..., 2] - 2 * wanted[..., 0])[inside].max() < 4
        assert np.abs(image[..., 1] - 3 * wanted[..., 1])[inside].max() < 6
        assert ((mask > 0) == inside).mean() > 0.98
    assert (cv2.imread(str(out / "masks" / "a_two_2.png.png"), cv2.IMREAD_UNCHANGED) == 0).any()
    # Our own readers take it for what it is.
    again = open_capture(out)
    ours = dict(zip(names, posed.frames, strict=True))
    for frame in again.frames:
        assert frame.world_from_camera is not None
        assert np.allclose(frame.world_from_camera, ours[frame.image.name].world_from_camera)
    assert all(frame.mask is not None for frame in again.frames)


def test_alpha_stays_and_nothing_is_masked_where_all_is_seen(tmp_path: Path) -> None:
    image = np.dstack([places(PLAIN)[..., ::-1], np.full((64, 96), 255, np.uint8)])
    image[:, :40, 3], image[:, 40:60, 3] = 0, 128
    cv2.imwrite(str(tmp_path / "a.png"), image)
    posed = Capture("transforms", tmp_path, (Frame("a", tmp_path / "a.png", PLAIN, np.eye(4)),), alpha=True)
    write_undistorted(tmp_path / "out", posed, POINTS, COLOURS)
    read = cv2.imread(str(tmp_path / "out" / "images" / "a.png"), cv2.IMREAD_UNCHANGED)
    assert read is not None and np.array_equal(read[..., 3], image[..., 3])
    assert np.abs(read[:, 40:, :3].astype(int) - image[:, 40:, :3]).max() <= 1
    assert not (tmp_path / "out" / "masks").exists()
    assert "train_filenames" not in json.loads((tmp_path / "out" / "transforms.json").read_text())


def test_half_a_folder_is_not_left(posed: Capture, tmp_path: Path) -> None:
    posed.frames[2].image.unlink()
    with pytest.raises(Exception, match="three"):
        write_undistorted(tmp_path / "out", posed, POINTS, COLOURS)
    assert not (tmp_path / "out").exists()


def test_names_stay_apart() -> None:
    frames = tuple(Frame(name, Path(f"{name}.jpg")) for name in ("a b", "a/b", "A_B", "é", "..."))
    assert file_names(Capture("photos", Path(), frames)) == ["a_b.jpg", "a_b_1.jpg", "A_B_2.jpg", "é.jpg", "image.jpg"]


def test_points_have_the_colours_of_the_images_that_are_nearest() -> None:
    from fieldfuse.capture.types import Views

    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 2, 3] = [0.0, -1.0, -2.0]
    images = [np.full((64, 96, 3), shade, np.uint8) for shade in (10, 20, 200)]
    views = Views(["a", "b", "c"], images, [PLAIN] * 3, poses, np.zeros(3, bool))
    found = colours_in(np.array([[0.0, 0, 2], [0, 0, -1.5], [0, 0, -9]]), views)
    assert found.tolist() == [[20] * 3, [200] * 3, [128] * 3]
