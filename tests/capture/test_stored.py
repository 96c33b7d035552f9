"""Cameras exported beside photos that EXIF turns: opened there again, they see the same points at the same places of the stored pixels."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from fieldfuse.camera import FISHEYE, OPENCV, PINHOLE, Array, Intrinsics, invert, pixel_grid, project
from fieldfuse.capture import Capture, open_capture
from fieldfuse.capture.convert import CONVERTED, convert_images, to_convert
from fieldfuse.capture.headers import orientation_of
from fieldfuse.capture.images import load_image, upright
from fieldfuse.pipelines.exports import put_cameras
from fieldfuse.poses.result import SFM, PoseResult
from tests.capture.board import texture

WIDTH, HEIGHT = 64, 48  # of the files
LENSES = {
    PINHOLE: (),
    OPENCV: (0.08, -0.03, 4e-3, -7e-3, 0.01),
    FISHEYE: (0.05, -0.02, 0.01, -0.004),
}


def photo(path: Path, orientation: int, seed: int = 0) -> Path:
    """A file of `WIDTH` × `HEIGHT` whose EXIF says how to turn it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(texture(HEIGHT, WIDTH, seed=seed)).save(path, exif=exif.tobytes(), **({} if path.suffix == ".png" else {"quality": 95}))
    return path


def camera_for(orientation: int, lens: str = PINHOLE) -> Intrinsics:
    """Of the upright image, with nothing in its middle and no two numbers alike."""
    width, height = (HEIGHT, WIDTH) if orientation >= 5 else (WIDTH, HEIGHT)
    return Intrinsics(width, height, 61.0, 67.0, width / 2 + 3.5, height / 2 - 5.25, lens, LENSES[lens])


