"""Pictures, depth maps and masks as they come: depth of 16 bits, grey, alpha, EXIF, and files that are damaged."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, ImageOps

from fieldfuse.capture.headers import MAX_PIXELS, read_header
from fieldfuse.capture.images import load_depth, load_image, load_mask, turns_by_exif, upright
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.errors import InputError
from tests.capture.board import capture_of, save, texture


def frame(path: Path) -> Frame:
    return Frame(path.stem, path)


# ---------------------------------------------------------------------------------------------------- colour


def test_colours_are_rgb(tmp_path: Path) -> None:
    picture = np.zeros((5, 7, 3), np.uint8)
    picture[:] = (200, 100, 50)
    np.testing.assert_array_equal(load_image(frame(save(tmp_path / "a.png", picture))), picture)


def test_alpha_is_kept_and_not_premultiplied(tmp_path: Path) -> None:
    picture = np.random.default_rng(0).integers(0, 256, (6, 8, 4), dtype=np.uint8)
    picture[0, :, 3] = 0
    np.testing.assert_array_equal(load_image(frame(save(tmp_path / "a.png", picture))), picture)


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_sixteen_bits_are_rounded(tmp_path: Path, channels: int) -> None:
    values = np.array([[0, 128, 129, 257, 32896, 65535]], np.uint16)
    path = tmp_path / "a.png"
    assert cv2.imwrite(str(path), values if channels == 1 else np.repeat(values[..., None], channels, axis=2))
    got = load_image(frame(path))
    assert got.dtype == np.uint8 and got.shape == (1, 6, 4 if channels == 4 else 3)
    np.testing.assert_array_equal(got[0, :, 0], [0, 0, 1, 1, 128, 255])


def test_grey_palette_and_black_and_white_pictures(tmp_path: Path) -> None:
    grey = texture(20, 30)[..., 0]
    for mode in ("L", "1", "P", "LA"):
        path = tmp_path / f"{mode}.png"
        Image.fromarray(grey).convert(mode).save(path)
        got = load_image(frame(path))
        assert got.shape[:2] == (20, 30) and got.shape[2] in (3, 4) and got.dtype == np.uint8
        expected = np.asarray(Image.open(path).convert("RGB"))
        np.testing.assert_array_equal(got[..., :3], expected)


def test_floating_point_pictures_are_zero_to_one(tmp_path: Path) -> None:
    path = tmp_path / "a.tiff"
    values = np.array([[0.0, 0.5, 1.0, 2.0, -1.0, np.nan]], np.float32)
    assert cv2.imwrite(str(path), values)
    np.testing.assert_array_equal(load_image(frame(path))[0, :, 1], [0, 128, 255, 255, 0, 0])


# ---------------------------------------------------------------------------------------------------- EXIF


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation_only_when_asked(tmp_path: Path, orientation: int) -> None:
    tags = Image.Exif()
    tags[0x0112] = orientation
    path = tmp_path / "a.jpg"
    Image.fromarray(texture(24, 40)).save(path, exif=tags, quality=95)
    stored = np.asarray(Image.open(path).convert("RGB")).astype(int)
    turned = np.asarray(ImageOps.exif_transpose(Image.open(path)).convert("RGB")).astype(int)
    # Two builds of the JPEG decoder may differ by a level or two.
    assert np.abs(load_image(frame(path), exif=False).astype(int) - stored).max() <= 3
    assert np.abs(load_image(frame(path), exif=True).astype(int) - turned).max() <= 3


def test_only_photo_folders_are_turned() -> None:
    assert turns_by_exif(Capture("photos", Path("/"), ()))
    assert not any(turns_by_exif(Capture(kind, Path("/"), ())) for kind in ("transforms", "colmap", "video", "llff", "7scenes"))


def test_damaged_exif_does_no_harm(tmp_path: Path) -> None:
    data = io.BytesIO()
    Image.fromarray(texture(24, 40)).save(data, "JPEG")
    broken = b"Exif\0\0II*\0\xff\xff\xff\x7f"
    raw = data.getvalue()
    (tmp_path / "a.jpg").write_bytes(raw[:2] + b"\xff\xe1" + struct.pack(">H", len(broken) + 2) + broken + raw[2:])
    assert load_image(frame(tmp_path / "a.jpg"), exif=True).shape == (24, 40, 3)


@given(st.integers(1, 8), st.integers(1, 6), st.integers(1, 6))
def test_turning_keeps_all_pixels(orientation: int, height: int, width: int) -> None:
    picture = np.arange(height * width * 3, dtype=np.uint8).reshape(height, width, 3)
    turned = upright(picture, orientation)
    assert turned.shape[:2] == ((width, height) if orientation >= 5 else (height, width))
    assert sorted(turned.reshape(-1, 3).tolist()) == sorted(picture.reshape(-1, 3).tolist())
    back = {6: 8, 8: 6}.get(orientation, orientation)
    np.testing.assert_array_equal(upright(turned, back), picture)


# ---------------------------------------------------------------------------------------------------- damaged files


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp"])
@pytest.mark.parametrize("share", [0.35, 0.7, 0.98])
def test_truncated_pictures_are_refused_by_name(tmp_path: Path, suffix: str, share: float, capfd: pytest.CaptureFixture[str]) -> None:
    path = save(tmp_path / f"photo{suffix}", texture(120, 160))
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    with pytest.raises(InputError, match=rf"photo\{suffix}.*(cut short|damaged)"):
        load_image(frame(path))
    assert capfd.readouterr().err == ""


def jpeg(quality: int = 90, progressive: bool = False, thumbnail: bool = False, orientation: int = 1) -> bytes:
    data = io.BytesIO()
    tags = Image.Exif()
    tags[0x0112] = orientation
    Image.fromarray(texture(120, 160)).save(data, "JPEG", quality=quality, progressive=progressive, exif=tags)
    raw = data.getvalue()
    if thumbnail:  # a small JPEG with its own end marker inside a metadata segment, as cameras write it
        small = io.BytesIO()
        Image.fromarray(texture(16, 16)).save(small, "JPEG")
        segment = b"THUMB\0" + small.getvalue()
        raw = raw[:2] + b"\xff\xec" + struct.pack(">H", len(segment) + 2) + segment + raw[2:]
    return raw


@pytest.mark.parametrize("progressive", [False, True])
@pytest.mark.parametrize("thumbnail", [False, True])
def test_a_truncated_jpeg_is_told_from_a_whole_one(tmp_path: Path, progressive: bool, thumbnail: bool) -> None:
    data = jpeg(progressive=progressive, thumbnail=thumbnail)
    path = tmp_path / "a.jpg"
    for whole in (data, data + bytes(100), data + b"motion photo" * 50):
        path.write_bytes(whole)
        assert load_image(frame(path)).shape == (120, 160, 3)
    for cut in (data[:-2], data[: len(data) // 2], data[:-500] + bytes(500)):
        path.write_bytes(cut)
        with pytest.raises(InputError, match=r"a\.jpg.*cut short"):
            load_image(frame(path))


@given(st.integers(0, 2000), st.integers(0, 255))
def test_a_changed_byte_in_the_header_never_ends_in_a_traceback(position: int, value: int) -> None:
    data = bytearray(jpeg(thumbnail=True))
    data[position % len(data)] = value
    try:
        header = read_header(bytes(data), Path("x.jpg"))
    except InputError:
        return
    assert 0 < header.width * header.height <= MAX_PIXELS


def test_missing_empty_and_foreign_files(tmp_path: Path) -> None:
    (tmp_path / "empty.png").write_bytes(b"")
    (tmp_path / "text.png").write_text("no image")
    for name, text in (("missing.png", "cannot read"), ("empty.png", "empty"), ("text.png", "not an image")):
        with pytest.raises(InputError, match=rf"{text}|{name}.*{text}"):
            load_image(frame(tmp_path / name))


def png_header(width: int, height: int) -> bytes:
    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
        + chunk(b"IDAT", zlib.compress(b"\0" * 64))
        + chunk(b"IEND", b"")
    )


def test_decompression_bombs_are_not_decoded(tmp_path: Path) -> None:
    path = tmp_path / "bomb.png"
    path.write_bytes(png_header(100_000, 100_000))
    with pytest.raises(InputError, match="megapixels"):
        load_image(frame(path))
    with pytest.raises(InputError, match="megapixels"):
        load_mask(Frame("a", path, mask=path))
    # Pillow warns from 89 megapixels and refuses from 179; pictures up to our own limit pass.
    assert read_header(png_header(16_000, 12_000), path).width == 16_000
    assert Image.MAX_IMAGE_PIXELS is not None


# ---------------------------------------------------------------------------------------------------- depth, masks


def depth_of(path: Path, scale: float = 1000.0) -> np.ndarray:
    return load_depth(Frame("a", path, depth=path), capture_of(path.parent, [], depth_scale=scale))


def test_depth_from_sixteen_bit_png(tmp_path: Path) -> None:
    path = save(tmp_path / "d.png", np.array([[0, 65535, 1500, 1]], np.uint16))
    got = depth_of(path)
    assert got.dtype == np.float32
    np.testing.assert_allclose(got, [[0, 0, 1.5, 0.001]], rtol=1e-6)
    np.testing.assert_allclose(depth_of(path, 5000.0), [[0, 0, 0.3, 0.0002]], rtol=1e-6)


@pytest.mark.parametrize("suffix", [".npy", ".tiff", ".pfm"])
def test_depth_from_floats(tmp_path: Path, suffix: str) -> None:
    values = np.array([[0.5, 65535.0, np.nan, np.inf, -2.0, 0.0]], np.float32)
    path = tmp_path / f"d{suffix}"
    if suffix == ".npy":
        np.save(path, values[..., None].astype(np.float64))
    else:
        assert cv2.imwrite(str(path), values)
    np.testing.assert_array_equal(depth_of(path, 1.0), [[0.5, 65535, 0, 0, 0, 0]])


def test_unusable_depth_is_refused(tmp_path: Path) -> None:
    save(tmp_path / "colour.png", texture(4, 4))
    np.save(tmp_path / "objects.npy", np.array([[{"a": 1}]], dtype=object), allow_pickle=True)
    np.save(tmp_path / "words.npy", np.array([["a"]]))
    (tmp_path / "junk.npy").write_bytes(b"\x93NUMPY junk")
    np.save(tmp_path / "huge.npy", np.zeros((2, 2)))
    data = (tmp_path / "huge.npy").read_bytes()
    (tmp_path / "huge.npy").write_bytes(data.replace(b"(2, 2), }" + b" " * 8, b"(90000, 90000), }"))
    (tmp_path / "open.npy").write_bytes(data.replace(b"(2, 2), }", b"(2, 2,   "))
    (tmp_path / "more.npy").write_bytes(data.replace(b"(2, 2)", b"(9, 9)"))
    for name in ("colour.png", "objects.npy", "words.npy", "junk.npy", "huge.npy", "open.npy", "more.npy", "missing.npy", "missing.png"):
        with pytest.raises(InputError, match=name.replace(".", r"\.")):
            depth_of(tmp_path / name)


def test_masks(tmp_path: Path) -> None:
    grey = np.array([[0, 1, 255]], np.uint8)
    colour = np.zeros((1, 3, 3), np.uint8)
    colour[0, 1] = (0, 0, 9)
    wide = np.array([[0, 1, 65535]], np.uint16)
    for mask, expected in ((grey, [[False, True, True]]), (colour, [[False, True, False]]), (wide, [[False, True, True]])):
        path = save(tmp_path / "m.png", mask)
        got = load_mask(Frame("a", path, mask=path))
        assert got is not None and got.dtype == bool
        np.testing.assert_array_equal(got, expected)
    assert load_mask(frame(path)) is None
