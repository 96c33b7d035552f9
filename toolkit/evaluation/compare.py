"""What `compare.json` holds, and the one table that it becomes: a row a measure, a column a method."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from fieldfuse import __version__
from fieldfuse.errors import InputError
from fieldfuse.evaluation import words
from fieldfuse.evaluation.geometry import VOXELS
from fieldfuse.evaluation.report import CAPTURE, POSES, STAGE, plain

# Always there in a method, null when not known.
METHOD = ("key", "title", "note", "reference", "stages", "seconds", "mesh_seconds", "peak_memory_mb", "disk_bytes", "memory_bytes")
RESULTS = ("score", "geometry", "mesh")
TRUTH = ("mesh", "depth", "seen_share", "unit")


@dataclass(frozen=True)
class Cell:
    """One number as text, and whether it is the best of its row."""

    text: str
    best: bool = False


@dataclass(frozen=True)
class Row:
    """A measure over all methods."""

    label: str
    note: str
    cells: list[Cell]


Format = Callable[[Any], str]


def compare_data(data: dict[str, Any]) -> dict[str, Any]:
    """`data` in the fixed form of `compare.json`, plain JSON: `methods` (a list, each with all of `METHOD` and `RESULTS`), `truth`, and the
    facts of the run that `report.json` has, too. Applying it twice changes nothing.

    `seconds` and `peak_memory_mb` of a method are the sum and the largest of its `stages`. A method marked as `reference` was given what
    nobody has in earnest (perfect depth, say): it is shown and takes no part in who is best.

    Raises:
        InputError: there is no method, or it is not a table.
    """
    data = plain(data)
    methods = data.get("methods") if isinstance(data, dict) else None
    if not isinstance(methods, list) or not methods or not all(isinstance(method, dict) for method in methods):
        raise InputError("a comparison is made of `methods`, a list of tables, and there is none; run the methods first")
    out = []
    for method in methods:
        stages = [{**dict.fromkeys(STAGE), **stage} for stage in method.get("stages") or []]
        seconds = [stage["seconds"] for stage in stages if stage["seconds"] is not None]
        memory = [stage["peak_memory_mb"] for stage in stages if stage["peak_memory_mb"] is not None]
        known = {"seconds": round(sum(seconds), 3) if seconds else None, "peak_memory_mb": max(memory) if memory else None}
        out.append({**dict.fromkeys(METHOD + RESULTS), **method, "stages": stages, **known})
    known = {
        "version": data.get("version") or __version__,
        "command": data.get("command"),
        "created": data.get("created"),
        "source": data.get("source"),
        "warnings": [str(warning) for warning in data.get("warnings") or []],
        "capture": {**dict.fromkeys(CAPTURE), **(data.get("capture") or {})},
        "poses": {**dict.fromkeys(POSES), **(data.get("poses") or {})},
        "scene": data.get("scene"),
        "truth": {**dict.fromkeys(TRUTH), **(data.get("truth") or {})},
        "methods": out,
        "stages": [{**dict.fromkeys(STAGE), **stage} for stage in data.get("stages") or []],
        "matching": data.get("matching"),
        "settings": data.get("settings") or {},
        "machine": data.get("machine") or {},
    }
    return {**known, **{key: value for key, value in data.items() if key not in known}}


def table(data: dict[str, Any]) -> list[tuple[str, list[Row]]]:
    """Groups of rows; rows that no method has a number for are left out. `data` as `compare_data` answers it."""
    methods = data["methods"]
    groups = [
        ("Cost", _cost(methods)),
        ("Pictures of test views, whole", _pictures(methods, ())),
        *((f"The same where {title} shows surface", _pictures(methods, ("on", key), share=key)) for key, title in _surfaces(methods)),
        (_depth_title(data), _depth(methods)),
        ("Mesh against the true surface that the cameras saw", _geometry(methods, data["truth"]["unit"] or "units")),
        ("Mesh", _mesh(methods)),
    ]
    return [(title, rows) for title, rows in groups if rows]


def _surfaces(methods: Sequence[dict[str, Any]]) -> list[tuple[str, str]]:
    """Key and title of the methods that leave pixels empty."""
    own = [method for method in methods if not method["reference"]]
    return [(method["key"], method["title"]) for method in own if method["key"] in ((method["score"] or {}).get("on") or {})]


def _at(method: dict[str, Any], *path: str) -> Any:
    value: Any = method
    for key in path:
        value = value.get(key) if isinstance(value, dict) else None
    return value


def _row(label: str, methods: Sequence[dict[str, Any]], path: Sequence[str], show: Format, better: Any = None, note: str = "") -> list[Row]:
    """One row, or none when no method has the number; the best is marked when at least two have it and they differ."""
    values = [_at(method, *path) for method in methods]
    if all(value is None for value in values):
        return []
    rivals = [value for value, method in zip(values, methods, strict=True) if value is not None and not method["reference"]]
    # What reads the same is equally good.
    best = show(better(rivals)) if better is not None and len({show(value) for value in rivals}) > 1 else None
    marks = [value is not None and not method["reference"] and show(value) == best for value, method in zip(values, methods, strict=True)]
    return [Row(label, note, [Cell(show(value), mark) for value, mark in zip(values, marks, strict=True)])]


def _percent(value: float | None) -> str:
    return words.NONE if value is None else f"{100 * value:.2f}%"


def _degrees(value: float | None) -> str:
    return words.NONE if value is None else f"{value:.1f}°"


def _cost(methods: Sequence[dict[str, Any]]) -> list[Row]:
    return [
        *_row("Time to make it", methods, ("seconds",), words.duration, min, "with its test views, after the shared stages"),
        *_stage_rows(methods),
        *_row("Time for its mesh besides", methods, ("mesh_seconds",), words.duration),
        *_row("Time to render a test view", methods, ("score", "seconds_per_view"), words.duration, min),
        *_row("Peak memory", methods, ("peak_memory_mb",), words.memory, min, "of the whole process during its stages"),
        *_row("Size on disk", methods, ("disk_bytes",), words.size, min, "what rendering needs"),
        *_row("Size in memory", methods, ("memory_bytes",), words.size, min),
    ]


def _stage_rows(methods: Sequence[dict[str, Any]]) -> list[Row]:
    """The seconds of each method's own stages."""
    by_name = [{stage["name"]: stage["seconds"] for stage in method["stages"]} for method in methods]
    names = dict.fromkeys(name for known in by_name for name in known)
    return [Row(f"· stage {name}", "", [Cell(words.duration(known.get(name))) for known in by_name]) for name in names]


