"""The capture that a run is of: what it is, the state of its files, by which a change is noticed, and its new place when it was moved."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fieldfuse.files import fingerprint, read_json, write_json
from fieldfuse.pipelines.folder import STAGES, RunFolder
from fieldfuse.pipelines.stages import read_record, stage_key

if TYPE_CHECKING:
    from fieldfuse.capture.types import Capture

MAX_LISTED = 200_000  # files of a source that are looked at for changes
HOLDERS = {"capture": "capture.json", "frames": "frames/capture.json"}  # stage → its file with the paths of images


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
    """Hash of the files that hold the capture's images; those in its folder are the same ones wherever that lies."""
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


def same_capture(folder: RunFolder, source: Path) -> bool:
    """Whether `source` holds what the folder's run was made of: the same names, sizes and times of files, wherever they lay."""
    record = read_record(folder / STAGES / "capture.json")
    return record is not None and record.key == stage_key("capture", source_state(source, folder.path))


def relocate(folder: RunFolder, before: Path, now: Path) -> None:
    """Let the stages find the capture `before`, which is gone, as `now`. They are not made again, since their results are the same."""
    old, new = (before.parent, now.parent) if before.suffix.lower() == ".json" else (before, now)
    pattern = re.compile(rf"(?<![\w.-]){re.escape(str(old))}(?![\w.-])")
    for stage, name in HOLDERS.items():
        path, record = folder / name, read_record(folder / STAGES / f"{stage}.json")
        if record is None or name not in record.outputs or not path.is_file():
            continue
        data = _replaced(read_json(path), pattern, str(new))
        if now.is_file() and data.get("root") == str(old.parent):  # a video lies in a folder with others
            data["root"] = str(new.parent)
        write_json(path, data)
        write_json(folder / STAGES / f"{stage}.json", asdict(replace(record, outputs={**record.outputs, name: path.stat().st_size})))


def _replaced(value: Any, old: re.Pattern[str], new: str) -> Any:
    """Plain data with a path in all its texts replaced."""
    if isinstance(value, dict):
        return {key: _replaced(one, old, new) for key, one in value.items()}
    if isinstance(value, list):
        return [_replaced(one, old, new) for one in value]
    return old.sub(lambda _: new, value) if isinstance(value, str) else value


def picture_size(capture: Capture) -> tuple[int | None, int | None]:
    """Width and height of the capture's first picture, as its header says."""
    first = capture.frames[0]
    if first.intrinsics is not None:
        return first.intrinsics.width, first.intrinsics.height
    if capture.kind == "video":
        return capture.extra.get("width"), capture.extra.get("height")
    from fieldfuse.capture.archive import read_bytes
    from fieldfuse.capture.headers import read_header

    header = read_header(read_bytes(first.image), first.image)
    turned = header.orientation >= 5  # EXIF: the stored picture lies on its side
    return (header.height, header.width) if turned else (header.width, header.height)


def describe_capture(capture: Capture) -> dict[str, Any]:
    """The report's part `capture`."""
    from fieldfuse.capture.types import MODEL_NAMES

    width, height = picture_size(capture)
    return {
        "kind": capture.kind,
        "frames": len(capture.frames),
        "width": width,
        "height": height,
        "posed": capture.posed,
        "depth": sum(frame.depth is not None for frame in capture.frames),
        "masks": sum(frame.mask is not None for frame in capture.frames),
        "metric": capture.metric,
        "extra": {name: value for name, value in capture.extra.items() if name != MODEL_NAMES},
    }
