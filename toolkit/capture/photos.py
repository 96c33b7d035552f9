"""A folder of photos. Poses are unknown; a focal length in pixels comes from EXIF where a photo has one.

EXIF orientation: `images.load_image` turns pictures upright for this kind only, never for captures that bring poses (their
intrinsics are for the stored pixels). The focal length in pixels is the same either way, so nothing about it is carried here.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

from PIL import Image

from toolkit.capture.heif import SUFFIXES as HEIF_SUFFIXES
from toolkit.capture.listing import assemble, counted, picture_header, pictures_in, require_folder, unique_names
from toolkit.capture.types import Capture, Frame
from toolkit.errors import InputError
from toolkit.files import require_utf8

FOLDERS = (".", "images", "input")
FILM_DIAGONAL = math.hypot(36.0, 24.0)  # mm
EXIF_FOLDER = 0x8769
FOCAL_LENGTH, FOCAL_LENGTH_35 = 0x920A, 0xA405
PLANE_X_RESOLUTION, PLANE_UNIT, STORED_WIDTH, STORED_HEIGHT = 0xA20E, 0xA210, 0xA002, 0xA003
PLANE_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}


def looks_like_photos(path: Path) -> bool:
    return any(pictures_in(path / folder) for folder in FOLDERS)


def photo_files(root: Path) -> list[Path]:
    """The pictures of whichever of `FOLDERS` holds most."""
    return max((pictures_in(root / folder) for folder in FOLDERS), key=len)


def read_photos(path: Path | str) -> Capture:
    """Photos directly in the folder, or in its `images/` or `input/` (whichever holds most).

    Raises:
        InputError: missing or empty folder, no photo, or a file that is not a picture.
    """
    root = require_folder(path)
    pictures = photo_files(root)
    if not pictures:
        raise InputError(f"no photo (jpg, heic, png, webp, bmp, tif) was found in {root}; give the folder that holds them")
    for picture in pictures:
        require_utf8(picture)
    pictures, remarks = _once_each(pictures)
    frames = [
        Frame(name=name, image=picture, focal_prior=focal_from_exif(picture))
        for name, picture in zip(unique_names(pictures), pictures, strict=True)
    ]
    return assemble("photos", root, frames, remarks)


def with_unposed(capture: Capture) -> Capture:
    """The capture with those images beside its own, in the same folders, that have no poses: whoever finds poses anew can use them."""
    if not capture.extra.get("unregistered"):
        return capture
    own = {frame.image for frame in capture.frames}
    beside = [path for folder in sorted({path.parent for path in own}) for path in pictures_in(folder) if path not in own]
    images = [*(frame.image for frame in capture.frames), *beside]
    frames = [*capture.frames, *(Frame(name="", image=path, focal_prior=focal_from_exif(path)) for path in beside)]
    named = [replace(frame, name=name) for frame, name in zip(frames, unique_names(images), strict=True)]
    remarks = [text for text in capture.warnings if not text.endswith("are not in the model and are left out")]
    whole = assemble(capture.kind, capture.root, named, remarks, alpha=capture.alpha)
    return replace(capture, frames=whole.frames, warnings=whole.warnings, extra={**capture.extra, "unregistered": 0})


def _once_each(pictures: list[Path]) -> tuple[list[Path], list[str]]:
    """The pictures without those `.heic` that lie beside another picture of their name, as phones and programs leave them that convert
    them: a photo that is there twice would be fitted and held out at once."""
    others = {picture.stem for picture in pictures if picture.suffix.lower() not in HEIF_SUFFIXES}
    kept = [picture for picture in pictures if picture.suffix.lower() not in HEIF_SUFFIXES or picture.stem not in others]
    double = len(pictures) - len(kept)
    if not double:
        return kept, []
    return kept, [f"{counted(double, 'picture is', 'pictures are')} there as HEIC and in another format; the latter is used"]


def focal_from_exif(path: Path) -> float | None:
    """The focal length in pixels of the stored picture, or None when EXIF does not tell a believable one.

    From the 35 mm equivalent (which compares diagonals), else from the focal length and the sensor's resolution.

    Raises:
        InputError: the file is not a picture.
    """
    width, height = picture_header(path).size
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow remarks on size and on every oddity of EXIF
            with Image.open(path) as picture:
                exif = dict(picture.getexif().get_ifd(EXIF_FOLDER))
    except Exception:  # broken metadata in a good picture; Pillow raises many families
        return None
    equivalent = _positive(exif.get(FOCAL_LENGTH_35))
    focal: float | None = None
    if equivalent:
        focal = equivalent / FILM_DIAGONAL * math.hypot(width, height)
    else:
        length, resolution = _positive(exif.get(FOCAL_LENGTH)), _positive(exif.get(PLANE_X_RESOLUTION))
        unit = PLANE_UNIT_MM.get(exif.get(PLANE_UNIT, 2))
        if length and resolution and unit:
            stored = max(_positive(exif.get(STORED_WIDTH)) or 0.0, _positive(exif.get(STORED_HEIGHT)) or 0.0) or max(width, height)
            focal = length * resolution / unit * max(width, height) / stored  # the resolution is for the size that the camera wrote
    if focal is None or not 0.1 < focal / max(width, height) < 50:
        return None
    return focal


def _positive(value: Any) -> float | None:
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if math.isfinite(number) and number > 0 else None
