"""HEIF photos (.heic): read as they are to be seen, found and converted like any other photo, refused in one sentence when damaged."""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from fieldfuse.camera import Array
from fieldfuse.capture import open_capture
from fieldfuse.capture.convert import CONVERTED, all_converted, convert_images, to_convert
from fieldfuse.capture.headers import read_header
from fieldfuse.capture.images import load_image
from fieldfuse.capture.types import Frame
from fieldfuse.errors import InputError, Interrupted
from fieldfuse.progress import Progress
from tests.capture.board import texture

pillow_heif = pytest.importorskip("pillow_heif", reason="pillow-heif is not installed; make test brings it")


def heic(path: Path, picture: Array, orientation: int = 1, **options: object) -> Path:
    """A HEIF file with `image`, stored so that `orientation` turns it upright; encoded in haste, which on two busy cores is a fifth."""
    pillow_heif.register_heif_opener()
    path.parent.mkdir(parents=True, exist_ok=True)
    tags = Image.Exif()
    tags[0x0112] = orientation
    tags.get_ifd(0x8769).update({0xA405: 26})
    options = {"quality": 90, "enc_params": {"preset": "ultrafast"}, **options}
    Image.fromarray(picture).save(path, format="HEIF", exif=tags.tobytes(), **options)
    return path


def smooth(seed: int = 0, height: int = 90, width: int = 120) -> Array:
    """A image that codecs keep within a few levels."""
    rough = texture(height, width, seed=seed).astype(np.float32)
    return np.asarray(np.clip(cv2.GaussianBlur(rough, (0, 0), 4) * 1.2, 0, 255), dtype=np.uint8)


def folder(root: Path, count: int = 6) -> Path:
    for index in range(count):
        heic(root / f"IMG_{index:04d}.HEIC", smooth(index))
    return root


def close(a: Array, b: Array) -> bool:
    return a.shape == b.shape and float(np.abs(a.astype(int) - b.astype(int)).mean()) < 3


# ---------------------------------------------------------------------------------------------------- reading


@pytest.mark.parametrize("exif", [False, True])
def test_a_turned_photo_stands_upright_either_way(tmp_path: Path, exif: bool) -> None:
    seen = smooth()
    stored = np.ascontiguousarray(np.rot90(seen))  # lies on its side; orientation 6 turns it back
    path = heic(tmp_path / "a.heic", stored, orientation=6)
    assert close(load_image(Frame("a", path), exif=exif), seen)
    header = read_header(path.read_bytes(), path)
    assert (header.width, header.height, header.format, header.orientation) == (120, 90, "HEIF", 1)


def test_the_content_counts_and_not_the_name(tmp_path: Path) -> None:
    """Phones and messengers do both: HEIF named .jpg, and JPEG named .heic."""
    heic(tmp_path / "a.jpg", smooth())
    Image.fromarray(smooth(1)).save(tmp_path / "b.heic", format="JPEG", quality=95)
    assert close(load_image(Frame("a", tmp_path / "a.jpg")), smooth())
    assert close(load_image(Frame("b", tmp_path / "b.heic")), smooth(1))
    assert to_convert(open_capture(tmp_path)) == [0]


def test_alpha_grey_and_ten_bits(tmp_path: Path) -> None:
    alpha = np.dstack([smooth(), np.tile(np.linspace(0, 255, 120).astype(np.uint8), (90, 1))])
    assert close(load_image(Frame("a", heic(tmp_path / "a.heic", alpha))), alpha)
    grey = load_image(Frame("g", heic(tmp_path / "g.heic", smooth()[..., 0])))
    assert close(grey, np.repeat(smooth()[..., :1], 3, axis=2))
    wide = smooth().astype(np.uint16) * 257
    pillow_heif.from_bytes("RGB;16", (120, 90), wide.tobytes()).save(tmp_path / "w.heic", quality=90)
    assert close(load_image(Frame("w", tmp_path / "w.heic")), smooth())


def test_what_is_there_as_jpeg_too_is_used_once(tmp_path: Path) -> None:
    folder(tmp_path, 3)
    for index in (0, 2):
        Image.fromarray(smooth(index)).save(tmp_path / f"IMG_{index:04d}.jpg")
    capture = open_capture(tmp_path)
    assert [frame.image.suffix for frame in capture.frames] == [".jpg", ".HEIC", ".jpg"]
    assert any("2 images are there as HEIC and in another format" in warning for warning in capture.warnings)


