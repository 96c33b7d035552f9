"""A folder of photos. Poses are unknown; a focal length in pixels comes from EXIF where a photo has one.

EXIF orientation: `images.load_image` turns pictures upright for this kind only, never for captures that bring poses (their
intrinsics are for the stored pixels). The focal length in pixels is the same either way, so nothing about it is carried here.
"""

from __future__ import annotations

import math
import os
import re
import warnings
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from PIL import Image

from fieldfuse.capture.heif import SUFFIXES as HEIF_SUFFIXES
from fieldfuse.capture.listing import assemble, counted, natural_key, pictures_in, require_folder, unique_names
from fieldfuse.capture.masks import is_mask_folder, masks_among
from fieldfuse.capture.sizes import picture_header
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.errors import InputError
from fieldfuse.files import require_utf8

FOLDERS = (".", "images", "input")
DEEP, MOST_FILES = 3, 100_000
OWN_CAPTURE = re.compile(r"transforms.*\.json|poses_bounds\.npy|cameras.*\.npz|sparse|colmap|run\.json|groundtruth\.txt|.*\.(sens|r3d)")
NO_PHOTOS = {
    *("depth", "depths", "disparity", "normal", "normals", "confidence", "flow", "segmentation", "segmentations", "semantic", "labels"),
    *("thumb", "thumbs", "thumbnail", "thumbnails", "preview", "previews", "render", "renders", "results", "output", "outputs"),
}
SMALLER = re.compile(r".*_(2|4|8|16|32)")  # the same photos made smaller, as in images_4
FILM_DIAGONAL = math.hypot(36.0, 24.0)  # mm
EXIF_FOLDER = 0x8769
FOCAL_LENGTH, FOCAL_LENGTH_35 = 0x920A, 0xA405
PLANE_X_RESOLUTION, PLANE_UNIT, STORED_WIDTH, STORED_HEIGHT = 0xA20E, 0xA210, 0xA002, 0xA003
PLANE_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}


def looks_like_photos(path: Path) -> bool:
    return any(pictures_in(path / folder) for folder in FOLDERS) or bool(photo_folders(path))


def photo_files(root: Path) -> list[Path]:
    """The pictures of whichever of `FOLDERS` holds most."""
    return max((pictures_in(root / folder) for folder in FOLDERS), key=len)


def photo_folders(root: Path) -> dict[Path, list[Path]]:
    """Folders at and below `root` that hold photos, and these: without masks, and without what is no photo (depth, small copies) or a
    capture of its own. At most `DEEP` folders down; links are not followed."""
    out: dict[Path, list[Path]] = {}
    looked = 0
    for place, children, names in os.walk(root):
        folder = Path(place)
        below = folder.relative_to(root).parts
        looked += 1 + len(names)
        if looked > MOST_FILES:
            break
        if below and (any(OWN_CAPTURE.fullmatch(name) for name in [*names, *children])):
            children.clear()
            continue
        children[:] = [] if len(below) >= DEEP else sorted((name for name in children if _may_hold_photos(name)), key=natural_key)
        pictures = pictures_in(folder)
        masks = masks_among(pictures)
        if len(masks) < len(pictures):
            out[folder] = [picture for picture in pictures if picture not in masks]
    return out


def read_photos(path: Path | str) -> Capture:
    """Photos in the folder and in folders below it that look like the same capture: of one size, or in folders that are numbered (`cam1/`).

    Raises:
        InputError: missing or empty folder, no photo, a file that is not a picture, or folders of different captures.
    """
    root = require_folder(path)
    pictures, remarks = _of_one_capture(root, photo_folders(root))
    if not pictures:
        raise InputError(f"no photo (jpg, heic, png, webp, bmp, tif) was found in {root}; give the folder that holds them")
    for picture in pictures:
        require_utf8(picture)
    pictures, double = _once_each(pictures)
    remarks += double
    frames = [
        Frame(name=name, image=picture, focal_prior=focal_from_exif(picture))
        for name, picture in zip(unique_names(pictures), pictures, strict=True)
    ]
    return assemble("photos", root, frames, remarks)


def with_unposed(capture: Capture) -> Capture:
    """The capture with those images beside its own, in the same folders, that have no poses, for finding poses anew."""
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


