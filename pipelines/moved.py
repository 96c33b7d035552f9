"""A capture that was moved since a run was made of it: the run's folder is told where it lies now, and what is made of it stays."""

from __future__ import annotations

import re
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from fieldfuse.files import read_json, write_json
from fieldfuse.pipelines.folder import STAGES, RunFolder
from fieldfuse.pipelines.source_state import source_state
from fieldfuse.pipelines.stages import read_record, stage_key

KEEPERS = {"capture": "capture.json", "frames": "frames/capture.json"}  # stage → its file that says where pictures lie


def same_capture(folder: RunFolder, source: Path) -> bool:
    """Whether `source` holds what the folder's run was made of: the same names, sizes and times of files, wherever they lay."""
    record = read_record(folder / STAGES / "capture.json")
    return record is not None and record.key == stage_key("capture", source_state(source, folder.path))


def follow(folder: RunFolder, before: Path, now: Path) -> None:
    """Let the stages find the capture `before`, which is gone, as `now`. They are not made again, since their results are the same."""
    old, new = (before.parent, now.parent) if before.suffix.lower() == ".json" else (before, now)
    for stage, name in KEEPERS.items():
        path, record = folder / name, read_record(folder / STAGES / f"{stage}.json")
        if record is None or name not in record.outputs or not path.is_file():
            continue
        data = _replaced(read_json(path), re.compile(rf"(?<![\w.-]){re.escape(str(old))}(?![\w.-])"), str(new))
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
