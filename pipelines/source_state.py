"""What stages depend on in the source: names, sizes and times of its files, by which a change is noticed."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fieldfuse.files import fingerprint

if TYPE_CHECKING:
    from fieldfuse.capture.types import Capture

MAX_LISTED = 200_000  # files of a source that are looked at for changes


def source_state(source: Path, without: Path) -> str:
    """Hash of names, sizes and times of all files of the source, wherever it lies; `without` (the run's own folder) does not count."""
    from fieldfuse.capture.replica import camera_file, looks_like_replica

    if source.is_file() and source.suffix.lower() != ".json":
        return fingerprint(_state(source, source.parent))
    root = source.parent if source.is_file() else source
    beside = camera_file(root) if looks_like_replica(root) else None  # one for all scenes, in the folder above
    outside = [] if beside is None or beside.parent == root else [_state(beside, beside.parent)]
    return fingerprint(source.name if source.is_file() else "", [_state(path, root) for path in _files(root, without)], *outside)


def _files(root: Path, without: Path) -> Iterable[Path]:
    found: list[Path] = []
    for folder, folders, files in os.walk(os.path.realpath(root)):  # as `without` is named
        folders[:] = sorted(name for name in folders if Path(folder, name) != without and not name.startswith("."))
        found += [Path(folder, name) for name in sorted(files) if not name.startswith(".")]
        if len(found) > MAX_LISTED:
            break
    return found[:MAX_LISTED]


def pixel_state(capture: Capture) -> str:
    """Hash of the files that hold the capture's pictures; those in its folder are the same ones wherever that lies."""
    paths = {path for frame in capture.frames for path in (frame.image, frame.depth, frame.mask, frame.confidence) if path is not None}
    return fingerprint([_state(path, capture.root) for path in sorted(paths)])


def _state(path: Path, root: Path) -> list[Any]:
    """Its name below `root` (in full, if it lies elsewhere), size and time."""
    name = next((path.relative_to(base).as_posix() for base in (root, root.resolve()) if path.is_relative_to(base)), str(path))
    try:
        stat = path.stat()
    except OSError:
        return [name, None]
    return [name, stat.st_size, stat.st_mtime_ns]
