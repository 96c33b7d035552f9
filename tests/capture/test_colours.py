"""Colour profiles: photos of phones (Display P3) and cameras (Adobe RGB) come as sRGB, and nothing else changes."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image, ImageCms

from fieldfuse.camera import Array
from fieldfuse.capture.colours import MOST_BYTES, png_colours, profile_of, to_srgb
from fieldfuse.capture.convert import write_image
from fieldfuse.capture.images import load_image, load_mask
from fieldfuse.capture.types import Frame
from tests.capture.board import texture

# Chromaticities of red, green and blue (SMPTE EG 432-1; Adobe RGB (1998); ITU-R BT.709), all under the white D65.
P3 = ((0.680, 0.320), (0.265, 0.690), (0.150, 0.060))
ADOBE = ((0.64, 0.33), (0.21, 0.71), (0.15, 0.06))
BT2020 = ((0.708, 0.292), (0.170, 0.797), (0.131, 0.046))
SRGB = ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06))
D65, D50 = (0.3127, 0.3290), (0.3457, 0.3585)
BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])


def xyz(chromaticity: tuple[float, float]) -> Array:
    x, y = chromaticity
    return np.array([x / y, 1.0, (1 - x - y) / y])


def xyz_from_rgb(primaries: tuple[tuple[float, float], ...]) -> Array:
    """(3, 3) linear light to XYZ, white at D65."""
    columns = np.stack([xyz(primary) for primary in primaries], axis=1)
    return np.asarray(columns * np.linalg.solve(columns, xyz(D65)))


def linear(stored: Array) -> Array:
    return np.asarray(np.where(stored <= 0.04045, stored / 12.92, ((stored + 0.055) / 1.055) ** 2.4))


def stored(light: Array) -> Array:
    light = np.clip(light, 0, 1)
    return np.asarray(np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055))


def profile(primaries: tuple[tuple[float, float], ...], gamma: float | None = None) -> bytes:
    """An ICC profile (version 4: matrix and curves) with these primaries and sRGB's curve, or a power."""

    def fixed(value: float) -> bytes:
        return struct.pack(">i", round(value * 65536))

    adapted = (np.linalg.inv(BRADFORD) * (BRADFORD @ xyz(D50) / (BRADFORD @ xyz(D65)))) @ BRADFORD @ xyz_from_rgb(primaries)
    numbers = [2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045] if gamma is None else [gamma]
    curve = b"para\0\0\0\0" + struct.pack(">HH", 3 if gamma is None else 0, 0) + b"".join(fixed(number) for number in numbers)
    text = b"mluc\0\0\0\0" + struct.pack(">II", 1, 12) + b"enUS" + struct.pack(">II", 4, 28) + "it".encode("utf-16-be")
    tags = {b"desc": text, b"cprt": text, b"wtpt": b"XYZ \0\0\0\0" + b"".join(fixed(v) for v in xyz(D50))}
    for name, column in zip("rgb", adapted.T, strict=True):
        tags[f"{name}XYZ".encode()] = b"XYZ \0\0\0\0" + b"".join(fixed(v) for v in column)
        tags[f"{name}TRC".encode()] = curve
    table, body, at = struct.pack(">I", len(tags)), b"", 128 + 4 + 12 * len(tags)
    for name, data in tags.items():
        data += b"\0" * (-len(data) % 4)
        table += name + struct.pack(">II", at + len(body), len(data))
        body += data
    head = struct.pack(">I", at + len(body)) + b"lcms" + bytes.fromhex("04300000") + b"mntrRGB XYZ "
    head += struct.pack(">6H", 2026, 1, 1, 0, 0, 0) + b"acsp" + b"\0" * 28 + b"".join(fixed(v) for v in xyz(D50))
    return head.ljust(128, b"\0") + table + body


def expected(picture: Array, primaries: tuple[tuple[float, float], ...], gamma: float | None = None) -> Array:
    """The same colours in sRGB, by the definitions."""
    value = picture.astype(float) / 255
    light = linear(value) if gamma is None else value**gamma
    return stored(light @ (np.linalg.inv(xyz_from_rgb(SRGB)) @ xyz_from_rgb(primaries)).T) * 255


