"""Headers of image files: format, size, EXIF orientation, colour profile, and whether the file is whole, before anything is decoded."""

from __future__ import annotations

import io
import struct
import threading
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from PIL import Image, UnidentifiedImageError
from PIL.TiffImagePlugin import ImageFileDirectory_v2

from fieldfuse.capture import exr, heif, raw
from fieldfuse.capture.colours import png_colours, profile_of
from fieldfuse.capture.poses import reads_leniently
from fieldfuse.errors import InputError

MAX_PIXELS = 200_000_000
LYING = 5  # EXIF orientations from here on turn by 90°
TIFFS = (".tif", ".tiff")
WIDTH, HEIGHT, BITS, ORIENTATION, MAXIMUM, EXTRA, SAMPLE_FORMAT, PROFILE = 256, 257, 258, 274, 281, 338, 339, 34675  # tags of TIFF 6.0
_pillow_limit = threading.Lock()


@dataclass(frozen=True)
class Header:
    """An image as stored, before any EXIF turn (HEIF, camera raw: as it is seen)."""

    width: int
    height: int
    format: str  # Pillow's name for it
    orientation: int = 1  # by EXIF; 1: as stored
    profile: bytes | None = None  # ICC, of its colours
    deep: bool = False  # more than 8 bits a channel
    white: int | None = None  # the largest value that a channel has, where the file gives it
    floating: bool = False  # channels are floating-point numbers
    alpha: bool = False

    @property
    def size(self) -> tuple[int, int]:
        return self.width, self.height


UNREADABLE = Header(0, 0, "")  # of a file that cannot be read, while a capture is: the first look at all images excludes it


def read_header(data: bytes, path: Path) -> Header:
    """The header of the image in `data` (of the file `path`).

    Raises:
        InputError: not an image, more than `MAX_PIXELS` pixels, the file ends before the image does, or pillow-heif is not installed.
    """
    cut_short = InputError(f"the image {path} is cut short (the file ends before the image does); copy it again or remove it")
    if raw.is_raw(path):
        return _within_limits(Header(*raw.raw_size(data, path), raw.FORMAT, deep=True), path)
    if heif.is_heif(data):
        heif.register(path)
    if heif.is_heif(data) or data[4:12] in (b"ftypavif", b"ftypavis"):
        end = end_of_boxes(io.BytesIO(data), len(data))
        if end is not None and end > len(data):
            raise cut_short
    if data[:4] == exr.MAGIC:
        return _within_limits(_of_exr(exr.exr_header(data, path)), path)
    header = read_tiff(data)
    try:
        # Pillow's own limit is lower than ours and global; it is lifted for the header only, and ours is applied below.
        with _pillow_limit, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
            try:
                with Image.open(io.BytesIO(unturned(data))) as image:
                    kind, deep = image.format or "", image.mode.startswith("I") or (image.format == "PNG" and data[24:25] == b"\x10")
                    if header is None:
                        header = Header(*image.size, kind, _orientation(image), _profile(image, data), deep)
            finally:
                Image.MAX_IMAGE_PIXELS = limit
    except UnidentifiedImageError as error:
        if header is None:  # Pillow reads no TIFF of 32-bit floating-point colours
            raise InputError(f"{path} is not an image that can be read; convert it to JPEG or PNG, or remove it") from error
    except Exception as error:  # Pillow's parsers raise many families on damaged headers
        raise InputError(f"the header of the image {path} is damaged; copy it again or remove it") from error
    if not _complete(data, _within_limits(header, path).format):
        raise cut_short
    return header


def _within_limits(header: Header, path: Path) -> Header:
    width, height = header.size
    if width * height > MAX_PIXELS:
        most = f"{MAX_PIXELS // 10**6} megapixels"
        raise InputError(f"the image {path} has {width}×{height} pixels, more than the {most} that are read; make it smaller")
    if width < 1 or height < 1:
        raise InputError(f"the image {path} has no pixels ({width}×{height}); remove it")
    return header


