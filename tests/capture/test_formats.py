"""Image files that are stored in other ways than most: AVIF, floating-point and 12-bit TIFF, TIFF that says it is turned."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image, TiffImagePlugin

from fieldfuse.camera import Array
from fieldfuse.capture import open_capture
from fieldfuse.capture.archive import read_bytes
from fieldfuse.capture.checks import check_capture
from fieldfuse.capture.headers import image_header, orientation_of, read_header, read_tiff, unturned
from fieldfuse.capture.images import load_image, read_image, turns_by_exif
from fieldfuse.capture.storage import capture_from_dict, capture_to_dict
from fieldfuse.capture.types import CUT, Frame
from fieldfuse.errors import InputError
from tests.pipelines.made import make_room

HEIGHT, WIDTH = 40, 56


def scene(shift: int = 0) -> Array:
    """(H, W, 3) uint8 RGB, bright at the top left, with texture."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    waves = 60 * np.sin((columns + shift) / 4) * np.cos(rows / 5)
    return np.clip(np.stack([200 - 3 * rows + waves, 190 - 2 * columns + waves, 90 + waves], axis=2), 0, 255).astype(np.uint8)


def photos(folder: Path, suffix: str, count: int = 4) -> list[Path]:
    folder.mkdir(exist_ok=True)
    return [folder / f"{number:02d}{suffix}" for number in range(count)]


def test_avif_is_read_like_any_photo(tmp_path: Path) -> None:
    for number, path in enumerate(photos(tmp_path / "a", ".avif")):
        Image.fromarray(scene(3 * number)).save(path, quality=95)
    capture = check_capture(open_capture(tmp_path / "a"))
    assert [frame.image.suffix for frame in capture.frames] == [".avif"] * 4
    assert np.abs(load_image(capture.frames[0]).astype(int) - scene()).mean() < 6


def test_a_damaged_avif_is_refused_by_name(tmp_path: Path) -> None:
    for number, path in enumerate(photos(tmp_path / "a", ".avif")):
        Image.fromarray(scene(3 * number)).save(path)
    path = tmp_path / "a" / "02.avif"
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(InputError, match=r"02\.avif is cut short"):
        read_image(Frame("", path))


def test_floating_point_tiff_is_taken_as_0_to_1(tmp_path: Path) -> None:
    for number, path in enumerate(photos(tmp_path / "f", ".tif")):
        cv2.imwrite(str(path), scene(3 * number)[..., ::-1].astype(np.float32) / 255)
    capture = check_capture(open_capture(tmp_path / "f"))
    assert image_header(capture.frames[0].image).size == (WIDTH, HEIGHT)
    assert np.array_equal(load_image(capture.frames[0]), scene())


@pytest.mark.parametrize("white", [255, 1023, 65535])
def test_floating_point_tiff_of_whole_numbers_is_scaled(white: int, tmp_path: Path) -> None:
    for number, path in enumerate(photos(tmp_path / "f", ".tif")):
        cv2.imwrite(str(path), np.maximum(scene(3 * number), 255 * (number == 0))[..., ::-1].astype(np.float32) * np.float32(white / 255))
    capture = check_capture(open_capture(tmp_path / "f"))
    assert [frame.white for frame in capture.frames] == [white] * 4 and f"{white} is taken for white" in capture.warnings[0]
    assert np.array_equal(load_image(capture.frames[1]), scene(3))


def test_floating_point_values_beyond_white_are_cut_off_with_a_remark(tmp_path: Path) -> None:
    for number, path in enumerate(photos(tmp_path / "f", ".tif")):
        values = scene(3 * number)[..., ::-1].astype(np.float32) / 255
        values[:4, :4] = 9.0
        values[4, 0] = np.nan, np.inf, -1.0
        cv2.imwrite(str(path), values)
    capture = check_capture(open_capture(tmp_path / "f"))
    assert capture.frames[0].white is None
    assert capture.warnings == ("4 floating-point images have values up to 9; 1 is taken for white, and what is above it is cut off",)
    shown = load_image(capture.frames[0])
    assert (shown[:4, :4] == 255).all() and shown[4, 0].tolist() == [0, 255, 0] and np.array_equal(shown[8:], scene()[8:])


@pytest.mark.parametrize("suffix", [".tif", ".png"])
def test_twelve_bits_in_sixteen_are_scaled_to_white(suffix: str, tmp_path: Path) -> None:
    for number, path in enumerate(photos(tmp_path / "t", suffix)):
        cv2.imwrite(str(path), (scene(3 * number)[..., ::-1].astype(np.uint16) * 16))
    capture = check_capture(open_capture(tmp_path / "t"))
    assert {frame.white for frame in capture.frames} == {4095}
    assert any("12 of 16 bits" in warning for warning in capture.warnings)
    assert not any("dark" in warning for warning in capture.warnings)
    assert np.abs(load_image(capture.frames[0]).astype(int) - scene()).max() <= 1
    assert capture_from_dict(capture_to_dict(capture)) == capture


def test_all_sixteen_bits_stay_as_they_are(tmp_path: Path) -> None:
    for number, path in enumerate(photos(tmp_path / "t", ".tif")):
        cv2.imwrite(str(path), scene(3 * number)[..., ::-1].astype(np.uint16) * (257 if number == 3 else 16))
    capture = check_capture(open_capture(tmp_path / "t"))
    assert {frame.white for frame in capture.frames} == {None}


