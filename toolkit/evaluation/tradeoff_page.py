"""What `fieldfuse tradeoff` leaves: `tradeoff.json`, `tradeoff.csv`, plots as PNG, and `tradeoff.html` with all of it."""

from __future__ import annotations

import csv
import io
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from fieldfuse.evaluation import words
from fieldfuse.evaluation.page import render, uri
from fieldfuse.evaluation.report import write_page
from fieldfuse.evaluation.tradeoff import (
    AXES,
    COSTS,
    MEASURES,
    METHODS,
    NUMBERS,
    Point,
    front_sentence,
    in_order,
    pareto,
    points_of,
    sentence,
    series,
    setting_text,
    steps,
    tradeoff_data,
)
from fieldfuse.files import atomic_path

# Method → colour, marker, and the axis whose points a curve joins.
STYLES = {
    "field": ("#1763c6", "o", "iterations"),
    "field_per_sample": ("#7a4fc4", "D", "iterations"),
    "direct": ("#1d8a5a", "^", "keyframes"),
    "tsdf": ("#c2570c", "s", "voxel_size"),
    "tsdf_stereo": ("#c2570c", "s", "voxel_size"),
}
INK, QUIET, LINE = "#18212c", "#5c6979", "#dfe5eb"
COST_TITLES = {"seconds": "seconds that the method alone takes", "memory_mb": "memory beyond the libraries"}

Plots = dict[tuple[str, str], bytes]  # measure, cost → PNG


def write_tradeoff(folder: Path | str, data: dict[str, Any]) -> dict[str, Any]:
    """Write all of it into `folder`; answers the data in its fixed form.

    Raises:
        InputError: a row is not a measured point.
        OutputError: the folder is not writable or the disk is full.
    """
    folder, data = Path(folder), tradeoff_data(data)
    points = points_of(data["rows"])
    files, plots = {"tradeoff.csv": csv_text(data["rows"]).encode()}, Plots()
    for measure in MEASURES:
        for cost, title in COSTS.items():
            if (plot := quality_plot(points, cost, measure)) is not None:
                plots[measure, cost] = files[f"tradeoff/{measure}_over_{title}.png"] = plot
    for name, content in files.items():
        with atomic_path(folder / name) as temporary:
            temporary.write_bytes(content)
    write_page(folder, "tradeoff", data, render_tradeoff(data, points, plots))
    return data


def csv_text(rows: Sequence[dict[str, Any]]) -> str:
    """One line a row: method, setting, seed, seconds by stage, memory, size, scores, load; empty where not known."""
    stages = list(dict.fromkeys(stage for row in rows for stage in row["stages"]))
    settings = [*AXES, "resolution"]
    head = ["id", "method", "axes", *settings, "seed", *(f"seconds_{stage}" for stage in stages), *NUMBERS]
    head += ["load_before", "load_after", "error"]
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(head)
    for row in rows:
        cells = [row["id"], row["method"], " ".join(row["axes"]), *(row["setting"].get(key) for key in settings), row["seed"]]
        cells += [row["stages"].get(stage) for stage in stages]
        cells += [*(row[key] for key in NUMBERS), *[*(row["load"] or []), None, None][:2], row["error"]]
        writer.writerow([float(f"{cell:.6g}") if isinstance(cell, float) else cell for cell in cells])
    return out.getvalue()


def render_tradeoff(data: dict[str, Any], points: Sequence[Point], plots: Plots) -> str:
    """The page as text. `data` as `tradeoff_data` answers it."""
    unit = data["unit"] or "units"
    sections = []
    for measure, about in MEASURES.items():
        shown = [(f"{about.title} over {title}", uri("png", plots[measure, c])) for c, title in COSTS.items() if (measure, c) in plots]
        sections += [(about.title, shown)] if shown else []
    notes = list(data["warnings"])
    if missing := data["left_out"]:
        are = "setting is" if len(missing) == 1 else "settings are"
        notes.append(f"{len(missing)} {are} not measured yet ({', '.join(missing)}); the same command goes on.")
    notes += [f"{METHODS[row['method']]} ({row['id']}): {row['error']}" for row in data["rows"] if row["error"] is not None]
    headline = []
    for method, title in METHODS.items():
        if front := pareto([point for point in points if point.method == method]):
            best = front[-1].mean
            headline.append((words.decimal(best["psnr"], 1), f"dB in {words.duration(best['seconds'])}", f"{title}, at its best"))
    by_axis = {axis: [sentence(step, unit) for step in steps(points) if step[0] == axis] for axis in AXES}
    fronts = {cost: {point.id for point in pareto(points, cost)} for cost in COSTS}
    rows = [
        {
            "title": METHODS[point.method],
            "setting": setting_text(point, unit),
            "seeds": point.seeds,
            "mean": {**dict.fromkeys(NUMBERS), **point.mean},
            "spread": point.spread,
            "front": [title for cost, title in COSTS.items() if point.id in fronts[cost]],
        }
        for point in in_order(points)
    ]
    loads = [value for row in data["rows"] for value in row["load"] or [] if value is not None]
    return render(
        "tradeoff.html.j2",
        data,
        "Trade-off",
        warnings=notes,
        headline=headline,
        sentences=[text for cost in COSTS if (text := front_sentence(points, cost, unit)) is not None],
        sections=sections,
        steps=[(AXES[axis][0], texts) for axis, texts in by_axis.items() if texts],
        rows=rows,
        depth=any("depth_error" in point.mean for point in points),
        shared=sum(stage["seconds"] or 0 for stage in data["stages"]),
        loads=(min(loads), max(loads)) if loads else None,
    )