def colours(height: int = 40, width: int = 50) -> Array:
    return np.random.default_rng(3).integers(0, 256, (height, width, 3), dtype=np.uint8)


@pytest.mark.parametrize(("primaries", "gamma"), [(P3, None), (ADOBE, 2.19921875), (SRGB, 1.8)])
def test_profiles_are_followed_to_a_level(primaries: tuple[tuple[float, float], ...], gamma: float | None) -> None:
    picture = colours(600, 50)
    got = to_srgb(picture, profile(primaries, gamma))
    assert got.dtype == np.uint8 and got.shape == picture.shape
    off = np.abs(got - expected(picture, primaries, gamma))
    # Next to black sRGB's curve is steep, and eight bits and the transform's own rounding show most.
    assert off.mean() < 0.6 and np.quantile(off, 0.99) < 2
    assert np.abs(got.astype(int) - picture).max() > 15  # it matters


@pytest.mark.parametrize("kind", ["own", "pillow"])
def test_pictures_that_are_srgb_stay_to_the_last_bit(kind: str) -> None:
    told = profile(SRGB) if kind == "own" else ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    picture = colours()
    assert to_srgb(picture, told) is picture
    assert to_srgb(picture, None) is picture


def test_alpha_is_left_alone() -> None:
    picture = np.dstack([colours(), colours()[..., 0]])
    got = to_srgb(picture, profile(P3))
    np.testing.assert_array_equal(got[..., 3], picture[..., 3])
    np.testing.assert_array_equal(got[..., :3], to_srgb(np.ascontiguousarray(picture[..., :3]), profile(P3)))


@given(st.binary(max_size=400), st.integers(0, 600), st.booleans())
@settings(max_examples=60, deadline=None)
def test_damaged_profiles_change_nothing_and_stop_nothing(noise: bytes, at: int, cut: bool) -> None:
    whole = profile(P3)
    damaged = whole[:at] + noise if cut else whole[:at] + noise + whole[at + len(noise) :]
    picture = colours(4, 5)
    assert to_srgb(picture, damaged).shape == picture.shape
    assert to_srgb(picture, noise).shape == picture.shape


def test_profiles_of_other_than_rgb_and_huge_ones_are_passed_over() -> None:
    picture = colours()
    lab = ImageCms.ImageCmsProfile(ImageCms.createProfile("LAB")).tobytes()
    assert to_srgb(picture, lab) is picture
    assert to_srgb(picture, profile(P3) + b"\0" * MOST_BYTES) is picture


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp", ".tif"])
def test_a_photo_is_read_as_srgb(tmp_path: Path, suffix: str) -> None:
    smooth = cv2.GaussianBlur(texture(60, 80), (0, 0), 3)
    smooth = np.clip((smooth.astype(np.float32) - 128) * 2 + [[[160, 110, 90]]], 0, 255).astype(np.uint8)
    path, plain = tmp_path / f"a{suffix}", tmp_path / f"b{suffix}"
    options = {"quality": 98} if suffix in (".jpg", ".webp") else {}
    Image.fromarray(smooth).save(path, icc_profile=profile(P3), **options)
    Image.fromarray(smooth).save(plain, **options)
    as_stored, got = load_image(Frame("b", plain)), load_image(Frame("a", path))
    np.testing.assert_array_equal(got, to_srgb(as_stored, profile(P3)))
    assert np.abs(got - expected(smooth, P3)).mean() < 2 < np.abs(got.astype(int) - smooth).mean()


def test_a_heif_photo_is_read_and_converted_as_srgb(tmp_path: Path) -> None:
    pillow_heif = pytest.importorskip("pillow_heif", reason="pillow-heif is not installed; make test brings it")
    pillow_heif.register_heif_opener()
    picture = np.zeros((64, 96, 3), np.uint8)
    picture[:, :48], picture[:, 48:] = (200, 60, 40), (60, 170, 90)
    path = tmp_path / "a.heic"
    Image.fromarray(picture).save(path, format="HEIF", quality=95, icc_profile=profile(P3))
    wanted = expected(picture, P3)
    inner = np.abs(wanted - picture).max(axis=2) > 0
    inner[:, 40:56] = False  # codecs blur an edge
    written = write_image(Frame("", path), tmp_path / "written")
    with Image.open(written) as jpeg:
        assert jpeg.info.get("icc_profile") is None
    for got in (load_image(Frame("a", path)), load_image(Frame("a", written))):
        assert np.abs(got - wanted)[inner].mean() < 2 < np.abs(got.astype(int) - picture)[inner].mean()