def _of_exr(found: exr.ExrHeader) -> Header:
    return Header(*found.size, exr.FORMAT, deep=True, floating=True, alpha="a" in found.names)


def image_header(path: Path) -> Header:
    """Size and alpha of an image (or the shape of a 2-D `.npy`), with little of the file read. While a capture is read, a file that
    cannot be read is `UNREADABLE`: whether that refuses the capture is decided when all are known.

    Raises:
        InputError: not an image that can be read.
    """
    if heif.file_is_heif(path):
        heif.register(path)
    suffix = path.suffix.lower()
    if suffix == exr.SUFFIX:
        exr.package(path)
    if raw.is_raw(path):
        raw.package(path)
    try:
        if suffix == exr.SUFFIX:
            return _of_exr(exr.exr_head(path))
        if raw.is_raw(path):
            return Header(*raw.raw_size(path.read_bytes(), path), raw.FORMAT, deep=True)
        if suffix == ".npy":
            height, width = np.load(path, mmap_mode="r", allow_pickle=False).shape[:2]
            return Header(int(width), int(height), "NPY")
        if suffix in TIFFS and (tiff := read_tiff(path.read_bytes())) is not None:
            return tiff
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # only the header is read; large photos are welcome
            image = Image.open(path)
        with image:
            alpha = image.mode in ("RGBA", "LA", "PA", "RGBa", "La") or "transparency" in image.info
            return Header(*image.size, image.format or "", alpha=alpha)
    except Exception as error:  # Pillow's and NumPy's parsers raise many families on broken files
        if reads_leniently():
            return UNREADABLE
        raise InputError(f"{path} cannot be read as an image; remove it or replace it") from error


def image_size(path: Path, others: Sequence[Path] = ()) -> tuple[int, int]:
    """Size (width, height) of an image; where it cannot be read, that of the first of the `others` that can."""
    sizes = (image_header(one).size for one in (path, *others))
    size = next((size for size in sizes if size != UNREADABLE.size), None)
    if size is None:
        raise InputError(f"{path} cannot be read as an image, and neither can the others beside it; check how they were written")
    return size


def orientation_of(path: Path) -> int:
    """The EXIF orientation of an image file, with only its header read. 1 also for HEIF and camera raw, which are decoded upright, and for
    a file that cannot be read, which is reported where it is decoded."""
    if heif.file_is_heif(path) or raw.is_raw(path):
        return 1
    try:
        if path.suffix.lower() in TIFFS and (tiff := read_tiff(path.read_bytes())) is not None:
            return tiff.orientation
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(path) as image:
                # Of a PNG, Pillow looks behind the pixels, and decodes them for that; with this it does where there is something to find.
                found = image.format != "PNG" or b"exif" in path.read_bytes().lower()
                return _orientation(image) if found else 1
    except Exception:  # Pillow's parsers raise many families on damaged headers
        return 1


def _orientation(image: Image.Image) -> int:
    try:
        value = int(image.getexif().get(ORIENTATION, 1))
    except Exception:  # damaged EXIF raises about anything, and an image is usable without it
        return 1
    return value if 1 <= value <= 8 else 1


def _profile(image: Image.Image, data: bytes) -> bytes | None:
    icc = image.info.get("icc_profile")
    icc = icc if isinstance(icc, bytes) and icc else None
    if image.format == "PNG":
        return png_colours(data) or icc
    box = image.info.get("nclx_profile")
    return icc or (profile_of(box.get("color_primaries"), box.get("transfer_characteristics")) if isinstance(box, dict) else None)


# ------------------------------------------------------------------------------------------------ TIFF


