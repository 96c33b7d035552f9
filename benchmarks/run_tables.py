"""What `fieldfuse run`, `compare` and `tradeoff` leave as sections of Markdown.

Runs are one table: a row a setting, seeds side by side, with the commands that made them; or, of a total budget, seconds wanted, predicted
and real. A comparison has a row a measure and a column a method. A trade-off has its Pareto front in a sentence, points and curves, steps.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

from benchmarks.experiment import Row, markdown
from fieldfuse.evaluation import words
from fieldfuse.evaluation.budget import AGREES
from fieldfuse.evaluation.compare import compare_data, matching_line
from fieldfuse.evaluation.compare import table as compared
from fieldfuse.evaluation.page import short_name
from fieldfuse.evaluation.tradeoff import METHODS, Point, front_sentence, in_order, pareto, points_of, sentence, setting_text, steps

HEAD = ("capture", "views", "pixels", "how", "PSNR", "SSIM", "LPIPS", "nearest image", "field made in", "peak memory", "whole run")
PLAIN = ("images", "frames", "photos")
MAKING = ("network", "direct", "field")
SCORELESS = ("export.", "tsdf.enabled")  # settings that change no score


def is_report(found: Any) -> bool:
    """Whether it is what a run leaves in `report.json`."""
    return isinstance(found, dict) and {"evaluation", "timeline", "stages", "settings"} <= found.keys()


def run_table(reports: Sequence[dict[str, Any]], commands: Sequence[str]) -> str:
    """A section of Markdown. `reports` as `report.json` holds them, with the command of each."""
    rows: dict[tuple[str, ...], list[dict[str, Any]]] = {}
    for data in reports:
        rows.setdefault((_capture(data), _views(data), _pixels(data), _how(data)), []).append(data)
    with_surface = set()  # captures whose surface has its row
    lines = []
    for key, group in rows.items():
        nearest = (group[0]["evaluation"].get("nearest_image") or {}).get("psnr")
        whole = [_each(group, _making, words.duration), _each(group, _peak, words.memory)]
        whole.append(_each(group, lambda data: data["seconds_total"], words.duration))
        lines.append([*key, *_scores(group, "field"), words.decimal(nearest, 1), *whole])
        if group[0]["evaluation"].get("tsdf") and key[:3] not in with_surface:
            with_surface.add(key[:3])
            lines.append([*key[:3], "its TSDF", *_scores(group[:1], "tsdf"), words.decimal(nearest, 1), "", "", ""])
    days = sorted({str(data["created"])[:10] for data in reports})
    when = days[0] if len(days) == 1 else f"{days[0]} to {days[-1]}"
    return f"Measured {when}, {_machine(reports)}:\n\n{markdown(HEAD, lines)}\n{_by(commands)}"


def _by(commands: Sequence[str]) -> str:
    return "By:\n\n" + "".join(f"    {one}\n" for one in commands)


def _each(group: Sequence[dict[str, Any]], value: Callable[[dict[str, Any]], Any], text: Callable[[Any], str]) -> str:
    """What each run of the group has, once where all have the same."""
    return ", ".join(dict.fromkeys(text(value(data)) for data in group))


def _scores(group: Sequence[dict[str, Any]], what: str) -> list[str]:
    """PSNR, SSIM and LPIPS, one after the other for each run; where there is surface in part only, PSNR on it too."""
    found = [data["evaluation"].get(what) or {} for data in group]
    cells = [", ".join(words.decimal(one.get(key), digits) for one in found) for key, digits in (("psnr", 1), ("ssim", 3), ("lpips", 3))]
    masked, coverage = found[0].get("psnr_masked"), found[0].get("coverage")
    if masked is not None and coverage is not None:
        cells[0] += f" ({masked:.1f} on the {100 * coverage:.0f}% where it has surface)"
    return cells


def _capture(data: dict[str, Any]) -> str:
    """The last part of its path; for a name like `images` the one before, too."""
    name = short_name(data["source"])
    before = short_name(str(data["source"]).rstrip("/").removesuffix(name)) if name in PLAIN else ""
    return f"{before}/{name}" if before else name


def _views(data: dict[str, Any]) -> str:
    return f"{data['views']['total'] - data['views']['test']} / {data['views']['test']}"


def _pixels(data: dict[str, Any]) -> str:
    return f"{data['views']['width']}×{data['views']['height']}"


def _how(data: dict[str, Any]) -> str:
    """Seconds, threads, and settings that were given."""
    settings = data["settings"]
    threads = settings.get("threads")
    parts = [f"{settings['fit']['budget']:g} s" if settings["fit"]["finetune"] else "networks alone"]
    if settings["engine"] != "auto":
        parts.append(f"engine {settings['engine']}")
    if threads is not None:
        parts.append("one thread" if threads == 1 else f"{threads} threads")
    given = shlex.split(str(data["command"]))
    pairs = [value for name, value in pairwise(given) if name == "--set" and not value.startswith(SCORELESS)]
    return ", ".join([*parts, *(f"`{pair}`" for pair in pairs)])


def _making(data: dict[str, Any]) -> float:
    """Seconds of the stages that make the field: matching and fitting, and the networks where they took part."""
    return float(sum(stage["seconds"] for stage in data["stages"] if stage["name"] in MAKING))


def _peak(data: dict[str, Any]) -> float | None:
    return max((stage["peak_memory_mb"] for stage in data["stages"] if stage.get("peak_memory_mb") is not None), default=None)


def _machine(reports: Sequence[dict[str, Any]]) -> str:
    """Interpreter and device."""
    machines = {f"Python {data['machine']['python']}, device {data['machine']['device']}" for data in reports}
    return "; ".join(sorted(machines))


BUDGET_HEAD = ("capture", "wanted", "predicted", "real", "off by", "effects", "fit", "chosen", "PSNR")


def budget_table(reports: Sequence[dict[str, Any]], commands: Sequence[str]) -> str:
    """A section of Markdown. `reports` as `report.json` of runs with `--total-budget` holds them, with the command of each."""
    lines, within = [], 0
    for data in sorted(reports, key=lambda data: (short_name(data["source"]), data["budget"]["asked_seconds"])):
        budget = data["budget"]
        off = budget["real_seconds"] / budget["predicted_seconds"] - 1
        within += abs(off) <= AGREES
        lines.append(_budget_cells(data, budget, off))
    what = f"{within} of {len(lines)} runs took what was predicted, within {100 * AGREES:.0f}%:"
    return f"{what}\n\n{markdown(BUDGET_HEAD, lines)}\n{_by(commands)}"


def _budget_cells(data: dict[str, Any], budget: dict[str, Any], off: float) -> list[str]:
    choice, stages = budget["choice"], budget["stages"]
    video = f"{choice['video_frames']} video frames" if choice.get("video_frames") else "no video"
    made = [video, *(f"no {extra}" for extra in ("texture", "page") if choice.get(extra) is False)]
    effects = stages.get("effects", {}).get("real")
    score = ((data.get("evaluation") or {}).get("field") or {}).get("psnr")
    return [
        short_name(data["source"]),
        f"{budget['asked_seconds']:g} s",
        f"{budget['predicted_seconds']:.1f} s",
        f"{budget['real_seconds']:.1f} s",
        f"{100 * off:+.0f}%".replace("-", "−"),
        "not looked for" if choice.get("effects") is False else words.duration(effects),
        f"{choice['fit_seconds']:.1f} s",
        f"{choice['image_size']} pixels, {choice['resolution']}³, {', '.join(made)}",
        words.decimal(score, 1),
    ]


def compare_table(data: Row) -> str:
    """Every measure a row, every method a column, the best marked. `data` as `compare.json` holds it."""
    data = compare_data(data)
    titles = [method["title"] for method in data["methods"]]
    lines = []
    for group, rows in compared(data):
        lines.append([f"**{group}**", *[""] * len(titles)])
        for row in rows:
            cells = [f"**{cell.text}**" if cell.best else cell.text for cell in row.cells]
            lines.append([f"{row.label} ({row.note})" if row.note else row.label, *cells])
    matching = matching_line(data)
    return markdown(["", *titles], lines) + ("" if matching is None else f"\n{matching}\n")


def tradeoff_table(data: Row) -> str:
    """The front in a sentence, points and every method's curve in one table, the steps. `data` as `tradeoff.json` holds it."""
    points, unit = points_of(data["rows"]), data["unit"] or "units"
    fronts = [{point.id for point in pareto(points, cost)} for cost in ("seconds", "memory_mb")]
    depth = any("depth_error" in point.mean for point in points)
    text = [f"{line}\n" for cost in ("seconds", "memory_mb") if (line := front_sentence(points, cost, unit)) is not None]
    head = ["method", "setting", "time", "memory", "on disk", "PSNR", "SSIM", "LPIPS", *(["depth error"] if depth else []), "unbeaten in"]
    text.append(markdown(head, (_point_cells(point, fronts, depth, unit) for point in in_order(points) if not point.shown_otherwise)))
    text += [f"- {sentence(step, unit)}" for step in steps(points)]
    if data.get("left_out"):
        text.append(f"- Not measured for want of time: {', '.join(name.removesuffix('-seed0') for name in data['left_out'])}.")
    return "\n".join([*text, *(f"- {line}" for line in data.get("refused") or [])])


def mean_load(data: Row) -> dict[str, Any]:
    """The machine with the mean load while points were measured, which says more than that at the end."""
    loads = [value for row in data["rows"] for value in row["load"] or [] if value is not None]
    return {**data["machine"], **({"load": sum(loads) / len(loads)} if loads else {})}


def _point_cells(point: Point, fronts: list[set[str]], depth: bool, unit: str) -> list[str]:
    mean = point.mean
    spread = f" ±{point.spread['psnr']:.2f}" if point.seeds > 1 and "psnr" in point.spread else ""
    unbeaten = [what for what, front in zip(("time", "memory"), fronts, strict=True) if point.id in front]
    return [
        METHODS[point.method],
        setting_text(point, unit),
        words.duration(mean.get("seconds")),
        words.memory(mean.get("memory_mb")),
        words.size(mean.get("disk_bytes")),
        words.decimal(mean.get("psnr"), 2) + spread,
        words.decimal(mean.get("ssim"), 3),
        words.decimal(mean.get("lpips"), 3),
        *([words.share(mean.get("depth_error"))] if depth else []),
        ", ".join(unbeaten),
    ]
