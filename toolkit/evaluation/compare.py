"""What `compare.json` holds, and the one table that it becomes: a row a measure, a column a method."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from fieldfuse.errors import InputError
from fieldfuse.evaluation import words
from fieldfuse.evaluation.geometry import VOXELS
from fieldfuse.evaluation.report import STAGE, part, parts, plain, whole

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
        stages = parts(method.get("stages"), STAGE, "stages")
        seconds = [stage["seconds"] for stage in stages if stage["seconds"] is not None]
        memory = [stage["peak_memory_mb"] for stage in stages if stage["peak_memory_mb"] is not None]
        known = {"seconds": round(sum(seconds), 3) if seconds else None, "peak_memory_mb": max(memory) if memory else None}
        out.append({**dict.fromkeys(METHOD + RESULTS), **method, "stages": stages, **known})
    truth = part(data.get("truth"), TRUTH, "truth")
    return whole(data, truth=truth, methods=out, matching=data.get("matching"), machine=data.get("machine") or {})


def table(data: dict[str, Any]) -> list[tuple[str, list[Row]]]:
    """Groups of rows; rows that no method has a number for are left out. `data` as `compare_data` answers it."""
    methods = data["methods"]
    unit = data["truth"]["unit"] or "units"

    def row(label: str, path: str, show: Callable[[Any], str], better: Any = None, note: str = "") -> list[Row]:
        return _row(methods, label, path, show, better, note)

    def images(within: str, note: str = "") -> list[Row]:
        out = [
            *row("PSNR (dB) ↑", f"score {within} psnr", words.decimal, max),
            *row("SSIM ↑", f"score {within} ssim", lambda value: words.decimal(value, 3), max),
            *row("LPIPS ↓", f"score {within} lpips", lambda value: words.decimal(value, 3), min),
        ]
        return [replace(one, note=note if place == 0 else "") for place, one in enumerate(out)]

    by_stage = [{stage["name"]: stage["seconds"] for stage in method["stages"]} for method in methods]
    cost = [
        *row("Time to make it", "seconds", words.duration, min, "with its test views, after the shared stages"),
        *(
            Row(f"· stage {name}", "", [Cell(words.duration(known.get(name))) for known in by_stage])
            for name in dict.fromkeys(name for known in by_stage for name in known)
        ),
        *row("Time for its mesh besides", "mesh_seconds", words.duration),
        *row("Time to render a test view", "score seconds_per_view", words.duration, min),
        *row("Peak memory", "peak_memory_mb", words.memory, min, "of the whole process during its stages"),
        *row("Size on disk", "disk_bytes", words.size, min, "what rendering needs"),
        *row("Size in memory", "memory_bytes", words.size, min),
    ]
    paths = ("score depth_scale", "geometry voxel_size")
    scale, voxel = (next((value for m in methods if (value := _at(m, path)) is not None), None) for path in paths)
    against = {"exact": "the exact depth", "sensor": "the depth sensor"}.get(str(data["truth"]["depth"]), "the true depth")
    depth = [
        *row("Mean error ↓", "score abs_err", _percent, min, "" if scale is None else f"of the median depth, {words.significant(scale)}"),
        *row("Within 1% ↑", "score acc_1", words.share, max, "what is missing counts as wrong"),
        *row("Within 5% ↑", "score acc_5", words.share, max),
        *row("Median relative error ↓", "score depth median_rel", _percent, min, "where there is depth"),
        *row("Pixels with depth ↑", "score depth coverage", words.share, max),
    ]
    geometry = [
        *row(f"Accuracy ({unit}) ↓", "geometry accuracy", words.significant, min, "mean distance from mesh to truth"),
        *row(f"Completeness ({unit}) ↓", "geometry completeness", words.significant, min, "mean distance from truth to mesh"),
    ]
    for n in VOXELS:
        note = f"{words.significant(n * voxel)} {unit}" if voxel is not None else ""
        geometry += row(f"F-score at {n} voxel{'' if n == 1 else 's'} ↑", f"geometry f_score_{n}", words.share, max, note)
    geometry += row("Normals off by ↓", "geometry normals", _degrees, min, "in the mean, within 4 voxels of the truth")
    surfaces = [m for m in methods if not m["reference"] and m["key"] in (_at(m, "score on") or {})]  # those that leave pixels empty
    groups = [
        ("Cost", cost),
        ("Pictures of test views, whole", images("")),
        *((f"The same where {m['title']} shows surface", images(f"on {m['key']}", _of_pixels(m))) for m in surfaces),
        (f"Depth of test views against {against}", depth),
        ("Mesh against the true surface that the cameras saw", geometry),
        ("Mesh", [*row("Triangles", "mesh triangles", words.whole), *row("Separate parts", "mesh components", words.whole)]),
    ]
    return [(title, rows) for title, rows in groups if rows]


def _at(method: dict[str, Any], path: str) -> Any:
    value: Any = method
    for key in path.split():
        value = value.get(key) if isinstance(value, dict) else None
    return value


def _row(methods: Sequence[dict[str, Any]], label: str, path: str, show: Callable[[Any], str], better: Any, note: str) -> list[Row]:
    """One row, or none when no method has the number; the best is marked when at least two have it and they differ."""
    values = [_at(method, path) for method in methods]
    if all(value is None for value in values):
        return []
    rivals = [value for value, method in zip(values, methods, strict=True) if value is not None and not method["reference"]]
    # What reads the same is equally good.
    best = show(better(rivals)) if better is not None and len({show(value) for value in rivals}) > 1 else None
    marks = [value is not None and not method["reference"] and show(value) == best for value, method in zip(values, methods, strict=True)]
    return [Row(label, note, [Cell(show(value), mark) for value, mark in zip(values, marks, strict=True)])]


def _of_pixels(method: dict[str, Any]) -> str:
    return f"{words.share(_at(method, 'score coverage'))} of the pixels"


def _percent(value: float | None) -> str:
    return words.NONE if value is None else f"{100 * value:.2f}%"


def _degrees(value: float | None) -> str:
    return words.NONE if value is None else f"{value:.1f}°"


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