def read_tiff(data: bytes) -> Header | None:
    """The first image of a TIFF; None where it is damaged, or there is none."""
    found = _directory(data)
    if found is None:
        return None

    def values(tag: int) -> tuple[int, ...]:
        value = found[0].get(tag, ())
        return tuple(int(one) for one in value) if isinstance(value, tuple) else (int(value),)

    try:
        bits, orientation, most, profile = values(BITS), values(ORIENTATION), values(MAXIMUM), found[0].get(PROFILE)
        return Header(
            values(WIDTH)[0],
            values(HEIGHT)[0],
            "TIFF",
            orientation[0] if orientation and 1 <= orientation[0] <= 8 else 1,
            profile if isinstance(profile, bytes) else None,
            max(bits, default=1) > 8,
            max(most) if most else None,
            3 in values(SAMPLE_FORMAT),
            any(kind in (1, 2) for kind in values(EXTRA)),
        )
    except Exception:  # Pillow decodes values on access, and raises many families on damaged ones
        return None


def unturned(data: bytes) -> bytes:
    """The file with its orientation removed if it is a TIFF: Pillow and OpenCV turn these, whatever the flags."""
    header = read_tiff(data)
    found = _directory(data)
    if header is None or found is None or header.orientation == 1:
        return data
    order, big = ("<" if data[:2] == b"II" else ">"), data[2:4] == b"+\0"
    at = data.find(struct.pack(order + ("HHQ" if big else "HHI"), ORIENTATION, 3, 1), found[1])
    if at < 0:
        return data
    at += 12 if big else 8
    return data[:at] + struct.pack(order + "H", 1) + data[at + 2 :]


def _directory(data: bytes) -> tuple[ImageFileDirectory_v2, int] | None:
    """The first directory of a TIFF and where it begins; None where the file is another, or damaged."""
    if data[:4] not in (b"II*\0", b"MM\0*", b"II+\0"):
        return None
    stream = io.BytesIO(data)
    try:
        directory = ImageFileDirectory_v2(stream.read(16 if data[2:4] == b"+\0" else 8))
        at = int(directory.next)
        stream.seek(at)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            directory.load(stream)
    except Exception:  # Pillow's parsers raise many families on damaged files
        return None
    return directory, at


# ------------------------------------------------------------------------------------------------ is the file whole


def _complete(data: bytes, kind: str) -> bool:
    if kind in ("JPEG", "MPO"):
        return _jpeg_ends(data)
    if kind == "PNG":
        return data.rfind(b"IEND") > 0
    if kind == "WEBP":
        return len(data) >= 8 + int.from_bytes(data[4:8], "little")
    return True  # other decoders notice by themselves


def _jpeg_ends(data: bytes) -> bool:
    """Whether an end-of-image marker follows the image's own data (ITU T.81, B.1.1).

    Segments are walked up to the first scan, because EXIF holds a thumbnail with an end marker of its own. Bytes behind the
    marker (motion photos, padding) are allowed.
    """
    position = 2
    while position + 4 <= len(data):
        if data[position] != 0xFF:
            return False
        marker = data[position + 1]
        if marker == 0xFF:  # fill byte
            position += 1
        elif marker == 0xDA:  # start of scan: in what follows, FF is always stuffed, so FF D9 can only be the end
            return data.find(b"\xff\xd9", position) > 0
        elif marker == 0x01 or 0xD0 <= marker <= 0xD7:  # markers without a length
            position += 2
        else:
            position += 2 + int.from_bytes(data[position + 2 : position + 4], "big")
    return False


def end_of_boxes(file: BinaryIO, size: int) -> int | None:
    """Where the last box of an ISO base media file (mp4, mov, HEIF, AVIF) ends by its own word (ISO/IEC 14496-12, 4.2); None: it has none.

    A box has a 32-bit size, a type, and a 64-bit size when the first is 1.
    """
    position = 0
    while position + 8 <= size:
        file.seek(position)
        header = file.read(16)
        length = int.from_bytes(header[:4], "big")
        if length == 1 and len(header) == 16:
            length = int.from_bytes(header[8:16], "big")
        if length < 8 or not header[4:8].isascii():  # "to the end of the file", padding or junk behind the last box
            return None
        position += length
    return position
