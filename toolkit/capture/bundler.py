"""Bundler's `bundle.out` with the list of its images (`list.txt`), as Bundler, VisualSFM, RealityCapture and others write it.

After a comment's line come the numbers of cameras and points, then five lines a camera: `f k1 k2`, three rows of camera_from_world's
rotation, its translation, in OpenGL axes (x right, y up, the camera looks along -z), f in pixels; then three lines a point, the first
its position. A camera with f = 0 was not registered. The principal point is the image's middle. Format: Snavely, "Bundler v0.4 User's
Manual".
"""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import numpy as np

from fieldfuse.camera import Array, Intrinsics, invert, world_from_opengl
from fieldfuse.capture.lenses import with_brown_lens
from fieldfuse.capture.listing import counted, files_in, is_file, natural_key, numbers, read_text, require_folder
from fieldfuse.capture.posed_list import Listed, exported, listed_capture
from fieldfuse.capture.types import Capture
from fieldfuse.capture.xml_file import starts_with
from fieldfuse.errors import InputError

HEADER = b"# Bundle file v0."
LISTS = ("list.txt", "images.txt", "pictures.txt", "image_list.txt")
MAX_BYTES = 2**28
MOST_FILES = 20


def _bundle(folder: Path) -> Path | None:
    """The bundle in a folder (the last of several rounds: `bundle.out` rather than `bundle_010.out`)."""
    found = sorted(files_in(folder, "*.out"), key=lambda file: (file.name != "bundle.out", natural_key(file.name)))
    return next((file for file in found[:MOST_FILES] if starts_with(file, HEADER)), None)


def looks_like_bundler(path: Path) -> bool:
    return exported(path, _bundle) is not None


def read_bundler(path: Path | str) -> Capture:
    """The registered cameras that have an image, and the points; `path` is the folder or the `.out` file.

    Raises:
        InputError: the file is broken or has no list of images, or no image exists.
    """
    source = Path(path).absolute()
    file = source if source.is_file() else exported(require_folder(source), _bundle)
    if file is None:
        raise InputError(f"{source} holds no bundle.out of Bundler; export one there")
    root = source if source.is_dir() else file.parent
    names = _names(file, root)
    lines = (line for line in read_text(file, MAX_BYTES).splitlines() if line.strip() and not line.lstrip().startswith("#"))
    counts = numbers(next(lines, "").split(), f"{file}: the numbers of cameras and points", 2)
    if not (counts >= 0).all() or counts[0] != len(names):
        raise InputError(f"{file} has {counts[0]:g} cameras and its list {counted(len(names), 'image')}; give the list that belongs to it")
    entries = []
    for name in names:
        where = f"{file.name}, camera of {name[:80]!r}"
        values = numbers(" ".join(islice(lines, 5)).split(), where, 15, "the file ends before its own counts, copy or write it again")
        if values[0] > 0:
            entries.append(_listed(name, values, where))
    if not entries:
        raise InputError(f"{file} holds no registered cameras; reconstruct the photos again")
    lost = len(names) - len(entries)
    remarks = [f"{lost} of {counted(len(names), 'image')} were not registered by Bundler"] if lost else []
    points = _points(list(islice(lines, 0, 3 * int(counts[1]), 3)), file)
    return listed_capture("bundler", file, entries, root, points=points, warnings=remarks)


def _names(file: Path, root: Path) -> list[str]:
    stem = file.name.removesuffix(".out").removesuffix(".bundle")
    beside = (f"{file.name}.list.txt", f"{stem}.list.txt", *LISTS)
    places = (file.parent, root, root / "prepare")  # the last as RunSFM leaves it
    found = next((place / name for place in places for name in beside if is_file(place / name)), None)
    if found is None:
        raise InputError(f"{file} has no list of its images beside it; add list.txt with their names, one a line, in the cameras' order")
    lines = [line.strip() for line in read_text(found).splitlines() if line.strip()]
    return [_without_focal(line) for line in lines]


def _without_focal(line: str) -> str:
    """`images/a b.jpg 0 1234.5` without what Bundler adds: a zero and the focal length by EXIF."""
    words = line.rsplit(maxsplit=2)
    if len(words) == 3 and words[1] in ("0", "1"):
        try:
            float(words[2])
        except ValueError:
            return line
        return words[0]
    return line


def _listed(name: str, values: Array, where: str) -> Listed:
    f, k1, k2 = values[:3].tolist()
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = values[3:12].reshape(3, 3), values[12:]

    def camera(size: tuple[int, int]) -> Intrinsics:
        return with_brown_lens(Intrinsics(*size, f, f, size[0] / 2, size[1] / 2), (k1, k2), (0.0, 0.0), where)

    return Listed(name, world_from_opengl(invert(pose)), camera, where)


def _points(lines: list[str], file: Path) -> Array | None:
    if not lines:
        return None
    return numbers(" ".join(lines).split(), f"{file.name}: the points", 3 * len(lines)).reshape(-1, 3)