def test_the_small_copy_in_the_file_is_looked_at_where_there_is_one(tmp_path: Path) -> None:
    from fieldfuse.capture.checks import THUMB_SIDE, thumbnail

    seen = smooth(0, 360, 480)
    for name, options in (("with", {"thumbnails": [400]}), ("without", {})):
        path = heic(tmp_path / f"{name}.heic", seen, **options)
        data = path.read_bytes()
        grey = thumbnail(data, read_header(data, path), Frame("", path))
        assert max(grey.shape) == (400 if options else THUMB_SIDE)
        expected = cv2.resize(cv2.cvtColor(seen, cv2.COLOR_RGB2GRAY), grey.shape[::-1], interpolation=cv2.INTER_AREA)
        assert close(grey, expected)


# ---------------------------------------------------------------------------------------------------- damaged


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damage_anywhere_gives_a_picture_or_a_sentence(tmp_path: Path, data: st.DataObject) -> None:
    path, sound = tmp_path / "a.heic", tmp_path / "sound.heic"
    whole = bytearray((sound if sound.exists() else heic(sound, smooth())).read_bytes())
    at = data.draw(st.integers(0, len(whole) - 1))
    whole[at : at + data.draw(st.integers(0, 9))] = data.draw(st.binary(max_size=9))
    path.write_bytes(bytes(whole))
    try:
        assert load_image(Frame("a", path)).dtype == np.uint8
    except InputError as error:
        assert "\n" not in str(error) and "a.heic" in str(error)


def test_without_the_package_one_sentence_says_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder(tmp_path)
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    with pytest.raises(InputError, match=r"IMG_0000\.HEIC is a HEIF image .* .pip install \"fieldfuse\[heic\]\""):
        open_capture(tmp_path)


# ---------------------------------------------------------------------------------------------------- converting


class StopsAt(Progress):
    def __init__(self, done: int) -> None:
        self.done, self.at = done, 0.0

    def update(self, done: float, total: float, note: str = "") -> None:
        self.at = max(self.at, done)

    def stopping(self) -> bool:
        return self.at >= self.done


def test_pictures_are_written_as_jpeg_and_the_others_stay(tmp_path: Path) -> None:
    source = folder(tmp_path / "photos")
    Image.fromarray(smooth(7)).save(source / "z.jpg", quality=95)
    heic(source / "with_alpha.heic", np.dstack([smooth(8), np.full((90, 120), 128, np.uint8)]))
    capture = open_capture(source)
    got = convert_images(capture, tmp_path / "run", 2)
    assert [frame.name for frame in got.frames] == [frame.name for frame in capture.frames]
    assert [frame.focal_prior for frame in got.frames] == [frame.focal_prior for frame in capture.frames]
    assert got.extra[CONVERTED] == 7 and got.extra["sizes"] == {"120x90": 8}
    places = {frame.name: frame.image for frame in got.frames}
    assert not all_converted(capture) and not all_converted(got)  # one was a JPEG before
    assert all_converted(got.with_frames([frame for frame in got.frames if frame.name != "z"]))
    assert places["z"] == (source / "z.jpg").resolve()
    assert places["with_alpha"] == tmp_path / "run" / "frames" / "with_alpha.png"
    assert places["IMG_0003"] == tmp_path / "run" / "frames" / "IMG_0003.jpg"
    for before, after in zip(capture.frames, got.frames, strict=True):
        assert close(load_image(after), load_image(before))


def test_a_stopped_conversion_goes_on_and_a_changed_photo_is_converted_again(tmp_path: Path) -> None:
    source, run = folder(tmp_path / "photos"), tmp_path / "run"
    capture = open_capture(source)
    with pytest.raises(Interrupted):
        convert_images(capture, run, 1, StopsAt(3))
    first = {path.name: path.stat().st_mtime_ns for path in (run / "frames").glob("*.jpg")}
    assert len(first) == 3 and not list((run / "frames").glob(".*"))
    heic(source / "IMG_0001.HEIC", smooth(20))
    got = convert_images(open_capture(source), run, 2)
    assert len(got.frames) == 6
    for name, written in first.items():
        assert (written == (run / "frames" / name).stat().st_mtime_ns) == (name != "IMG_0001.jpg")
    assert close(load_image(got.frames[1]), smooth(20))
    (run / "frames" / "converted.json").write_text("[1, 2")
    again = convert_images(open_capture(source), run, 2)
    assert close(load_image(again.frames[1]), smooth(20))
