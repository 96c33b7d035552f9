"""Camera raw files, developed by LibRaw through the package rawpy (MIT; LibRaw: LGPL-2.1 or CDDL), imported with the first of them.

A raw file is what the sensor counted, and a program's choices make a picture of it. Here all images of a capture are developed alike, so
that one surface has one colour in all of them: the same white balance, no automatic brightness, no adjustment to an image's own range.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from fieldfuse.camera import Array
from fieldfuse.errors import InputError
from fieldfuse.extras import extra

SUFFIXES = (".dng", ".cr2", ".cr3", ".nef", ".nrw", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw")
FORMAT = "RAW"
Balance = tuple[float, float, float]  # what red, green and blue are multiplied by; green: 1


def is_raw(path: Path) -> bool:
    """By its name: many of them are TIFF files by their first bytes, and hold a small picture as one."""
    return path.suffix.lower() in SUFFIXES


def raw_size(data: bytes, path: Path) -> tuple[int, int]:
    """Width and height of the image as it is seen: turned as the camera was held.

    Raises:
        InputError: no raw file that LibRaw knows, or the package rawpy is not installed.
    """
    with _opened(data, path) as file:
        sizes = file.sizes
        return (sizes.height, sizes.width) if sizes.flip in (5, 6) else (sizes.width, sizes.height)


def camera_balance(data: bytes, path: Path) -> Balance | None:
    """The white balance that the camera chose, else that of daylight; None where the file has neither."""
    with _opened(data, path) as file:
        for found in (file.camera_whitebalance, file.daylight_whitebalance):
            red, green, blue = (float(value) for value in found[:3])
            if min(red, green, blue) > 0 and np.isfinite([red, green, blue]).all() and max(red, blue) < 20 * green:
                return red / green, 1.0, blue / green
    return None


def develop(data: bytes, path: Path, balance: Balance | None = None, *, small: bool = False) -> Array:
    """(H, W, 3) uint16 BGR, upright: linear light in sRGB's primaries, 65535 where the sensor was full in some channel.

    Args:
        balance: None: the camera's own.
        small: at half the size, ten times as fast.

    Raises:
        InputError: as `raw_size`, or it is damaged.
    """
    red, green, blue = balance or camera_balance(data, path) or (1.0, 1.0, 1.0)
    with _opened(data, path) as file:
        import rawpy

        rgb = file.postprocess(
            user_wb=[red, green, blue, green],
            no_auto_bright=True,
            adjust_maximum_thr=0.0,  # else white would be moved to an image's own largest value
            gamma=(1, 1),
            output_bps=16,
            output_color=rawpy.ColorSpace.sRGB,
            highlight_mode=rawpy.HighlightMode.Clip,
            half_size=small,
        )
    if rgb.ndim != 3 or rgb.shape[2] != 3:
        raise InputError(f"the raw file {path} does not develop to three colours; make a TIFF or JPEG of it by another program")
    return np.ascontiguousarray(rgb[..., ::-1])


def exif_of(path: Path) -> Image.Exif:
    """EXIF of a raw file that is TIFF inside (DNG, CR2, NEF, ARW, PEF, SRW, …); of others empty."""
    exif = Image.Exif()
    exif.load(b"Exif\0\0" + path.read_bytes())
    return exif


def package(path: Path) -> Any:
    """The package that develops raw files, for `path`."""
    return extra("raw", "rawpy", f"{path} is a camera raw file, which", ", or develop the photos to JPEG, all in the same way")


@contextmanager
def _opened(data: bytes, path: Path) -> Iterator[Any]:
    rawpy = package(path)
    try:
        with rawpy.imread(io.BytesIO(data)) as file:
            yield file
    except InputError:
        raise
    except Exception as error:  # LibRaw's errors, and what a broken header makes of memory
        raise InputError(
            f"the raw file {path} is damaged, or of a camera that LibRaw {'.'.join(map(str, rawpy.libraw_version))} does not know; copy it "
            "again, or develop it to TIFF or JPEG by another program"
        ) from error
