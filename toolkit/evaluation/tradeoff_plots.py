"""Plots of quality against cost as PNG: every method a curve, single steps beside it, the Pareto front marked."""

from __future__ import annotations

import io
import warnings
from collections.abc import Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from fieldfuse.evaluation import words
from fieldfuse.evaluation.tradeoff import MEASURES, METHODS, Point, pareto, series

COLOURS = {"field": "#1763c6", "field_per_sample": "#7a4fc4", "direct": "#1d8a5a", "tsdf": "#c2570c", "tsdf_stereo": "#c2570c"}
MARKERS = {"field": "o", "field_per_sample": "D", "direct": "^", "tsdf": "s", "tsdf_stereo": "s"}
CURVES = {"field": "iterations", "field_per_sample": "iterations", "direct": "keyframes", "tsdf": "voxel_size", "tsdf_stereo": "voxel_size"}
INK, QUIET, LINE, FRONT = "#18212c", "#5c6979", "#dfe5eb", "#18212c"
COST_TITLES = {"seconds": "seconds that the method alone takes", "memory_mb": "memory beyond the libraries"}
SIZE = (7.2, 4.6)
DPI = 130
METADATA = {"Software": None}


def quality_plot(points: Sequence[Point], cost: str, measure: str) -> bytes | None:
    """A PNG of `measure` over `cost` (log axis) with error bars over seeds; None when fewer than two points have both.

    Curves join the points of a method's main axis (fitting time, voxel size, key frames); hollow marks are steps along other axes. The
    dark line is the Pareto front.
    """
    known = [point for point in points if cost in point.mean and measure in point.mean and point.mean[cost] > 0]
    if len(known) < 2:
        return None
    figure = Figure(figsize=SIZE, layout="constrained", facecolor="white")
    axes = figure.add_subplot()
    _frame(axes, cost, measure, _reach(known, cost))
    front = pareto(known, cost, measure)
    axes.step(
        [point.mean[cost] for point in front],
        [point.mean[measure] for point in front],
        where="post",
        color=FRONT,
        linewidth=1.0,
        linestyle=(0, (4, 2)),
        alpha=0.75,
        label="Pareto front",
        zorder=2,
    )
    curves = _curves(known)
    for method in dict.fromkeys(point.method for point in known):
        _method(axes, method, curves.get(method, []), [point for point in known if point.method == method], cost, measure)
    axes.scatter(
        [point.mean[cost] for point in front],
        [point.mean[measure] for point in front],
        s=110,
        facecolors="none",
        edgecolors=FRONT,
        linewidths=1.1,
        zorder=5,
    )
    figure.legend(frameon=False, fontsize=9, labelcolor=INK, loc="outside upper left", ncols=3, columnspacing=1.6)  # never over marks
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        figure.savefig(buffer, format="png", dpi=DPI, metadata=METADATA)
    return buffer.getvalue()


def _reach(points: Sequence[Point], cost: str) -> list[float]:
    """Costs with the ends of their error bars, where those are above zero."""
    ends = [point.mean[cost] + sign * point.spread.get(cost, 0.0) for point in points for sign in (-1, 0, 1)]
    return [value for value in ends if value > 0]


def _curves(points: Sequence[Point]) -> dict[str, list[Point]]:
    """Method → the longest series along its main axis."""
    out: dict[str, list[Point]] = {}
    for axis, line in series(points):
        method = line[0].method
        if CURVES[method] == axis and len(line) > len(out.get(method, [])):
            out[method] = line
    return out


def _method(axes: Axes, method: str, curve: Sequence[Point], points: Sequence[Point], cost: str, measure: str) -> None:
    """The curve with error bars, and the method's other points as hollow marks."""
    colour, marker = COLOURS[method], MARKERS[method]
    if curve:
        x, y = ([point.mean[key] for point in curve] for key in (cost, measure))
        dx, dy = ([point.spread.get(key, 0.0) for point in curve] for key in (cost, measure))
        joined = "-" if x in (sorted(x), sorted(x, reverse=True)) else "none"  # a line back and forth would say nothing
        shown: dict[str, Any] = {
            "linestyle": joined,
            "color": colour,
            "marker": marker,
            "markersize": 5,
            "linewidth": 1.8,
            "label": METHODS[method],
            "zorder": 3,
        }
        axes.errorbar(x, y, xerr=dx if any(dx) else None, yerr=dy if any(dy) else None, capsize=2.5, elinewidth=1, **shown)
    rest = [point for point in points if point not in curve]
    if rest:
        label = f"{METHODS[method]}, other settings" if curve else METHODS[method]
        axes.scatter(
            [point.mean[cost] for point in rest],
            [point.mean[measure] for point in rest],
            s=26,
            marker=marker,
            facecolors="none",
            edgecolors=colour,
            linewidths=1.2,
            label=label,
            zorder=4,
        )


def _frame(axes: Axes, cost: str, measure: str, values: Sequence[float]) -> None:
    title, unit, _, larger = MEASURES[measure]
    axes.set_xscale("log")
    for name, spine in axes.spines.items():
        spine.set_visible(name in ("left", "bottom"))
        spine.set_color(LINE)
    axes.grid(color=LINE, linewidth=0.7)
    axes.set_axisbelow(True)
    axes.tick_params(colors=QUIET, labelsize=9, which="both", length=0)
    text = _seconds if cost == "seconds" else _memory
    wide = max(values) / min(values) > 8
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0) if wide else (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: text(value)))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlim(min(values) / 1.25, max(values) * 1.25)
    axes.margins(y=0.08)
    axes.set_xlabel(COST_TITLES[cost], color=QUIET, fontsize=9.5)
    axes.set_ylabel(
        f"{title}{f' ({unit})' if unit else ''} on test views, {'higher' if larger else 'lower'} is better", color=QUIET, fontsize=9.5
    )


def _seconds(value: float) -> str:
    return f"{value:g} s" if value < 60 else f"{value / 60:g} min" if value % 60 == 0 else f"{value:g} s"


def _memory(value: float) -> str:
    return words.memory(value)
