"""What `fieldfuse tradeoff` leaves: `tradeoff.csv`, plots as PNG, and `tradeoff.html`: one file, no script, nothing from elsewhere."""

from __future__ import annotations

import base64
import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from fieldfuse import __version__
from fieldfuse.evaluation import words
from fieldfuse.evaluation.page import flat, short_name, subtitle
from fieldfuse.evaluation.report import CAPTURE, POSES, STAGE, plain
from fieldfuse.evaluation.templates import template
from fieldfuse.evaluation.tradeoff import AXES, COSTS, MEASURES, METHODS, NUMBERS, Point, checked_row, in_order, pareto, points_of
from fieldfuse.evaluation.tradeoff_plots import quality_plot
from fieldfuse.evaluation.tradeoff_text import AXIS_TITLES, Step, front_sentence, sentence, setting_text, steps
from fieldfuse.files import atomic_path, write_json

CSV = "tradeoff.csv"
JSON = "tradeoff.json"
HTML = "tradeoff.html"
PLOTS = "tradeoff"  # folder of the PNG files
TEMPLATE = "tradeoff.html.j2"
COST_WORDS = {"seconds": "time", "memory_mb": "memory"}


def tradeoff_data(data: dict[str, Any]) -> dict[str, Any]:
    """`data` in the fixed form of `tradeoff.json`, plain JSON; applying it twice changes nothing.

    Raises:
        InputError: a row is not a measured point.
    """
    data = plain(data)
    known = {
        "version": data.get("version") or __version__,
        **{key: data.get(key) for key in ("command", "created", "source", "unit", "scene")},
        "warnings": [str(warning) for warning in data.get("warnings") or []],
        "capture": {**dict.fromkeys(CAPTURE), **(data.get("capture") or {})},
        "poses": {**dict.fromkeys(POSES), **(data.get("poses") or {})},
        "stages": [{**dict.fromkeys(STAGE), **stage} for stage in data.get("stages") or []],
        "rows": [checked_row(row) for row in data.get("rows") or []],
        "left_out": [str(name) for name in data.get("left_out") or []],
        "refused": [str(text) for text in data.get("refused") or []],
        "settings": data.get("settings") or {},
        "machine": data.get("machine") or {},
    }
    return {**known, **{key: value for key, value in data.items() if key not in known}}


def csv_text(rows: Sequence[dict[str, Any]]) -> str:
    """One line a row: method, setting, seed, seconds by stage, memory, size, scores, load; empty where not known."""
    stages = list(dict.fromkeys(stage for row in rows for stage in row["stages"]))
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    settings = [*AXES, "resolution"]
    loads = ["load_before", "load_after"]
    writer.writerow(["id", "method", "axes", *settings, "seed", *(f"seconds_{stage}" for stage in stages), *NUMBERS, *loads, "error"])
    for row in rows:
        seconds = [_cell(row["stages"].get(stage)) for stage in stages]
        load = [*(row["load"] or []), None, None][:2]
        kept = [_cell(row["setting"].get(key)) for key in settings]
        numbers = [_cell(row[key]) for key in NUMBERS]
        writer.writerow(
            [row["id"], row["method"], " ".join(row["axes"]), *kept, row["seed"], *seconds, *numbers, *map(_cell, load), row["error"]]
        )
    return out.getvalue()


def _cell(value: Any) -> Any:
    return "" if value is None else float(f"{value:.6g}") if isinstance(value, float) else value


def write_tradeoff(folder: Path | str, data: dict[str, Any]) -> dict[str, Any]:
    """Write all of it into `folder`; answers the data in its fixed form.

    Raises:
        InputError: a row is not a measured point.
        OutputError: the folder is not writable or the disk is full.
    """
    folder = Path(folder)
    data = tradeoff_data(data)
    points = points_of(data["rows"])
    plots = {}
    for measure in MEASURES:
        for cost in COSTS:
            picture = quality_plot(points, cost, measure)
            if picture is not None:
                plots[measure, cost] = picture
                _write(folder / PLOTS / f"{measure}_over_{COST_WORDS[cost]}.png", picture)
    _write(folder / CSV, csv_text(data["rows"]).encode())
    write_json(folder / JSON, data)
    _write(folder / HTML, render_tradeoff(data, points, plots).encode())
    return data


def _write(path: Path, content: bytes) -> None:
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def render_tradeoff(data: dict[str, Any], points: Sequence[Point], plots: dict[tuple[str, str], bytes]) -> str:
    """The page as text. `data` as `tradeoff_data` answers it."""
    unit = data["unit"] or "units"
    sections = [
        (
            MEASURES[measure][0],
            [
                (f"{MEASURES[measure][0]} over {COST_WORDS[cost]}", png_uri(plots[measure, cost]))
                for cost in COSTS
                if (measure, cost) in plots
            ],
        )
        for measure in MEASURES
    ]
    fronts = {cost: {point.id for point in pareto(points, cost)} for cost in COSTS}
    loads = [value for row in data["rows"] for value in row["load"] or [] if value is not None]
    return template(TEMPLATE).render(
        data=data,
        title=short_name(data["source"]) or "Trade-off",
        subtitle=subtitle(data),
        headline=headline(points),
        sentences=[text for cost in COSTS if (text := front_sentence(points, cost, "psnr", unit)) is not None],
        sections=[(name, shown) for name, shown in sections if shown],
        steps=step_groups(steps(points), unit),
        rows=[point_row(point, fronts, unit) for point in in_order(points)],
        failed=[row for row in data["rows"] if row["error"] is not None],
        methods=METHODS,
        depth="depth_error" in {key for point in points for key in point.mean},
        shared=sum(stage["seconds"] or 0 for stage in data["stages"]),
        loads=(min(loads), max(loads)) if loads else None,
        settings=flat(data["settings"]),
    )


def png_uri(picture: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(picture).decode("ascii")


def headline(points: Sequence[Point]) -> list[tuple[str, str, str]]:
    """The large numbers on top: the best of each method."""
    out = []
    for method, title in METHODS.items():
        front = pareto([point for point in points if point.method == method])
        if front:
            best = front[-1]
            out.append((words.decimal(best.mean["psnr"], 1), f"dB in {words.duration(best.mean['seconds'])}", f"{title}, at its best"))
    return out


def step_groups(found: Sequence[Step], unit: str) -> list[tuple[str, list[str]]]:
    """Sentences under the titles of their axes."""
    return [(AXIS_TITLES[axis], same) for axis in AXES if (same := [sentence(step, unit) for step in found if step.axis == axis])]


def point_row(point: Point, fronts: dict[str, set[str]], unit: str) -> dict[str, Any]:
    """What the page's table shows of a point."""
    return {
        "title": METHODS[point.method],
        "setting": setting_text(point, unit),
        "seeds": point.seeds,
        "mean": {**dict.fromkeys(NUMBERS), **point.mean},
        "spread": point.spread,
        "front": [COST_WORDS[cost] for cost in COSTS if point.id in fronts[cost]],
    }
