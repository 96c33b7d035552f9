"""Images of linear light: OpenEXR, camera raw, floating-point TIFF. One exposure and one white balance for all, said in a remark."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image, ImageCms

from fieldfuse.camera import Array
from fieldfuse.capture import open_capture
from fieldfuse.capture.checks import check_capture
from fieldfuse.capture.convert import convert_images, to_convert
from fieldfuse.capture.headers import image_header, orientation_of
from fieldfuse.capture.images import load_image
from fieldfuse.capture.light import LIGHT, with_white
from fieldfuse.capture.photos import focal_from_exif
from fieldfuse.capture.storage import capture_from_dict, capture_to_dict
from fieldfuse.capture.types import Capture
from fieldfuse.errors import InputError
from fieldfuse.tone import decode as to_linear
from fieldfuse.tone import encode
from tests.capture.board import texture
from tests.capture.dng import FOCAL_35, mosaic, write_dng

HEIGHT, WIDTH = 60, 80


def light(number: int) -> Array:
    """(H, W, 3) float32 linear light, up to about 0.9, smooth as behind a lens, another view for each number."""
    grey = cv2.GaussianBlur(texture(HEIGHT + 40, WIDTH + 40, 5), (0, 0), 2.0)[10 + number :][:HEIGHT, 3 * number : 3 * number + WIDTH]
    colours = (grey.astype(np.float32) - 60) / 140
    return np.asarray(to_linear(0.1 + 0.85 * colours.clip(0, 1)), dtype=np.float32)


def exr_photos(folder: Path, scale: float = 1.0, count: int = 4) -> Capture:
    OpenEXR = pytest.importorskip("OpenEXR")
    folder.mkdir()
    for number in range(count):
        planes = {name: np.ascontiguousarray(light(number)[..., at] * np.float32(scale)) for at, name in enumerate("RGB")}
        OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, planes).write(str(folder / f"{number}.exr"))
    return open_capture(folder)


def raw_photos(folder: Path, gains: tuple[float, ...] = (1.0, 1.0, 1.0, 1.0), **options: int) -> Capture:
    pytest.importorskip("rawpy")
    folder.mkdir()
    for number, gain in enumerate(gains):
        write_dng(folder / f"{number}.dng", mosaic(gain * light(number)), **options)
    return open_capture(folder)


def tiff_photos(folder: Path, change: float = 1.0) -> Capture:
    folder.mkdir()
    for number in range(4):
        cv2.imwrite(str(folder / f"{number}.tif"), np.ascontiguousarray(light(number)[..., ::-1] * np.float32(change)))
    return open_capture(folder)


def off(image: Array, expected: Array) -> float:
    """Mean difference of an image from linear light shown as sRGB, in grey levels."""
    return float(np.abs(image.astype(float) - 255 * encode(expected)).mean())


def test_openexr_that_is_exposed_well_is_shown_as_it_is(tmp_path: Path) -> None:
    capture = check_capture(exr_photos(tmp_path / "a"))
    assert [frame.white for frame in capture.frames] == [1.0] * 4
    assert any("4 images hold linear light (OpenEXR), shown as sRGB with 1 as white in all of them" in text for text in capture.warnings)
    assert off(load_image(capture.frames[2]), light(2)) < 0.6


@pytest.mark.parametrize("scale", [40.0, 0.02])
def test_one_exposure_is_chosen_for_all(scale: float, tmp_path: Path) -> None:
    capture = check_capture(exr_photos(tmp_path / "a", scale))
    (white,) = {frame.white for frame in capture.frames}
    assert white is not None and 0.6 * scale < white < 1.25 * scale
    for number, frame in enumerate(capture.frames):
        assert off(load_image(frame), light(number) * scale / white) < 0.6


def test_a_lamp_does_not_make_all_else_black(tmp_path: Path) -> None:
    OpenEXR = pytest.importorskip("OpenEXR")
    capture = exr_photos(tmp_path / "a")
    for number, frame in enumerate(capture.frames):
        image = light(number).copy()
        image[:, :16] = 500  # a fifth of each
        planes = {name: np.ascontiguousarray(image[..., at]) for at, name in enumerate("RGB")}
        OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, planes).write(str(frame.image))
    shown = load_image(check_capture(open_capture(tmp_path / "a")).frames[0])
    assert np.median(shown[:, 16:]) > 40


def test_openexrs_alpha_is_taken_out_of_its_colours(tmp_path: Path) -> None:
    OpenEXR = pytest.importorskip("OpenEXR")
    capture = exr_photos(tmp_path / "a")
    alpha = np.full((HEIGHT, WIDTH), 0.5, np.float32)
    alpha[:20] = 0
    for number, frame in enumerate(capture.frames):
        planes = {name: np.ascontiguousarray(light(number)[..., at] * alpha) for at, name in enumerate("RGB")}
        OpenEXR.File({"type": OpenEXR.scanlineimage}, {**planes, "A": alpha.copy()}).write(str(frame.image))
    capture = open_capture(tmp_path / "a")
    image = load_image(capture.frames[1])
    assert capture.alpha and image.shape == (HEIGHT, WIDTH, 4) and set(np.unique(image[..., 3])) == {0, 128}
    assert off(image[20:, :, :3], light(1)[20:]) < 0.6


def test_openexr_beside_photos_is_not_a_photo(tmp_path: Path) -> None:
    exr_photos(tmp_path / "a")
    for number in range(3):
        cv2.imwrite(str(tmp_path / "a" / f"p{number}.png"), np.round(255 * encode(light(number))).astype(np.uint8))
    assert [frame.image.suffix for frame in open_capture(tmp_path / "a").frames] == [".png"] * 3


# ------------------------------------------------------------------------------------------------ floating-point TIFF


def test_floating_point_tiff_of_linear_light_is_noticed(tmp_path: Path) -> None:
    capture = check_capture(tiff_photos(tmp_path / "a"))
    assert "floating-point TIFF, as they are no levels of 8 or 16 bits: --set capture.light=display" in " ".join(capture.warnings)
    assert off(load_image(capture.frames[0]), light(0)) < 0.6
    again = capture_from_dict(capture_to_dict(capture))
    assert again.frames[0].linear is True and again.frames[0].white == capture.frames[0].white


def test_floating_point_tiff_beyond_1_is_light(tmp_path: Path) -> None:
    capture = check_capture(tiff_photos(tmp_path / "a", 3.0))
    assert "as values exceed 1" in " ".join(capture.warnings) and {frame.linear for frame in capture.frames} == {True}


@pytest.mark.parametrize(("word", "linear"), [("display", None), ("linear", True)])
def test_the_users_word_decides(word: str, linear: bool | None, tmp_path: Path) -> None:
    capture = tiff_photos(tmp_path / "a")
    capture = check_capture(replace(capture, extra={**capture.extra, LIGHT: word}))
    assert {frame.linear for frame in capture.frames} <= {linear, False}
    shown = load_image(capture.frames[0])
    assert off(shown, light(0)) < 0.6 if linear else np.abs(shown - 255.0 * light(0)).mean() < 0.6


def test_the_profile_decides(tmp_path: Path) -> None:
    """A linear one as image programs embed in what they save in 32 bits, and sRGB's own."""
    straight = bytearray(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    at = next(i for i in range(132, 400, 12) if straight[i : i + 4] == b"gTRC")
    place = int.from_bytes(straight[at + 4 : at + 8], "big")
    straight[place : place + 12] = b"curv" + bytes(8)
    for name, profile in (("linear", bytes(straight)), ("srgb", ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())):
        folder = tmp_path / name
        folder.mkdir()
        for number in range(3):
            Image.fromarray(light(number)[..., 0], mode="F").save(folder / f"{number}.tif", icc_profile=profile)
        capture = with_white(open_capture(folder))
        assert {frame.linear for frame in capture.frames} == {True if name == "linear" else None}


# ------------------------------------------------------------------------------------------------ camera raw


def test_camera_raw_is_developed_alike(tmp_path: Path) -> None:
    """Exact light, one white balance, one white; a darker photo stays darker."""
    capture = check_capture(raw_photos(tmp_path / "a", (1.0, 1.0, 0.25, 1.0)))
    assert {frame.balance for frame in capture.frames} == {(2.0, 1.0, 1.667)} and len({frame.white for frame in capture.frames}) == 1
    assert "4 images are camera raw, developed with one white balance (red 2, blue 1.67 times" in " ".join(capture.warnings)
    assert capture_from_dict(json.loads(json.dumps(capture_to_dict(capture)))).frames == capture.frames
    white = (capture.frames[0].white or 0) / 65535
    for number, gain in ((0, 1.0), (2, 0.25)):
        assert off(load_image(capture.frames[number])[2:-2, 2:-2], (gain * light(number) / white)[2:-2, 2:-2]) < 2.5


def test_cameras_other_white_balance_changes_nothing(tmp_path: Path) -> None:
    raw_photos(tmp_path / "a")
    write_dng(tmp_path / "a" / "3.dng", mosaic(light(3)), neutral=(0.7, 1.0, 0.4))
    capture = check_capture(open_capture(tmp_path / "a"))
    white = (capture.frames[0].white or 0) / 65535
    assert {frame.balance for frame in capture.frames} == {(2.0, 1.0, 1.667)}
    assert off(load_image(capture.frames[3])[2:-2, 2:-2], (light(3) / white)[2:-2, 2:-2]) < 2.5


@pytest.mark.parametrize("orientation", [3, 6])
def test_camera_raw_is_turned_once(orientation: int, tmp_path: Path) -> None:
    capture = raw_photos(tmp_path / "a", orientation=orientation)
    frame = check_capture(capture).frames[0]
    size = (HEIGHT, WIDTH) if orientation == 6 else (WIDTH, HEIGHT)
    assert image_header(frame.image).size == size and orientation_of(frame.image) == 1
    image = load_image(frame, exif=True)
    upright = np.rot90(light(0), 2 if orientation == 3 else 3)
    assert image.shape[1::-1] == size and off(image[2:-2, 2:-2], (upright / ((frame.white or 0) / 65535))[2:-2, 2:-2]) < 2.5


def test_camera_raw_is_written_once_as_jpeg_and_has_its_focal_length(tmp_path: Path) -> None:
    capture = raw_photos(tmp_path / "a")
    focal = FOCAL_35 / np.hypot(36, 24) * np.hypot(WIDTH, HEIGHT)
    assert capture.frames[0].focal_prior == pytest.approx(focal) == focal_from_exif(capture.frames[0].image)
    assert to_convert(capture) == [0, 1, 2, 3]
    converted = convert_images(capture, tmp_path / "out", 2)
    first = converted.frames[0]
    assert first.image == (tmp_path / "out" / "frames" / "0.jpg").resolve()
    assert (first.white, first.linear, first.balance) == (None, None, None)
    direct = load_image(check_capture(capture).frames[0])
    assert np.abs(load_image(first).astype(int) - direct).mean() < 3
    before = first.image.stat().st_mtime_ns
    assert convert_images(capture, tmp_path / "out", 2).frames[0].image.stat().st_mtime_ns == before
    assert any("camera raw" in text for text in converted.warnings)


def test_camera_raw_beside_jpegs_is_the_same_photos(tmp_path: Path) -> None:
    raw_photos(tmp_path / "a")
    for number in range(4):
        cv2.imwrite(str(tmp_path / "a" / f"{number}.jpg"), np.round(255 * encode(light(number))).astype(np.uint8))
    assert [frame.image.suffix for frame in open_capture(tmp_path / "a").frames] == [".jpg"] * 4


def test_damaged_camera_raw_is_one_sentence(tmp_path: Path) -> None:
    capture = raw_photos(tmp_path / "a")
    path = capture.frames[1].image
    for data in (path.read_bytes()[:4000], bytes(1000)):
        path.write_bytes(data)
        with pytest.raises(InputError, match=r"the raw file .*1\.dng is damaged, or of a camera that LibRaw"):
            load_image(capture.frames[1])


def test_without_rawpy_a_sentence_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    raw_photos(tmp_path / "a")
    monkeypatch.setitem(sys.modules, "rawpy", None)
    with pytest.raises(InputError, match=r'camera raw file, which needs .* \(pip install "fieldfuse\[raw\]"\), or develop'):
        open_capture(tmp_path / "a")
