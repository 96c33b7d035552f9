"""Images with the poses that another program lists: their files are found, cameras scaled to them, and what is missing is counted."""

from __future__ import annotations

import posixpath
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.capture.calibration import fitted
from fieldfuse.capture.headers import UNREADABLE, image_header
from fieldfuse.capture.listing import assemble, counted, images_in, unique_names
from fieldfuse.capture.masks import masks_among
from fieldfuse.capture.poses import checked_pose, single_frame
from fieldfuse.capture.resolve import CaptureFiles, Found
from fieldfuse.capture.types import Capture, Frame

BESIDE = 0.5  # of an image's side by which a principal point may lie outside: images may have been cropped since
T = TypeVar("T")
MOST_FOLDERS = 30  # in which an export is looked for
FOLDERS = ("", "images", "imgs", "photos", "input")  # where images lie beside the file that lists them, the usual ones first


@dataclass(frozen=True)
class Listed:
    """One image as a program lists it."""

    name: str  # of its file, with or without folders and suffix
    pose: Array  # (4, 4) world_from_camera, OpenCV axes
    camera: Intrinsics | Callable[[tuple[int, int]], Intrinsics]  # or what makes it for an image of (width, height)
    where: str  # what messages call it


def listed_capture(kind: str, source: Path, entries: Sequence[Listed], root: Path | None = None, **facts: Any) -> Capture:
    """The capture of those `entries` whose images are below `root`, by default the folder of the file `source` that lists them.

    Args:
        facts: fields of the capture; `warnings` come first, and numbers of images are added to `extra`.

    Raises:
        InputError: no image exists, or a pose or camera is not usable.
    """
    folder = CaptureFiles(root or source.parent)
    found = _find(folder, [entry.name for entry in entries], source)
    if not found.count:
        raise folder.none_exists(source.name, len(entries), found)
    remarks = [*facts.pop("warnings", ()), *found.remarks]
    first: dict[Path, Listed] = {}
    again = 0
    for entry, image in zip(entries, found.files, strict=True):
        if image is not None:
            again += image in first
            first.setdefault(image, entry)
    frames, scaled = [], 0
    sizes = [image_header(image).size for image in first]
    usual = next((size for size in sizes if size != UNREADABLE.size), UNREADABLE.size)
    for name, size, (image, entry) in zip(unique_names(list(first)), sizes, first.items(), strict=True):
        with single_frame(name):
            shown = usual if size == UNREADABLE.size else size
            described = entry.camera if isinstance(entry.camera, Intrinsics) else entry.camera(shown)
            camera = fitted(described, shown, entry.where, image).centred(entry.where, BESIDE)
            scaled += camera is not described
            frames.append(Frame(name=name, image=image, intrinsics=camera, world_from_camera=checked_pose(entry.pose, entry.where)))
    missing = found.files.count(None)
    if missing:
        remarks.append(f"{missing} of the {len(entries)} images listed in {source.name} do not exist; the other {len(first)} are used")
    if again:
        remarks.append(f"{counted(again, 'image is', 'images are')} listed again in {source.name}; the first entry is used")
    if scaled:
        remarks.append(f"{counted(scaled, 'image')} of another size than in {source.name}; intrinsics were scaled to fit")
    unregistered = _unregistered(list(first))
    if unregistered:
        remarks.append(f"{counted(unregistered, 'image')} beside these have no pose in {source.name} and are left out")
    extra = {"listed": len(entries), "missing": missing, "unregistered": unregistered, **facts.pop("extra", {})}
    return assemble(kind, root or source.parent, frames, remarks, extra=extra, **facts)


def exported(folder: Path, find: Callable[[Path], T | None]) -> T | None:
    """What `find` finds in the folder, else in the only one of its folders that has it and no images of its own (`photos/`, `export/`)."""
    if (own := find(folder)) or not folder.is_dir():
        return own
    below = sorted(path for path in folder.iterdir() if path.is_dir() and not path.is_symlink() and not path.name.startswith("."))
    found = [one for path in below[:MOST_FOLDERS] if (one := find(path)) and not any(images_in(path / name) for name in FOLDERS)]
    return found[0] if len(found) == 1 else None


def _find(folder: CaptureFiles, names: Sequence[str], source: Path) -> Found:
    """Where most of the names are: in the file's own folder or a usual one beside it or in the root, else anywhere."""
    own = source.parent.resolve()
    base = own.relative_to(folder.root).as_posix() if own.is_relative_to(folder.root) else "."  # a linked folder
    best: Found | None = None
    for place in dict.fromkeys(posixpath.normpath(posixpath.join(start, name)) for start in (base, ".") for name in FOLDERS):
        if (folder.root / place).is_dir():
            found = folder.find(names, source=source.name, base="" if place == "." else place, anywhere=False)
            best = found if best is None or found.count > best.count else best
            if best.count == len(names):
                break
    if best is not None and best.count == len(names):
        return best
    anywhere = folder.find(names, source=source.name, base="" if base == "." else base)
    return anywhere if best is None or anywhere.count > best.count else best


def _unregistered(used: Sequence[Path]) -> int:
    """How many images lie beside the used ones and are none of them, nor masks."""
    count = 0
    for place in {image.parent for image in used}:
        beside = images_in(place)
        count += len(set(beside) - set(used) - set(masks_among(beside)))
    return count

