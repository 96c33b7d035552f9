"""Photo folders: natural order, focal length from EXIF, what is left out."""

from __future__ import annotations

import math
import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from fieldfuse.capture import open_capture
from fieldfuse.capture.checks import check_capture
from fieldfuse.capture.photos import focal_from_exif, read_photos
from fieldfuse.errors import InputError
from tests.capture.films import film, quarters


def photo(path: Path, size: tuple[int, int] = (120, 90), exif: dict[int, object] | None = None, orientation: int | None = None) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    tags = Image.Exif()
    if orientation:
        tags[0x0112] = orientation
    tags.get_ifd(0x8769).update(exif or {})
    Image.fromarray(np.full((size[1], size[0], 3), 90, np.uint8)).save(path, exif=tags)
    return path


def test_natural_order_suffixes_and_hidden_files(tmp_path: Path) -> None:
    for name in ("IMG_10.jpg", "IMG_9.JPG", "IMG_2.png", "b.webp", "a.bmp", "c.tif"):
        photo(tmp_path / name)
    (tmp_path / "._IMG_9.JPG").write_bytes(b"resource fork")
    (tmp_path / "notes.txt").write_text("x")
    capture = open_capture(tmp_path)
    assert capture.kind == "photos"
    assert [frame.name for frame in capture.frames] == ["a", "b", "c", "IMG_2", "IMG_9", "IMG_10"]
    assert not capture.posed
    assert all(frame.intrinsics is None and frame.image.is_absolute() for frame in capture.frames)


def test_photos_in_a_subfolder_are_found_beside_a_thumbnail(tmp_path: Path) -> None:
    photo(tmp_path / "thumb.jpg")
    for index in range(3):
        photo(tmp_path / "images" / f"{index}.jpg")
    assert [frame.name for frame in open_capture(tmp_path).frames] == ["0", "1", "2"]


@pytest.mark.parametrize(("size", "expected"), [((4000, 3000), 26 / 43.2666 * 5000), ((3000, 2000), 26 / 36 * 3000)])
def test_focal_from_the_35_mm_equivalent_compares_diagonals(tmp_path: Path, size: tuple[int, int], expected: float) -> None:
    focal = focal_from_exif(photo(tmp_path / "a.jpg", (size[0] // 10, size[1] // 10), {0xA405: 26, 0x920A: 4.2}))
    assert focal == pytest.approx(expected / 10, rel=1e-3)


def test_focal_from_the_sensor_follows_a_later_resize_and_a_turn(tmp_path: Path) -> None:
    # 5 mm on a sensor with 200 pixels a millimetre, written at 4000×3000: 1000 pixels.
    sensor = {0x920A: 5.0, 0xA20E: 200.0 * 25.4, 0xA210: 2, 0xA002: 4000, 0xA003: 3000}
    assert focal_from_exif(photo(tmp_path / "full.jpg", (400, 300), sensor)) == pytest.approx(100)
    assert focal_from_exif(photo(tmp_path / "turned.jpg", (300, 400), sensor)) == pytest.approx(100)
    centimetres = {**sensor, 0xA20E: 2000.0, 0xA210: 3}
    assert focal_from_exif(photo(tmp_path / "cm.jpg", (400, 300), centimetres)) == pytest.approx(100)


@pytest.mark.parametrize(
    "exif", [{}, {0xA405: 0}, {0x920A: 5.0}, {0xA405: 30000}, {0x920A: 5.0, 0xA20E: 0.0, 0xA210: 2}, {0x920A: math.inf, 0xA20E: 1.0}]
)
def test_an_unbelievable_focal_length_is_none(tmp_path: Path, exif: dict[int, object]) -> None:
    assert (
        focal_from_exif(photo(tmp_path / "a.tif" if any(v == math.inf for v in exif.values()) else tmp_path / "a.jpg", exif=exif)) is None
    )


def test_broken_exif_does_not_lose_the_photo(tmp_path: Path) -> None:
    path = photo(tmp_path / "a.jpg", exif={0xA405: 28})
    data = bytearray(path.read_bytes())
    at = data.index(b"Exif\0\0")
    data[at + 6 : at + 40] = b"\xff" * 34
    path.write_bytes(bytes(data))
    assert read_photos(tmp_path).frames[0].focal_prior is None


def test_no_photos(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    with pytest.raises(InputError, match="no photo"):
        read_photos(tmp_path)
    (tmp_path / "a.jpg").write_bytes(b"")
    with pytest.raises(InputError, match=r"a\.jpg cannot be read"):
        read_photos(tmp_path)


def test_a_name_that_is_not_utf8_is_refused_in_a_sentence(tmp_path: Path) -> None:
    """As archives of other systems leave names; OpenCV ended the process at a video of such a name, others failed after the fit."""
    strange = os.fsdecode(b"K\xfcche")
    for place in (tmp_path / strange, tmp_path / "photos"):
        for index in range(3):
            photo(place / f"{index}.jpg")
    photo(tmp_path / "photos" / f"{strange}.jpg")
    (tmp_path / "film").mkdir()
    (tmp_path / "link.mp4").symlink_to(film(tmp_path / "clip.mp4", quarters()).rename(tmp_path / "film" / f"{strange}.mp4"))
    for source in (tmp_path / strange, tmp_path / "photos", tmp_path / "film", tmp_path / "link.mp4"):
        with pytest.raises(InputError, match=r"K\?che.* is not UTF-8.*rename it"):
            open_capture(source)


def test_photos_squeezed_into_another_shape_are_said(tmp_path: Path) -> None:
    for size, said in (((64, 64), True), ((96, 64), False), ((64, 96), False)):
        root = tmp_path / str(size)
        for index in range(4):
            path = root / f"{index}.jpg"
            path.parent.mkdir(exist_ok=True)
            tags = Image.Exif()
            tags.get_ifd(0x8769).update({0xA002: 5472, 0xA003: 3648})
            noise = np.random.default_rng(index).integers(0, 255, (size[1], size[0], 3), dtype=np.uint8)
            Image.fromarray(noise).save(path, exif=tags)
        warnings = check_capture(open_capture(root)).warnings
        assert any("taken at 5472×3648, as EXIF has it, and are 64×64" in warning for warning in warnings) == said, size
