"""A folder of photos, whose poses are unknown; a focal length in pixels comes from EXIF where a photo has one. And what else lies there.

EXIF orientation: `images.load_image` turns images upright for this kind only, not for captures with poses (their intrinsics are
for the stored pixels). The focal length in pixels is the same either way.
"""

from __future__ import annotations

import math
import os
import re
import warnings
from collections import Counter
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from PIL import Image

from fieldfuse.capture import raw
from fieldfuse.capture.colmap import holds_model
from fieldfuse.capture.headers import image_header
from fieldfuse.capture.heif import SUFFIXES as HEIF_SUFFIXES
from fieldfuse.capture.listing import IMAGES, assemble, counted, images_in, natural_key, require_folder, some_of, words_of
from fieldfuse.capture.masks import is_mask_folder, masks_among
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.capture.video import VIDEO_SUFFIXES
from fieldfuse.errors import InputError
from fieldfuse.files import require_utf8

FOLDERS = (".", "images", "input")
DEEP, MOST_FILES = 3, 100_000
OWN_CAPTURE = re.compile(
    r"transforms.*\.json|poses_bounds\.npy|cameras.*\.(npz|xml|txt|bin)|sparse|colmap|run\.json|groundtruth\.txt|reconstruction\.json"
    r"|bundle\.out|.*\.(sens|r3d|sfm|traj)"
)
NO_PHOTOS = {
    *("depth", "depths", "disparity", "normal", "normals", "confidence", "flow", "segmentation", "segmentations", "semantic", "labels"),
    *("thumb", "thumbs", "thumbnail", "thumbnails", "preview", "previews", "render", "renders", "results", "output", "outputs"),
}
SMALLER = re.compile(r".*_(2|4|8|16|32)")  # the same photos made smaller, as in images_4
POSE_FILES = re.compile(
    r"transforms.*\.json|cameras.*\.(npz|json|xml)|poses_bounds.*\.npy|.*\.(nvm|out|abc|psz|sfm)|traj(ectory)?\.(txt|log)|groundtruth\.txt"
    r"|reconstruction\.json",
    re.IGNORECASE,
)
# Kinds whose readers take none of these lists of poses but their own; the others may take any.
OWN_POSES = {
    **dict.fromkeys(("photos", "video", "colmap"), "$"),
    "transforms": r"transforms.*\.json",
    "blender": r"transforms_.*\.json",
    "llff": r"poses_bounds\.npy",
    "dtu": r"cameras.*\.npz",
    "metashape": r"cameras.*\.xml",
    "realitycapture": "$",
    "opensfm": r"reconstruction\.json|cameras\.json",
    "meshroom": r".*\.sfm",
    "bundler": r".*\.out",
}
UNPOSED = "beside these are not in the model and are left out"  # how the remark on them ends
FILM_DIAGONAL = math.hypot(36.0, 24.0)  # mm
EXIF_FOLDER = 0x8769
FOCAL_LENGTH, FOCAL_LENGTH_35 = 0x920A, 0xA405
PLANE_X_RESOLUTION, PLANE_UNIT, STORED_WIDTH, STORED_HEIGHT = 0xA20E, 0xA210, 0xA002, 0xA003
PLANE_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}


def looks_like_photos(path: Path) -> bool:
    return any(images_in(path / folder) for folder in FOLDERS) or bool(photo_folders(path))


def photo_files(root: Path) -> list[Path]:
    """The images of whichever of `FOLDERS` holds most."""
    return max((images_in(root / folder) for folder in FOLDERS), key=len)


def photo_folders(root: Path) -> dict[Path, list[Path]]:
    """Folders at and below `root` that hold photos, and these: without masks, and without what is no photo (depth, small copies) or a
    capture of its own. At most `DEEP` folders down; links are not followed."""

    def may_hold_photos(name: str) -> bool:
        other = words_of(name.lower()) & NO_PHOTOS or is_mask_folder(name) or SMALLER.fullmatch(name.lower())
        return not (name.startswith((".", "__")) or other)

    out: dict[Path, list[Path]] = {}
    looked = 0
    for place, children, names in os.walk(root):
        folder = Path(place)
        below = folder.relative_to(root).parts
        looked += 1 + len(names)
        if looked > MOST_FILES:
            break
        if below and any(OWN_CAPTURE.fullmatch(name) for name in [*names, *children]):
            children.clear()
            continue
        children[:] = [] if len(below) >= DEEP else sorted(filter(may_hold_photos, children), key=natural_key)
        images = images_in(folder)
        masks = masks_among(images)
        if len(masks) < len(images):
            out[folder] = [image for image in images if image not in masks]
    return out