def poses(count: int) -> Array:
    rng = np.random.default_rng(0)
    out = np.tile(np.eye(4), (count, 1, 1))
    for pose in out:
        pose[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        pose[:3, :3] *= np.linalg.det(pose[:3, :3])
        pose[:3, 3] = rng.normal(size=3)
    return out


def found(capture: Capture, cameras: list[Intrinsics]) -> Capture:
    count = len(capture.frames)
    names = [frame.name for frame in capture.frames]
    return PoseResult(SFM, count, count, names, cameras, poses(count), [count], [], np.zeros((1, 3))).apply(capture)


def stored_places(orientation: int, places: Array) -> Array:
    """(N, 2) pixels of the upright image → where the file has them, by turning an image of the pixels' own places."""
    grid = upright(pixel_grid(WIDTH, HEIGHT).reshape(HEIGHT, WIDTH, 2), orientation)
    shown = pixel_grid(grid.shape[1], grid.shape[0])
    way = np.linalg.lstsq(np.hstack([shown, np.ones((len(shown), 1))]), grid.reshape(-1, 2), rcond=None)[0]
    return np.asarray(np.hstack([places, np.ones((len(places), 1))]) @ way)


def before_camera(pose: Array) -> Array:
    points = np.random.default_rng(1).uniform([-0.3, -0.3, 1], [0.3, 0.3, 2], (40, 3))
    return np.asarray(points @ pose[:3, :3].T + pose[:3, 3])


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("model", ["transforms", "colmap"])
def test_cameras_beside_turned_photos_fit_the_files(tmp_path: Path, lens: str, model: str) -> None:
    orientations = [1, 3, 6, 8]
    place = tmp_path / "photos"
    for number in orientations:
        photo(place / "images" / f"{number}.jpg", number, seed=number)
    capture = open_capture(place)
    assert capture.kind == "photos" and not to_convert(capture)
    posed = found(capture, [camera_for(number, lens) for number in orientations])
    put_cameras(tmp_path / "cameras", posed)
    if model == "transforms":
        shutil.copy(tmp_path / "cameras" / "transforms.json", place)
    else:
        shutil.copytree(tmp_path / "cameras" / "colmap", place / "sparse" / "0")
        text = place / "sparse" / "0" / "images.txt"
        text.write_text(text.read_text().replace("images/", ""))  # COLMAP's names are from that folder
    again = open_capture(place)
    assert again.kind == model and len(again.frames) == 4
    for number, before, after in zip(orientations, posed.frames, again.frames, strict=True):
        assert load_image(after).shape == (HEIGHT, WIDTH, 3)
        assert (after.intrinsics.width, after.intrinsics.height) == (WIDTH, HEIGHT)
        points = before_camera(before.world_from_camera)
        places, depth = project(before.intrinsics, before.world_from_camera, points)
        stored, stored_depth = project(after.intrinsics, after.world_from_camera, points)
        np.testing.assert_allclose(stored, stored_places(number, places), atol=1e-6)
        np.testing.assert_allclose(stored_depth, depth, atol=1e-9)


def test_mirrored_photos_are_written_upright_into_the_run(tmp_path: Path) -> None:
    orientations = [2, 4, 5, 7]
    for number in orientations:
        photo(tmp_path / "photos" / f"{number}.png", number, seed=number)
    capture = open_capture(tmp_path / "photos")
    assert to_convert(capture) == [0, 1, 2, 3]
    turned = convert_images(capture, tmp_path / "run", 1)
    assert turned.extra[CONVERTED] == 4
    for before, after in zip(capture.frames, turned.frames, strict=True):
        assert after.image.parent == tmp_path / "run" / "frames"
        seen, true = load_image(after, exif=True), load_image(before, exif=True)
        assert seen.shape == true.shape and np.abs(seen.astype(int) - true).mean() < 6
    cameras = [camera_for(number) for number in orientations]
    posed = found(turned, cameras)
    put_cameras(tmp_path / "run", posed)
    again = open_capture(tmp_path / "run")
    assert [frame.intrinsics for frame in again.frames] == cameras
    for before, after in zip(posed.frames, again.frames, strict=True):
        np.testing.assert_allclose(after.world_from_camera, before.world_from_camera, atol=1e-12)


def test_given_cameras_are_exported_as_they_came(tmp_path: Path) -> None:
    for number in (1, 3, 6):
        photo(tmp_path / "photos" / f"{number}.jpg", number, seed=number)
    capture = open_capture(tmp_path / "photos")
    posed = found(capture, [camera_for(1)] * 3)
    for kind in ("photos", "transforms"):
        put_cameras(tmp_path / kind, Capture(kind, posed.root, posed.frames))
    shutil.copy(tmp_path / "transforms" / "transforms.json", tmp_path / "photos")
    for frame, other in zip(open_capture(tmp_path / "photos").frames, posed.frames, strict=True):
        pose = other.world_from_camera
        np.testing.assert_allclose(invert(frame.world_from_camera) @ pose, np.eye(4), atol=1e-9)
        assert frame.intrinsics == camera_for(1)


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp", ".tif"])
def test_orientation_is_told_from_the_header(tmp_path: Path, suffix: str) -> None:
    for number in range(1, 9):
        assert orientation_of(photo(tmp_path / f"{number}{suffix}", number)) == number
    Image.fromarray(texture(HEIGHT, WIDTH)).save(tmp_path / "plain.png")
    (tmp_path / "broken.jpg").write_bytes(b"\xff\xd8\xff\xe1nothing")
    assert [orientation_of(tmp_path / name) for name in ("plain.png", "broken.jpg", "missing.jpg")] == [1, 1, 1]


def test_cameras_of_a_capture_behind_a_link_name_its_images_from_there(tmp_path: Path) -> None:
    place = tmp_path / "photos"
    photo(place / "images" / "1.jpg", 1, seed=1)
    photo(place / "images" / "2.jpg", 1, seed=2)
    posed = found(open_capture(place), [camera_for(1, PINHOLE), camera_for(1, PINHOLE)])
    put_cameras(place, posed)
    (tmp_path / "link").symlink_to(place)
    again = open_capture(tmp_path / "link")
    assert again.kind == "transforms"
    put_cameras(tmp_path / "cameras", again)
    assert '"file_path": "images/1.jpg"' in (tmp_path / "cameras" / "transforms.json").read_text()