def quality_plot(points: Sequence[Point], cost: str, measure: str) -> bytes | None:
    """A PNG of `measure` over `cost` (log axis) with error bars over seeds; None when fewer than two points have both.

    Curves join the points of a method's main axis (fitting time, voxel size, key frames); hollow marks are steps along other axes. The
    dark line is the Pareto front.
    """
    known = [point for point in points if cost in point.mean and measure in point.mean and point.mean[cost] > 0]
    if len(known) < 2:
        return None

    def at(some: Sequence[Point]) -> tuple[list[float], list[float]]:
        return [point.mean[cost] for point in some], [point.mean[measure] for point in some]

    figure = Figure(figsize=(7.2, 4.6), layout="constrained", facecolor="white")
    axes = figure.add_subplot()
    ends = [point.mean[cost] + sign * point.spread.get(cost, 0.0) for point in known for sign in (-1, 0, 1)]
    _frame(axes, cost, measure, [value for value in ends if value > 0])
    front = at(pareto(known, cost, measure))
    dashed: dict[str, Any] = {"linewidth": 1.0, "linestyle": (0, (4, 2)), "alpha": 0.75, "label": "Pareto front"}
    axes.step(*front, where="post", color=INK, zorder=2, **dashed)
    for method in dict.fromkeys(point.method for point in known):
        colour, marker, axis = STYLES[method]
        curve = max((line for along, line in series(known) if along == axis and line[0].method == method), key=len, default=[])
        if curve:
            x, y = at(curve)
            dx, dy = ([point.spread.get(key, 0.0) for point in curve] for key in (cost, measure))
            joined = "-" if x in (sorted(x), sorted(x, reverse=True)) else "none"  # a line back and forth would say nothing
            line: dict[str, Any] = {"linestyle": joined, "color": colour, "marker": marker, "markersize": 5, "linewidth": 1.8, "zorder": 3}
            bars: dict[str, Any] = {"xerr": dx if any(dx) else None, "yerr": dy if any(dy) else None}
            axes.errorbar(x, y, **bars, capsize=2.5, elinewidth=1, label=METHODS[method], **line)
        if rest := [point for point in known if point.method == method and point not in curve]:
            hollow: dict[str, Any] = {"facecolors": "none", "edgecolors": colour, "linewidths": 1.2, "zorder": 4}
            axes.scatter(*at(rest), s=26, marker=marker, label=METHODS[method] + (", other settings" if curve else ""), **hollow)
    axes.scatter(*front, s=110, facecolors="none", edgecolors=INK, linewidths=1.1, zorder=5)
    figure.legend(frameon=False, fontsize=9, labelcolor=INK, loc="outside upper left", ncols=3, columnspacing=1.6)  # never over marks
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        figure.savefig(buffer, format="png", dpi=130, metadata={"Software": None})
    return buffer.getvalue()


def _frame(axes: Axes, cost: str, measure: str, values: Sequence[float]) -> None:
    axes.set_xscale("log")
    for name, spine in axes.spines.items():
        spine.set_visible(name in ("left", "bottom"))
        spine.set_color(LINE)
    axes.grid(color=LINE, linewidth=0.7)
    axes.set_axisbelow(True)
    axes.tick_params(colors=QUIET, labelsize=9, which="both", length=0)

    def seconds(value: float) -> str:
        return f"{value / 60:g} min" if value >= 60 and value % 60 == 0 else f"{value:g} s"

    wide = max(values) / min(values) > 8
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0) if wide else (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: seconds(value) if cost == "seconds" else words.memory(value)))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlim(min(values) / 1.25, max(values) * 1.25)
    axes.margins(y=0.08)
    axes.set_xlabel(COST_TITLES[cost], color=QUIET, fontsize=9.5)
    about = MEASURES[measure]
    title = f"{about.title} ({about.unit})" if about.unit else about.title
    better = "higher" if about.larger_is_better else "lower"
    axes.set_ylabel(f"{title} on test views, {better} is better", color=QUIET, fontsize=9.5)