def read_photos(path: Path | str) -> Capture:
    """Photos in the folder and in folders below it that look like the same capture: of one size, or in folders that are numbered (`cam1/`).

    Raises:
        InputError: missing or empty folder, no photo, a file that is not an image, or folders of different captures.
    """
    root = require_folder(path)
    images, remarks = _of_one_capture(root, photo_folders(root))
    if not images:
        raise InputError(f"no photo (jpg, heic, png, webp, avif, bmp, tif, exr, raw) was found in {root}; give the folder that holds them")
    for image in images:
        require_utf8(image)
    # Phones and programs leave a .heic beside what they convert it to: a photo twice would be fitted and held out at once.
    others = {image.stem for image in images if image.suffix.lower() not in HEIF_SUFFIXES}
    once = [image for image in images if image.suffix.lower() not in HEIF_SUFFIXES or image.stem not in others]
    if double := len(images) - len(once):
        remarks.append(f"{counted(double, 'image is', 'images are')} there as HEIC and in another format; the latter is used")
    return assemble("photos", root, [Frame(name="", image=image, focal_prior=focal_from_exif(image)) for image in once], remarks)


def with_unposed(capture: Capture) -> Capture:
    """The capture with those images beside its own, in the same folders, that have no poses, for finding poses anew."""
    if not capture.extra.get("unregistered"):
        return capture
    own = {frame.image for frame in capture.frames}
    beside = [path for folder in sorted({path.parent for path in own}) for path in images_in(folder) if path not in own]
    frames = [
        *(replace(frame, name="") for frame in capture.frames),
        *(Frame(name="", image=path, focal_prior=focal_from_exif(path)) for path in beside),
    ]
    remarks = [text for text in capture.warnings if not text.endswith(UNPOSED)]
    whole = assemble(capture.kind, capture.root, frames, remarks, alpha=capture.alpha)
    return replace(capture, frames=whole.frames, warnings=whole.warnings, extra={**capture.extra, "unregistered": 0})


def _of_one_capture(root: Path, folders: dict[Path, list[Path]]) -> tuple[list[Path], list[str]]:
    """The photos of the folders that belong to the one with most, the usual ones (`FOLDERS`) first; and remarks on the others."""
    usual = [folder for name in FOLDERS if (folder := root / name) in folders and len(folders[folder]) > 1]
    main = max(usual or list(folders), key=lambda folder: len(folders[folder]), default=None)
    if main is None:
        return [], []

    def stem(name: str) -> str:  # `cam` of `cam1` and `cam_2`; empty for a name without a number
        match = re.fullmatch(r"([a-z]+)[ _-]*[0-9]+", name.lower())
        return match[1] if match else ""

    def listed(some: list[Path]) -> str:
        names = [f"{folder.relative_to(root).as_posix()}/ ({len(folders[folder])})" for folder in some]
        return some_of(names, 4).replace("./ ", "the folder itself ")

    sizes, used, others = _sizes(folders[main]), [main], list[Path]()
    for folder, images in folders.items():
        if folder != main:
            alike = len(images) > 1 and (bool(sizes & _sizes(images)) or stem(folder.name) == stem(main.name) != "")
            (used if alike else others).append(folder)
    if others and not usual and any(len(folders[folder]) > 1 for folder in others):
        places = listed([*used, *others])
        raise InputError(f"{root} holds photos of different sizes in {places}, which look like several captures; give one of the folders")
    remarks = []
    if len(used) > 1:
        remarks.append(f"the photos of {len(used)} folders are taken as one capture: {listed(used)}; give one folder to use it alone")
    if others:
        remarks.append(f"the photos in {listed(others)} look like others and are not used")
    return [image for folder in folders if folder in used for image in folders[folder]], remarks


