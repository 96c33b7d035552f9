"""Sizes of images by their headers, and whether a camera's intrinsics fit them."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from fieldfuse.camera import Intrinsics
from fieldfuse.capture import heif
from fieldfuse.capture.headers import NOT_EXR, orientation_of
from fieldfuse.capture.poses import reads_leniently
from fieldfuse.capture.tiff import read_tiff
from fieldfuse.errors import InputError

LYING = 5  # EXIF orientations from here on turn by 90°
TIFFS = (".tif", ".tiff")


@dataclass(frozen=True)
class ImageHeader:
    """What a picture's header tells, as stored: EXIF orientation is not applied."""

    width: int
    height: int
    alpha: bool

    @property
    def size(self) -> tuple[int, int]:
        return self.width, self.height


UNREADABLE = ImageHeader(0, 0, False)  # of a file that cannot be read, while a capture is: the first look at all images leaves it out


def picture_header(path: Path) -> ImageHeader:
    """Size and alpha of a picture (or the shape of a 2-D `.npy`); nothing is decoded. While a capture is read, a file that cannot be read
    is `UNREADABLE`: whether that refuses the capture is decided when all are known.

    Raises:
        InputError: not a picture that can be read.
    """
    if heif.file_is_heif(path):
        heif.register(path)
    if path.suffix.lower() == ".exr":
        raise InputError(f"{path} {NOT_EXR}")
    try:
        if path.suffix.lower() == ".npy":
            height, width = np.load(path, mmap_mode="r", allow_pickle=False).shape[:2]
            return ImageHeader(int(width), int(height), False)
        if path.suffix.lower() in TIFFS and (tiff := read_tiff(path.read_bytes())) is not None:
            return ImageHeader(tiff.width, tiff.height, tiff.alpha)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # only the header is read; large photos are welcome
            picture = Image.open(path)
        with picture:
            width, height = picture.size
            return ImageHeader(width, height, picture.mode in ("RGBA", "LA", "PA", "RGBa", "La") or "transparency" in picture.info)
    except Exception as error:  # Pillow's and NumPy's parsers raise many families on broken files
        if reads_leniently():
            return UNREADABLE
        raise InputError(f"{path} cannot be read as a picture; remove it or replace it") from error


def first_size(paths: Sequence[Path]) -> tuple[int, int]:
    """Size (width, height) of the first picture that can be read.

    Raises:
        InputError: none of them can.
    """
    size = next((size for path in paths if (size := picture_header(path).size) != UNREADABLE.size), None)
    if size is None:
        raise InputError(f"{paths[0]} cannot be read as a picture, and neither can the others beside it; check how they were written")
    return size


def size_of(path: Path, others: Sequence[Path]) -> tuple[int, int]:
    """Size (width, height) of a picture; where it cannot be read, that of the first of the `others` that can.

    Raises:
        InputError: none of them can.
    """
    size = picture_header(path).size
    return first_size(others) if size == UNREADABLE.size else size


def fits_shape(intrinsics: Intrinsics, size: tuple[int, int]) -> bool:
    """Whether a picture of `size` (width, height) may be the camera's, made smaller or larger."""
    width, height = size
    return abs(intrinsics.height * width / intrinsics.width - height) <= max(2.0, 0.005 * height)


def fitted(intrinsics: Intrinsics, size: tuple[int, int], where: str, image: Path | None = None) -> Intrinsics:
    """The camera for a picture of `size` (width, height): itself, or scaled when the aspect ratio agrees.

    Args:
        image: a file whose EXIF orientation may turn it by 90° into the camera's shape; then the camera is that of the upright image.

    Raises:
        InputError: the picture has another shape (cropped, or turned).
    """
    width, height = size
    if (width, height) in ((intrinsics.width, intrinsics.height), UNREADABLE.size):
        return intrinsics
    if not fits_shape(intrinsics, size):
        if image is not None and fits_shape(intrinsics, (height, width)) and orientation_of(image) >= LYING:
            return fitted(intrinsics, (height, width), where)
        raise InputError(
            f"{where}: the picture is {width}×{height} but its intrinsics are for "
            f"{intrinsics.width}×{intrinsics.height}, which is another shape; "
            "give pictures that are neither cropped nor turned, or correct the intrinsics"
        )
    return intrinsics.scaled(width, height)
