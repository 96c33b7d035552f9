"""HEIF images (`.heic`), as phones write them. OpenCV does not read them, pillow-heif does; it is imported with the first such image."""

from __future__ import annotations

import io
import warnings
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from fieldfuse.camera import Array
from fieldfuse.errors import InputError
from fieldfuse.extras import extra

SUFFIXES = (".heic", ".heif", ".hif")
FORMAT = "HEIF"  # Pillow's name for it
BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"hevm", b"hevs", b"mif1", b"msf1", b"mif2")  # ISO/IEC 23008-12, annex B


def is_heif(head: bytes) -> bool:
    """Whether a file that begins with `head` (12 bytes or more) is HEIF, whatever its name."""
    return head[4:8] == b"ftyp" and head[8:12] in BRANDS


def file_is_heif(path: Path) -> bool:
    """The same of a file; False also for one that cannot be read, which is reported where it is decoded."""
    try:
        with path.open("rb") as file:
            return is_heif(file.read(12))
    except OSError:
        return False


def register(path: Path) -> None:
    """Let Pillow read HEIF, of which `path` is the first."""
    package = extra("heic", "pillow_heif", f"{path} is a HEIF image (.heic), which", ", or convert the images to JPEG")
    package.register_heif_opener()


def decode(data: bytes, path: Path) -> Array:
    """(H, W), (H, W, 3) or (H, W, 4) uint8, BGR(A), turned as the file has it; ten and twelve bits become eight."""
    register(path)
    import pillow_heif

    try:
        return np.array(pillow_heif.open_heif(data, bgr_mode=True, convert_hdr_to_8bit=True))
    except Exception as error:  # damaged files raise many families, IndexError among them
        raise _damaged(path) from error


def small(data: bytes, side: int, path: Path) -> Array:
    """(h, w) uint8 grey, at least `side` pixels along the long side if the image has them: its embedded thumbnail if that is large enough.
    """
    register(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # large photos are welcome
            image = Image.open(io.BytesIO(data))
        with image:
            factor = min(1.0, side / max(image.size))
            image.draft("RGB", (round(image.width * factor), round(image.height * factor)))
            return np.asarray(cv2.cvtColor(np.asarray(image.convert("RGB")), cv2.COLOR_RGB2GRAY))
    except Exception as error:
        raise _damaged(path) from error


def _damaged(path: Path) -> InputError:
    return InputError(f"the image {path} (HEIF) is damaged or of a kind that cannot be decoded; copy it again or convert it to JPEG")