def _pictures(methods: Sequence[dict[str, Any]], within: tuple[str, ...], share: str | None = None) -> list[Row]:
    path = ("score", *within)
    rows = [
        *_row("PSNR (dB) ↑", methods, (*path, "psnr"), words.decimal, max),
        *_row("SSIM ↑", methods, (*path, "ssim"), lambda value: words.decimal(value, 3), max),
        *_row("LPIPS ↓", methods, (*path, "lpips"), lambda value: words.decimal(value, 3), min),
    ]
    if share is not None:
        surface = next(method for method in methods if method["key"] == share)
        note = f"{words.share(_at(surface, 'score', 'coverage'))} of the pixels"
        rows = [Row(row.label, note if place == 0 else "", row.cells) for place, row in enumerate(rows)]
    return rows


def _depth_title(data: dict[str, Any]) -> str:
    against = {"exact": "the exact depth", "sensor": "the depth sensor"}.get(str(data["truth"]["depth"]), "the true depth")
    return f"Depth of test views against {against}"


def _depth(methods: Sequence[dict[str, Any]]) -> list[Row]:
    scale = next((value for method in methods if (value := _at(method, "score", "depth_scale")) is not None), None)
    of_scale = "" if scale is None else f"of the median depth, {words.significant(scale)}"
    return [
        *_row("Mean error ↓", methods, ("score", "abs_err"), _percent, min, of_scale),
        *_row("Within 1% ↑", methods, ("score", "acc_1"), words.share, max, "what is missing counts as wrong"),
        *_row("Within 5% ↑", methods, ("score", "acc_5"), words.share, max),
        *_row("Median relative error ↓", methods, ("score", "depth", "median_rel"), _percent, min, "where there is depth"),
        *_row("Pixels with depth ↑", methods, ("score", "depth", "coverage"), words.share, max),
    ]


def _geometry(methods: Sequence[dict[str, Any]], unit: str) -> list[Row]:
    voxel = next((value for method in methods if (value := _at(method, "geometry", "voxel_size")) is not None), None)
    scores = []
    for n in VOXELS:
        note = f"{words.significant(n * voxel)} {unit}" if voxel is not None else ""
        scores += _row(f"F-score at {n} voxel{'' if n == 1 else 's'} ↑", methods, ("geometry", f"f_score_{n}"), words.share, max, note)
    return [
        *_row(f"Accuracy ({unit}) ↓", methods, ("geometry", "accuracy"), words.significant, min, "mean distance from mesh to truth"),
        *_row(
            f"Completeness ({unit}) ↓", methods, ("geometry", "completeness"), words.significant, min, "mean distance from truth to mesh"
        ),
        *scores,
        *_row("Normals off by ↓", methods, ("geometry", "normals"), _degrees, min, "in the mean, within 4 voxels of the truth"),
    ]


def matching_line(data: dict[str, Any]) -> str | None:
    """One sentence on how good the depth by matching was; None when it was not measured."""
    found = data["matching"]
    if not isinstance(found, dict) or found.get("median_rel") is None:
        return None
    text = (
        f"Depth by matching, training views: {_percent(found['median_rel'])} median relative error on {words.share(found['coverage'])} of"
        " the pixels with a known depth"
    )
    if found.get("median_rel_textured") is not None:
        text += f"; where there is texture {_percent(found['median_rel_textured'])} on {words.share(found['coverage_textured'])}"
    return text + "."


def _mesh(methods: Sequence[dict[str, Any]]) -> list[Row]:
    return [
        *_row("Triangles", methods, ("mesh", "triangles"), words.whole),
        *_row("Separate parts", methods, ("mesh", "components"), words.whole),
    ]