def with_colours_by_number(png: bytes, *numbers: int) -> bytes:
    """A PNG with a chunk cICP behind its first one."""
    chunk = b"cICP" + bytes(numbers)
    return png[:33] + struct.pack(">I", len(numbers)) + chunk + struct.pack(">I", zlib.crc32(chunk)) + png[33:]


@pytest.mark.parametrize(
    ("numbers", "primaries"), [((12, 13, 0, 1), P3), ((9, 1, 0, 1), BT2020), ((1, 13, 0, 1), SRGB), ((9, 16, 0, 1), SRGB)]
)
@pytest.mark.parametrize("profiled", [False, True])
def test_a_png_that_says_its_colours_by_number(
    tmp_path: Path, numbers: tuple[int, ...], primaries: tuple[tuple[float, float], ...], profiled: bool
) -> None:
    """They go before a profile, where they are known and of ordinary range."""
    picture, path = colours(), tmp_path / "a.png"
    told = io.BytesIO()
    Image.fromarray(picture).save(told, format="PNG", icc_profile=profile(ADOBE, 2.19921875) if profiled else None)
    path.write_bytes(with_colours_by_number(told.getvalue(), *numbers))
    wanted = expected(picture, primaries) if primaries is not SRGB or not profiled else expected(picture, ADOBE, 2.19921875)
    assert np.abs(load_image(Frame("a", path)) - wanted).max() <= 2


@given(st.binary(max_size=60), st.integers(0, 60))
def test_chunks_that_lie_about_their_length_stop_nothing(noise: bytes, at: int) -> None:
    whole = io.BytesIO()
    Image.fromarray(colours(2, 3)).save(whole, format="PNG")
    data = with_colours_by_number(whole.getvalue(), 12, 13, 0, 1)
    found = png_colours(data[:at] + noise + data[at + len(noise) :])
    assert found is None or found in (profile_of(9, 13), profile_of(12, 13))


@pytest.mark.parametrize(("number", "icc"), [(12, False), (1, False), (12, True)])
def test_a_heif_photo_that_says_its_colours_by_number(tmp_path: Path, number: int, icc: bool) -> None:
    """As phones write it without a profile; a profile goes before it."""
    pillow_heif = pytest.importorskip("pillow_heif", reason="pillow-heif is not installed; make test brings it")
    pillow_heif.register_heif_opener()
    picture, path = np.full((64, 64, 3), (200, 60, 40), np.uint8), tmp_path / "a.heic"
    codes = {"color_primaries": number, "transfer_characteristics": 13, "matrix_coefficients": 6, "full_range_flag": 1}
    more = {"icc_profile": profile(SRGB)} if icc else {}
    Image.fromarray(picture).save(path, format="HEIF", quality=95, **codes, **more)
    wanted = expected(picture, P3 if number == 12 and not icc else SRGB)
    assert np.abs(load_image(Frame("a", path)) - wanted).mean() < 2


def test_grey_photos_with_a_profile_and_masks_stay_as_they_are(tmp_path: Path) -> None:
    grey = texture(20, 30)[..., 0]
    Image.fromarray(grey).save(tmp_path / "a.jpg", quality=100, icc_profile=profile(P3))
    got = load_image(Frame("a", tmp_path / "a.jpg"))
    assert np.abs(got.astype(int) - grey[..., None]).max() <= 3
    mask = np.zeros((6, 7, 3), np.uint8)
    mask[2:4, 3:] = (255, 0, 0)
    Image.fromarray(mask).save(tmp_path / "m.png", icc_profile=profile(P3))
    seen = load_mask(Frame("a", tmp_path / "a.jpg", mask=tmp_path / "m.png"))
    assert seen is not None and seen.sum() == 8