def turned_tiff(path: Path, pixels: Array, orientation: int) -> None:
    info = TiffImagePlugin.ImageFileDirectory_v2()
    info[274] = orientation
    Image.fromarray(pixels).save(path, tiffinfo=info)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_turned_tiff_is_turned_once_as_a_photo_and_never_beside_poses(orientation: int, tmp_path: Path) -> None:
    upright = scene()
    stored = {
        1: upright,
        2: upright[:, ::-1],
        3: upright[::-1, ::-1],
        4: upright[::-1],
        5: upright.swapaxes(0, 1),
        6: upright.swapaxes(0, 1)[::-1],
        7: upright[::-1, ::-1].swapaxes(0, 1),
        8: upright.swapaxes(0, 1)[:, ::-1],
    }[orientation]
    path = tmp_path / "a.tif"
    turned_tiff(path, np.ascontiguousarray(stored), orientation)
    got, said = read_image(Frame("", path))
    assert said == orientation == orientation_of(path)
    assert np.array_equal(got, stored)
    header = read_header(read_bytes(path), path)
    assert (header.width, header.height) == image_header(path).size == (stored.shape[1], stored.shape[0])
    frame = Frame("a", path)
    assert np.array_equal(load_image(frame, exif=True), upright)
    assert np.array_equal(load_image(frame), stored)


def test_damaged_tiffs_are_no_tiffs(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    turned_tiff(path, scene(), 6)
    data = path.read_bytes()
    assert read_tiff(data) is not None and read_tiff(unturned(data)).orientation == 1  # type: ignore[union-attr]
    rng = np.random.default_rng(0)
    for _ in range(300):
        broken = bytearray(data[: int(rng.integers(0, len(data)))] if rng.random() < 0.5 else data)
        for place in rng.integers(0, max(len(broken), 1), 6):
            if broken:
                broken[place % len(broken)] = int(rng.integers(0, 256))
        read_tiff(bytes(broken))
        unturned(bytes(broken))
    loop = b"II*\0" + struct.pack("<I", 8) + struct.pack("<H", 60000)
    assert read_tiff(loop) is None


# ------------------------------------------------------------------------------------------------ what is beside poses


@pytest.fixture
def room(tmp_path: Path) -> Path:
    make_room(tmp_path / "room", 8)
    return tmp_path / "room"


def turned_jpegs(room: Path, orientation: int) -> None:
    """The room's images as photos that EXIF turns upright by `orientation`, beside cameras for the upright images."""
    path = room / "transforms.json"
    data = json.loads(path.read_text())
    for entry in data["frames"]:
        upright = np.asarray(Image.open(room / entry["file_path"]))
        stored = {3: upright[::-1, ::-1], 6: np.rot90(upright), 8: np.rot90(upright, -1)}[orientation]
        exif = Image.Exif()
        exif[274] = orientation
        entry["file_path"] = str(Path(entry["file_path"]).with_suffix(".jpg"))
        Image.fromarray(np.ascontiguousarray(stored)).save(room / entry["file_path"], exif=exif, quality=95)
    path.write_text(json.dumps(data))


@pytest.mark.parametrize("orientation", [6, 8])
def test_photos_beside_cameras_of_upright_images_are_turned(orientation: int, room: Path) -> None:
    whole = open_capture(room)
    before = [load_image(frame).astype(int) for frame in whole.frames]
    turned_jpegs(room, orientation)
    capture = check_capture(open_capture(room))
    assert turns_by_exif(capture) and any("only when turned by EXIF" in warning for warning in capture.warnings)
    for frame, shown in zip(capture.frames, before, strict=True):
        assert np.abs(load_image(frame, exif=turns_by_exif(capture)).astype(int) - shown).mean() < 8
    assert turns_by_exif(capture_from_dict(capture_to_dict(capture)))


def test_images_that_exif_turns_by_180_degrees_are_remarked(room: Path) -> None:
    turned_jpegs(room, 3)
    capture = check_capture(open_capture(room))
    assert not turns_by_exif(capture) and any("by 180°" in warning for warning in capture.warnings)


def test_views_that_were_cut_out_of_panoramas_pass(room: Path) -> None:
    """They may have kept its metadata, and come with cameras."""
    xmp = b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><GPano:ProjectionType>equirectangular</GPano:ProjectionType></x:xmpmeta>'
    path = room / "transforms.json"
    data = json.loads(path.read_text())
    for entry in data["frames"]:
        image = Image.open(room / entry["file_path"])
        entry["file_path"] = str(Path(entry["file_path"]).with_suffix(".jpg"))
        image.save(room / entry["file_path"], xmp=xmp)
    path.write_text(json.dumps(data))
    assert len(check_capture(open_capture(room)).frames) == 8


def test_how_much_of_a_wide_lens_is_not_used_is_said(room: Path) -> None:
    path = room / "transforms.json"
    data = json.loads(path.read_text())
    path.write_text(json.dumps({**data, "camera_model": "OPENCV_FISHEYE", "fl_x": 45.0, "fl_y": 45.0, "k1": -0.03}))
    plain = check_capture(open_capture(room, projection="perspective"))
    assert any("outside of the pinhole view" in warning for warning in plain.warnings) and CUT not in plain.extra
    cut = check_capture(open_capture(room))
    assert not any("outside of the pinhole view" in warning for warning in cut.warnings) and "8 fisheye images" in cut.extra[CUT]
    path.write_text(json.dumps({**data, "camera_model": "OPENCV", "k1": -0.02}))
    assert not any("outside of the pinhole view" in warning for warning in check_capture(open_capture(room)).warnings)
