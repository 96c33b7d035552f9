"""What the header of a picture file says, and whether the file is whole, before anything is decoded."""

from __future__ import annotations

import io
import threading
import warnings
from dataclasses import dataclass
from pathlib import Path

from PIL import Image, UnidentifiedImageError

from fieldfuse.capture import heif
from fieldfuse.capture.archive import read_member
from fieldfuse.capture.primaries import heif_colours, png_colours
from fieldfuse.capture.tiff import Tiff, is_tiff, read_tiff, unturned
from fieldfuse.errors import InputError

MAX_PIXELS = 200_000_000
PANORAMA = "360° panoramas (equirectangular) are not read; cut each into perspective views first, and give these"
XMP_WITHIN = 2**18  # bytes of a file's beginning in which its XMP stands
PNG_BITS = 24  # where a PNG's bit depth stands
EXR = b"\x76\x2f\x31\x01"
NOT_EXR = "is OpenEXR, which is not read; write depth as 16-bit PNG in millimetres or as float .npy, and images as PNG or TIFF"
_ORIENTATION = 0x0112  # EXIF tag, 1 to 8
_pillow_limit = threading.Lock()


@dataclass(frozen=True)
class Header:
    """Stored size (before any EXIF turn; of HEIF as it is seen), file format in Pillow's name for it, EXIF orientation (1: as stored), and
    the ICC profile of its colours, if it says what they are."""

    width: int
    height: int
    format: str
    orientation: int
    profile: bytes | None = None
    deep: bool = False  # more than 8 bits a channel
    white: int | None = None  # the largest value that a channel has, where the file says so
    floating: bool = False  # channels are floating-point numbers


def read_bytes(path: Path) -> bytes:
    """The whole file, which may be a zip file's member (see `archive`).

    Raises:
        InputError: missing, unreadable or empty.
    """
    try:
        data = Path(path).read_bytes()
    except NotADirectoryError:
        data = read_member(Path(path))
    except OSError as error:
        raise InputError(f"cannot read the picture {path}: {error.strerror or error}") from error
    if not data:
        raise InputError(f"the picture {path} is empty (0 bytes); copy it again or remove it")
    return data


def read_header(data: bytes, path: Path) -> Header:
    """Size, format and orientation of the picture in `data` (of the file `path`), with nothing decoded.

    Raises:
        InputError: not a picture, more than `MAX_PIXELS` pixels, the file ends before the picture does, or what reads HEIF is not there.
    """
    if heif.is_heif(data):
        heif.register(path)
    if (heif.is_heif(data) or is_avif(data)) and not heif.complete(data):
        raise _cut_short(path)
    if data[:4] == EXR:
        raise InputError(f"{path} {NOT_EXR}")
    tiff = read_tiff(data) if is_tiff(data) else None
    try:
        # Pillow's own limit is lower than ours and global; it is lifted for the header only, and ours is applied below.
        with _pillow_limit, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
            try:
                with Image.open(io.BytesIO(unturned(data))) as picture:
                    width, height = picture.size
                    kind = picture.format or ""
                    orientation = _orientation(picture) if tiff is None else tiff.orientation
                    profile = _profile(picture, data)
                    deep = picture.mode.startswith("I") or (tiff is not None and tiff.bits > 8)
            finally:
                Image.MAX_IMAGE_PIXELS = limit
    except UnidentifiedImageError as error:
        if tiff is not None:
            return _of_tiff(tiff, path)
        raise InputError(f"{path} is not a picture that can be read; convert it to JPEG or PNG, or remove it") from error
    except Exception as error:  # Pillow's parsers raise many families on damaged headers
        raise InputError(f"the header of the picture {path} is damaged; copy it again or remove it") from error
    _check_size(width, height, path)
    if not _complete(data, kind):
        raise _cut_short(path)
    deep = deep or (kind == "PNG" and len(data) > PNG_BITS and data[PNG_BITS] == 16)
    white, floating = (None, False) if tiff is None else (tiff.maximum, tiff.floating)
    return Header(width, height, kind, orientation, profile, deep, white, floating)


def is_panorama(data: bytes, header: Header, posed: bool) -> bool:
    """Whether the file says that its image is equirectangular (Google's photo sphere XMP). Of `posed` images those alone are such that are
    twice as wide as high: views that were cut out of a panorama may have kept its XMP."""
    head = data[:XMP_WITHIN]
    return b"GPano:" in head and b"equirectangular" in head and (not posed or header.width == 2 * header.height)


def is_avif(data: bytes) -> bool:
    return data[4:8] == b"ftyp" and data[8:12] in (b"avif", b"avis")


def _of_tiff(tiff: Tiff, path: Path) -> Header:
    """Of a TIFF that Pillow does not know, as those with 32-bit floating-point colours."""
    _check_size(tiff.width, tiff.height, path)
    return Header(tiff.width, tiff.height, "TIFF", tiff.orientation, tiff.profile, tiff.bits > 8, tiff.maximum, tiff.floating)


def _check_size(width: int, height: int, path: Path) -> None:
    if width * height > MAX_PIXELS:
        raise InputError(
            f"the picture {path} has {width}×{height} pixels, more than the {MAX_PIXELS // 10**6} megapixels that are read; make it smaller"
        )
    if width < 1 or height < 1:
        raise InputError(f"the picture {path} has no pixels ({width}×{height}); remove it")


def orientation_of(path: Path) -> int:
    """The EXIF orientation by which the picture in a file is to be turned, with only its header read. 1 also for HEIF, which is decoded as
    it is to be seen, and for a file that cannot be read, which whoever reads it will tell."""
    if heif.file_is_heif(path):
        return 1
    try:
        if path.suffix.lower() in (".tif", ".tiff") and (tiff := read_tiff(path.read_bytes())) is not None:
            return tiff.orientation
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(path) as picture:
                # Of a PNG, Pillow looks behind the pixels, and decodes them for that; with this it does where there is something to find.
                found = picture.format != "PNG" or b"exif" in path.read_bytes().lower()
                return _orientation(picture) if found else 1
    except Exception:  # Pillow's parsers raise many families on damaged headers
        return 1


def _cut_short(path: Path) -> InputError:
    return InputError(f"the picture {path} is cut short (the file ends before the picture does); copy it again or remove it")


def _profile(picture: Image.Image, data: bytes) -> bytes | None:
    """Of its colours: in an ICC profile, or by number, which PNG's chunk says before the profile and HEIF's box after it."""
    icc = picture.info.get("icc_profile")
    icc = icc if isinstance(icc, bytes) and icc else None
    if picture.format == "PNG":
        return png_colours(data) or icc
    return icc or heif_colours(picture.info.get("nclx_profile"))


def _orientation(picture: Image.Image) -> int:
    try:
        value = int(picture.getexif().get(_ORIENTATION, 1))
    except Exception:  # damaged EXIF raises about anything, and a picture is usable without it
        return 1
    return value if 1 <= value <= 8 else 1


def _complete(data: bytes, kind: str) -> bool:
    if kind in ("JPEG", "MPO"):
        return _jpeg_ends(data)
    if kind == "PNG":
        return data.rfind(b"IEND") > 0
    if kind == "WEBP":
        return len(data) >= 8 + int.from_bytes(data[4:8], "little")
    return True  # other decoders notice by themselves


def _jpeg_ends(data: bytes) -> bool:
    """Whether an end-of-image marker follows the picture's own data (ITU T.81, B.1.1).

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