def _sizes(images: list[Path]) -> set[tuple[int, int]]:
    """Long and short side of a few of the images; files that cannot be read are passed over."""
    out = set()
    for image in images[:: max(1, len(images) // 5)]:
        with suppress(InputError):
            width, height = image_header(image).size
            out.add((max(width, height), min(width, height)))
    return out


# ------------------------------------------------------------------------------------------------ EXIF


def size_from_exif(path: Path) -> tuple[int, int] | None:
    """Width and height in pixels that the camera wrote into EXIF, or None."""
    exif = _exif(path)
    width, height = _positive(exif.get(STORED_WIDTH)), _positive(exif.get(STORED_HEIGHT))
    return (round(width), round(height)) if width and height and min(width, height) >= 1 else None


def focal_from_exif(path: Path) -> float | None:
    """The focal length in pixels of the stored image, or None when EXIF has no believable one.

    From the 35 mm equivalent (which compares diagonals), else from the focal length and the sensor's resolution.
    """
    width, height = image_header(path).size
    if not width:  # it cannot be read, which is reported elsewhere
        return None
    exif, long_side = _exif(path), max(width, height)
    equivalent = _positive(exif.get(FOCAL_LENGTH_35))
    length, resolution = _positive(exif.get(FOCAL_LENGTH)), _positive(exif.get(PLANE_X_RESOLUTION))
    unit = PLANE_UNIT_MM.get(exif.get(PLANE_UNIT, 2))
    focal = 0.0
    if equivalent:
        focal = equivalent / FILM_DIAGONAL * math.hypot(width, height)
    elif length and resolution and unit:
        stored = max(_positive(exif.get(STORED_WIDTH)) or 0.0, _positive(exif.get(STORED_HEIGHT)) or 0.0) or long_side
        focal = length * resolution / unit * long_side / stored  # the resolution is for the size that the camera wrote
    return focal if 0.1 < focal / long_side < 50 else None


def _exif(path: Path) -> dict[int, Any]:
    """The camera's part of EXIF; empty where there is none, or it is broken in a good image."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow remarks on size and on every oddity of EXIF
            if raw.is_raw(path):
                return dict(raw.exif_of(path).get_ifd(EXIF_FOLDER))
            with Image.open(path) as image:
                return dict(image.getexif().get_ifd(EXIF_FOLDER))
    except Exception:  # Pillow raises many families
        return {}


def _positive(value: Any) -> float | None:
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if math.isfinite(number) and number > 0 else None


# ------------------------------------------------------------------------------------------------ what is not used


def with_remark(capture: Capture) -> Capture:
    """The capture with a warning where it is photos and videos or other programs' poses lie beside them: these may have been meant."""
    lines = unused(capture) if capture.kind == "photos" else []
    meant = [line for line in lines if "video" in line or "with poses" in line]
    return capture.with_frames(capture.frames, f"beside the photos lie and are not used: {'; '.join(meant)}") if meant else capture


def unused(capture: Capture) -> list[str]:
    """A few lines on what a capture's folder holds besides what is used: images, videos, files with poses; each names three at most."""
    root, own = capture.root, OWN_POSES.get(capture.kind)
    if capture.film or not root.is_dir():
        return []
    of_frames = (path for frame in capture.frames for path in (frame.image, frame.depth, frame.mask, frame.confidence))
    used = {path.resolve() for path in of_frames if path is not None}
    images: Counter[str] = Counter()
    videos: list[str] = []
    poses: list[str] = []
    looked = 0
    for place, children, names in os.walk(root):
        folder = Path(place)
        relative = folder.relative_to(root)
        if "run.json" in names and relative.parts:
            children.clear()
            continue
        children[:] = [] if len(relative.parts) >= 2 else sorted(name for name in children if not name.startswith((".", "__")))
        looked += len(names) + len(children)
        if looked > MOST_FILES:
            break
        if own is not None and capture.kind != "colmap" and relative.parts and holds_model(folder):
            poses.append(f"{relative.as_posix()}/ (COLMAP model)")
        for name in sorted(names, key=natural_key):
            suffix = Path(name).suffix.lower()
            known = suffix in (*IMAGES, *VIDEO_SUFFIXES) or POSE_FILES.fullmatch(name)
            if name.startswith(".") or not known or (folder / name).resolve() in used:
                continue
            if suffix in IMAGES:
                images[relative.as_posix()] += 1
            elif suffix in VIDEO_SUFFIXES:
                videos.append((relative / name).as_posix())
            elif own is not None and not re.fullmatch(own, name, re.IGNORECASE):
                poses.append((relative / name).as_posix())
    # Smaller copies of the same images are made by many programs, and nobody means them.
    heaps = [(place, count) for place, count in images.most_common() if not SMALLER.fullmatch(place.lower())]
    lines = []
    if heaps:
        shown = some_of([f"{count} in {'the folder itself' if place == '.' else place + '/'}" for place, count in heaps])
        lines.append(f"{counted(sum(count for _, count in heaps), 'image')} ({shown})")
    for found, one, many in ((videos, "video", "videos"), (poses, "file with poses", "files with poses")):
        if found:
            lines.append(f"{counted(len(found), one, many)} ({some_of(found)})")
    return lines