def _may_hold_photos(name: str) -> bool:
    words = set(re.findall(r"[a-z]+", name.lower()))
    return not (name.startswith((".", "__")) or words & NO_PHOTOS or is_mask_folder(name) or SMALLER.fullmatch(name.lower()))


def _of_one_capture(root: Path, folders: dict[Path, list[Path]]) -> tuple[list[Path], list[str]]:
    """The photos of the folders that belong to the one with most, the usual ones (`FOLDERS`) first; and remarks on the others."""
    usual = [folder for name in FOLDERS if (folder := root / name) in folders and len(folders[folder]) > 1]
    main = max(usual or list(folders), key=lambda folder: len(folders[folder]), default=None)
    if main is None:
        return [], []
    taken: list[Path] = [main]
    others: list[Path] = []
    sizes = _sizes(folders[main])
    for folder, pictures in folders.items():
        if folder != main:
            alike = len(pictures) > 1 and (bool(sizes & _sizes(pictures)) or _numbered(folder.name) == _numbered(main.name) != "")
            (taken if alike else others).append(folder)

    def listed(some: list[Path]) -> str:
        names = [f"{folder.relative_to(root).as_posix()}/ ({len(folders[folder])})" for folder in some]
        return ", ".join(names[:4]).replace("./ ", "the folder itself ") + (", …" if len(names) > 4 else "")

    if others and not usual and any(len(folders[folder]) > 1 for folder in others):
        raise InputError(
            f"{root} holds photos of different sizes in {listed([*taken, *others])}, which look like several captures; "
            "give one of the folders"
        )
    remarks = []
    if len(taken) > 1:
        remarks.append(f"the photos of {len(taken)} folders are taken as one capture: {listed(taken)}; give one folder to use it alone")
    if others:
        remarks.append(f"the photos in {listed(others)} look like others and are not used")
    order = [folder for folder in folders if folder in taken]
    return [picture for folder in order for picture in folders[folder]], remarks


def _sizes(pictures: list[Path]) -> set[tuple[int, int]]:
    """Long and short side of a few of the pictures; files that cannot be read are passed over."""
    out = set()
    for picture in pictures[:: max(1, len(pictures) // 5)]:
        with suppress(InputError):
            width, height = picture_header(picture).size
            out.add((max(width, height), min(width, height)))
    return out


def _numbered(name: str) -> str:
    """What folders of one kind share: `cam` of `cam1` and `cam_2`; empty for a name without a number."""
    match = re.fullmatch(r"([a-z]+)[ _-]*[0-9]+", name.lower())
    return match[1] if match else ""

def _once_each(pictures: list[Path]) -> tuple[list[Path], list[str]]:
    """The pictures without those `.heic` that lie beside another picture of their name, as phones and programs leave them that convert
    them: a photo that is there twice would be fitted and held out at once."""
    others = {picture.stem for picture in pictures if picture.suffix.lower() not in HEIF_SUFFIXES}
    kept = [picture for picture in pictures if picture.suffix.lower() not in HEIF_SUFFIXES or picture.stem not in others]
    double = len(pictures) - len(kept)
    if not double:
        return kept, []
    return kept, [f"{counted(double, 'picture is', 'pictures are')} there as HEIC and in another format; the latter is used"]


def size_from_exif(path: Path) -> tuple[int, int] | None:
    """Width and height in pixels that the camera wrote, as EXIF has them, or None."""
    exif = _exif(path)
    width, height = _positive(exif.get(STORED_WIDTH)), _positive(exif.get(STORED_HEIGHT))
    return (round(width), round(height)) if width and height and min(width, height) >= 1 else None


def _exif(path: Path) -> dict[int, Any]:
    """The camera's part of EXIF; empty where there is none, or it is broken in a good picture."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow remarks on size and on every oddity of EXIF
            with Image.open(path) as picture:
                return dict(picture.getexif().get_ifd(EXIF_FOLDER))
    except Exception:  # Pillow raises many families
        return {}


def focal_from_exif(path: Path) -> float | None:
    """The focal length in pixels of the stored picture, or None when EXIF does not tell a believable one.

    From the 35 mm equivalent (which compares diagonals), else from the focal length and the sensor's resolution.

    Raises:
        InputError: the file is not a picture.
    """
    width, height = picture_header(path).size
    if not width:  # it cannot be read, which is said elsewhere
        return None
    exif = _exif(path)
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
