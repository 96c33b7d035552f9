"""The report of a run: `report.json` with keys that others rely on, and a self-contained `report.html` for people."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from fieldfuse import __version__
from fieldfuse.errors import InputError
from fieldfuse.evaluation import words
from fieldfuse.evaluation.words import SCORE
from fieldfuse.files import atomic_path, write_json

# Always there, null when not known.
CAPTURE = ("kind", "frames", "width", "height")
POSES = ("source", "registered", "total", "models")
STAGE = ("name", "seconds", "peak_memory_mb", "cached")
FIELD = ("voxel_size", "blocks", "voxels", "bytes")
POINT = ("seconds", "psnr")
METHODS = (("field", "Field"), ("network", "Networks alone"), ("splats", "Splats"), ("tsdf", "TSDF"))
SFM_NOTE = (
    "Camera poses were estimated from all images, test views included; "
    "the colours of test views were never shown to anything that fits appearance."
)


def plain(value: Any) -> Any:
    """`value` as JSON data: NumPy becomes Python, paths and other objects text, what is not finite null."""
    if value is None or isinstance(value, (bool, str)):
        return value
    if isinstance(value, (np.ndarray, np.generic)):
        return plain(value.tolist())
    if isinstance(value, int):
        return int(value)
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, dict):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        return [plain(entry) for entry in value]
    return str(value)


def part(value: Any, keys: tuple[str, ...], name: str) -> dict[str, Any]:
    """A table with all of `keys` first (null when missing), then whatever else it holds.

    Raises:
        InputError: it is no table.
    """
    if not isinstance(value, (dict, type(None))):
        raise InputError(f"the report's part {name!r} is a {type(value).__name__}; it must be a table of names and values")
    return {**dict.fromkeys(keys), **(value or {})}


def parts(value: Any, keys: tuple[str, ...], name: str) -> list[dict[str, Any]]:
    """A list of tables, see `part`."""
    if not isinstance(value, (list, type(None))):
        raise InputError(f"the report's part {name!r} is a {type(value).__name__}; it must be a list")
    return [part(entry, keys, name) for entry in value or []]


def whole(data: dict[str, Any], **known: Any) -> dict[str, Any]:
    """The form that reports, comparisons and trade-offs share, then `known`, then whatever else `data` holds (plain JSON)."""
    form = {
        "version": data.get("version") or __version__,
        **{key: data.get(key) for key in ("command", "source", "created", "scene")},
        "warnings": [str(warning) for warning in data.get("warnings") or []],
        "capture": part(data.get("capture"), CAPTURE, "capture"),
        "poses": part(data.get("poses"), POSES, "poses"),
        "stages": parts(data.get("stages"), STAGE, "stages"),
        "settings": data.get("settings") or {},
        **known,
    }
    return {**form, **{key: value for key, value in data.items() if key not in form}}


def _exports(entries: Any, folder: Path | None) -> list[dict[str, Any]]:
    """Exports with their path relative to the report's folder, and their size when the file is there; a path elsewhere is kept as it is."""
    if isinstance(entries, str):
        entries = [entries]
    if isinstance(entries, list):
        entries = [{"path": entry} if isinstance(entry, str) else entry for entry in entries]
    out = parts(entries, ("path", "bytes"), "exports")
    for entry in out:
        if folder is not None and entry["path"]:
            path = folder / str(entry["path"])
            try:
                entry["path"] = path.resolve().relative_to(folder.resolve()).as_posix()
                entry["bytes"] = path.stat().st_size if entry["bytes"] is None and path.is_file() else entry["bytes"]
            except (OSError, ValueError):
                pass
    return out


def report_data(data: dict[str, Any], folder: Path | None = None) -> dict[str, Any]:
    """`data` in the fixed form of `report.json`, plain JSON. Applying it twice changes nothing.

    Raises:
        InputError: a part is not of the form that `write_report` describes.
    """
    data = plain(data)
    if not isinstance(data, dict):
        raise InputError(f"a report is made of a table of names and values, not of a {type(data).__name__}")
    evaluation = part(data.get("evaluation"), ("field", "tsdf"), "evaluation")
    for method, _ in METHODS:
        if evaluation.get(method) is not None:
            evaluation[method] = part(evaluation[method], SCORE, f"evaluation.{method}")
    floor = data.pop("baseline", None) or evaluation.get("nearest_image")
    evaluation["nearest_image"] = None if floor is None else part(floor, ("views", "psnr"), "baseline")
    notes = [str(note) for note in data.get("notes") or []]
    estimated = part(data.get("poses"), POSES, "poses")["source"] == "sfm"
    if estimated and (evaluation["field"] or evaluation["tsdf"]) and SFM_NOTE not in notes:
        notes.append(SFM_NOTE)
    return whole(
        data,
        seconds_total=data.get("seconds_total"),
        notes=notes,
        field=part(data.get("field"), FIELD, "field"),
        evaluation=evaluation,
        timeline=parts(data.get("timeline"), POINT, "timeline"),
        exports=_exports(data.get("exports"), folder),
    )


def score_rows(data: dict[str, Any]) -> list[dict[str, Any]]:
    """Rows of the table of headline numbers: `title`, `note`, scores (`part`: PSNR alone), and for each measure whether a row is the `best`
    (when there are two to compare)."""
    rows = []
    for key, title in METHODS:
        score = data["evaluation"].get(key)
        if score is None:
            continue
        note = ""
        if (frames := score.get("key_frames")) is not None:
            note = f"{words.counted(frames, 'key frame')} fused in {words.duration(score.get('seconds'))}, nothing fitted"
        if (gaussians := score.get("gaussians")) is not None:
            note = f"{words.counted(gaussians, 'Gaussian')}, harmonics of degree {score.get('degree')}"
        rows.append({**score, "title": title, "note": note, "part": False})
        if score.get("psnr_masked") is not None:
            note = f"where it has surface: {words.share(score.get('coverage'))} of the pixels"
            rows.append({"title": title, "note": note, "psnr": score["psnr_masked"], "part": True})
    floor = data["evaluation"]["nearest_image"]
    if floor is not None and floor["psnr"] is not None:
        rows.append({"title": "Nearest training photo", "note": "shown unchanged: the floor", "psnr": floor["psnr"], "part": True})
    rivals = [row for row in rows if not row["part"]]
    for measure, better in (("psnr", max), ("ssim", max), ("lpips", min), ("depth_abs_err", min), ("seconds_per_view", min)):
        known = [row[measure] for row in rivals if row.get(measure) is not None]
        for row in rivals:
            row.setdefault("best", {})[measure] = len(known) > 1 and row.get(measure) == better(known)
    return rows


def write_page(folder: Path, name: str, data: dict[str, Any], html: str) -> tuple[Path, Path]:
    """Write `<name>.json` and `<name>.html` into `folder`; their paths.

    Raises:
        OutputError: the folder is not writable or the disk is full.
    """
    paths = folder / f"{name}.json", folder / f"{name}.html"
    write_json(paths[0], data)
    with atomic_path(paths[1]) as temporary:
        temporary.write_text(html, encoding="utf-8")
    return paths
