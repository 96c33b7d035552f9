"""HEIF pictures (`.heic`): what iPhones, and many other phones, write unless they are told otherwise.

OpenCV does not read them, pillow-heif does. It is asked for when the first such picture comes, so that all else works without it.
"""

from __future__ import annotations

import io
import warnings
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from fieldfuse.camera import Array
from fieldfuse.errors import InputError

SUFFIXES = (".heic", ".heif", ".hif")
FORMAT = "HEIF"  # Pillow's name for it
BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"hevm", b"hevs", b"mif1", b"msf1", b"mif2")  # ISO/IEC 23008-12, annex B
HEAD = 12  # bytes that tell


def is_heif(head: bytes) -> bool:
    """Whether a file that begins with `head` (`HEAD` bytes or more) is HEIF, whatever its name says."""
    return head[4:8] == b"ftyp" and head[8:12] in BRANDS


def file_is_heif(path: Path) -> bool:
    """The same of a file; False also for one that cannot be read, which whoever reads it will tell."""
    try:
        with path.open("rb") as file:
            return is_heif(file.read(HEAD))
    except OSError:
        return False


def register(path: Path) -> None:
    """Let Pillow read HEIF, of which `path` is the first.

    Raises:
        InputError: pillow-heif is not installed.
    """
    try:
        from pillow_heif import register_heif_opener
    except ImportError as error:
        raise InputError(
            f"{path} is a HEIF picture (.heic), which needs the package pillow-heif; install it (pip install pillow-heif), "
            "or convert the pictures to JPEG"
        ) from error
    register_heif_opener()


def decode(data: bytes, path: Path) -> Array:
    """The picture as it is to be seen (turns and mirrors that the file asks for are done), (H, W), (H, W, 3) or (H, W, 4) uint8, BGR(A).

    Ten and twelve bits become eight.

    Raises:
        InputError: it cannot be decoded, or pillow-heif is not installed.
    """
    register(path)
    import pillow_heif

    try:
        return np.array(pillow_heif.open_heif(data, bgr_mode=True, convert_hdr_to_8bit=True))
    except Exception as error:  # damaged files raise many families, IndexError among them
        raise _damaged(path) from error


def small(data: bytes, side: int, path: Path) -> Array:
    """The picture in grey, (h, w) uint8, at least `side` pixels along the long side if it has them: the small copy of itself that
    phones put into the file when there is one that large, else the whole.

    Raises:
        InputError: it cannot be decoded, or pillow-heif is not installed.
    """
    register(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # large photos are welcome
            picture = Image.open(io.BytesIO(data))
        with picture:
            factor = min(1.0, side / max(picture.size))
            picture.draft("RGB", (round(picture.width * factor), round(picture.height * factor)))
            return np.asarray(cv2.cvtColor(np.asarray(picture.convert("RGB")), cv2.COLOR_RGB2GRAY))
    except Exception as error:  # damaged files raise many families, IndexError among them
        raise _damaged(path) from error


def complete(data: bytes) -> bool:
    """Whether all boxes that the file announces lie within it."""
    position = 0
    while position + 8 <= len(data):  # ISO/IEC 14496-12, 4.2
        size = int.from_bytes(data[position : position + 4], "big")
        if size == 1:
            size = int.from_bytes(data[position + 8 : position + 16], "big")
        elif size == 0:  # up to the end, wherever that is
            return True
        position += max(size, 8)
    return position <= len(data)


def _damaged(path: Path) -> InputError:
    return InputError(f"the picture {path} (HEIF) is damaged or of a kind that cannot be decoded; copy it again or convert it to JPEG")
