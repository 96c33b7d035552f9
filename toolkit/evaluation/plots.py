"""Plots of the report as SVG text, drawn by matplotlib without a window system.

Colours are written as CSS variables with a fallback, so a plot inside the report follows its light or dark page, and alone it is light.
Text stays text. Nothing in the SVG refers to anything outside it.
"""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fieldfuse.evaluation.words import duration, memory

# Colours that matplotlib draws with → what stands in the SVG.
INK, QUIET, LINE, ACCENT, SECOND, PALE = "#010101", "#020202", "#030303", "#040404", "#050505", "#060606"
CSS = {
    INK: "var(--ink, #1c2430)",
    QUIET: "var(--quiet, #5d6b7c)",
    LINE: "var(--line, #d9e0e8)",
    ACCENT: "var(--accent, #1769d2)",
    SECOND: "var(--second, #b4540a)",
    PALE: "var(--pale, #a9c3e6)",
}
SANS = "system-ui, -apple-system, 'Segoe UI', 'Helvetica Neue', Arial, sans-serif"
LONGEST_NAME = 24  # letters
LABEL_LONG, LABEL_TALL = 0.35, 0.1  # shares of the axes that the name of a level takes, with what keeps it clear of its line
METADATA: dict[str, Any] = dict.fromkeys(("Creator", "Date", "Format", "Type"))


def _figure(width: float, height: float) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(width, height), layout="constrained")
    axes = figure.add_subplot()
    figure.patch.set_alpha(0)
    axes.patch.set_alpha(0)
    for name, spine in axes.spines.items():
        spine.set_visible(name in ("left", "bottom"))
        spine.set_color(LINE)
    axes.tick_params(colors=QUIET, labelsize=9.5, length=0, pad=5)
    axes.set_axisbelow(True)
    return figure, axes


def _svg(figure: Figure, title: str, salt: str) -> str:
    """The figure as an SVG element that fills the width it is given."""
    buffer = io.StringIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": salt, "font.family": "sans-serif"}), warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # letters that matplotlib's own font lacks are drawn by the browser
        figure.savefig(buffer, format="svg", metadata=METADATA)
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    head, body = text.split(">", 1)
    view = re.search(r'viewBox="[^"]+"', head)
    assert view is not None
    head = f'<svg xmlns="http://www.w3.org/2000/svg" {view[0]} width="100%" role="img" aria-label="{title}"'
    body = body.replace("xlink:href=", "href=")
    body = re.sub(r'\bid="([^"]+)"', rf'id="{salt}-\1"', body)  # two plots on one page must not share names
    body = re.sub(r'(href="#|url\(#)', rf"\1{salt}-", body)
    body = re.sub(r"font-family: [^;\"]+", lambda _: f"font-family: {SANS}", body)
    body = re.sub(r"font: (\d[\d.]*px) [^;\"]+", lambda found: f"font: {found[1]} {SANS}", body)
    for colour, css in CSS.items():
        body = body.replace(colour, css)
    return f"{head}>{body}"


def psnr_over_time(timeline: list[dict[str, Any]], levels: dict[str, float | None] | None = None) -> str | None:
    """Held-out PSNR over seconds of fitting as an SVG element; None when fewer than two points are known.

    Args:
        timeline: entries with `seconds` and `psnr`.
        levels: name → PSNR of other methods, drawn as dashed lines.
    """
    points = [(entry["seconds"], entry["psnr"]) for entry in timeline if entry.get("seconds") is not None and entry.get("psnr") is not None]
    if len(points) < 2:
        return None
    seconds, values = zip(*sorted(points), strict=True)
    figure, axes = _figure(5, 2.9)
    axes.grid(axis="y", color=LINE, linewidth=0.8)
    axes.plot(seconds, values, color=ACCENT, linewidth=2, marker="o", markersize=3.5, solid_capstyle="round")
    axes.annotate(
        f"{values[-1]:.2f} dB",
        (seconds[-1], values[-1]),
        textcoords="offset points",
        xytext=(0, 7),
        ha="right",
        color=ACCENT,
        fontsize=10,
        weight="bold",
    )
    known = [(name, level) for name, level in (levels or {}).items() if level is not None]
    for _, level in known:
        axes.axhline(level, color=SECOND, linewidth=1.2, dashes=(4, 3))
    axes.margins(x=0.02, y=0.14)
    axes.set_xlim(left=0)
    for (name, level), (right, above) in zip(known, label_places(seconds, values, [level for _, level in known], axes), strict=True):
        end: dict[str, Any] = {"xycoords": ("axes fraction", "data"), "textcoords": "offset points", "xytext": (0, 4 if above else -4)}
        side: dict[str, Any] = {"ha": "right" if right else "left", "va": "bottom" if above else "top"}
        axes.annotate(f"{name} {level:.1f}", (right, level), color=SECOND, fontsize=9.5, **end, **side)
    axes.set_xlabel("seconds of fitting", color=QUIET, fontsize=9.5)
    axes.set_ylabel("PSNR on test views (dB)", color=QUIET, fontsize=9.5)
    return _svg(figure, "PSNR on test views over seconds of fitting", "time")


def label_places(seconds: Sequence[float], values: Sequence[float], levels: list[float], axes: Axes) -> list[tuple[bool, bool]]:
    """For the name of each level (at the right end, above its line): the first place that no curve, line or other text crosses."""
    (_, width), (low, high) = axes.get_xlim(), axes.get_ylim()
    tall = LABEL_TALL * (high - low)
    taken = [(True, values[-1] + tall / 3)]  # the curve's last value
    side = np.linspace(0, LABEL_LONG * width, 32)
    along = {True: width - side[::-1], False: side}
    out = []
    for level in levels:
        for right, above in ((True, True), (False, True), (True, False), (False, False)):
            bottom = level if above else level - tall
            curve = np.interp(along[right], seconds, values, left=np.nan, right=np.nan)
            lines = [other for other in levels if other != level and bottom < other < bottom + tall]
            names = [end for end, other in taken if end == right and abs(other - bottom) < tall]
            inside = low <= bottom and bottom + tall <= high
            if inside and not lines and not names and not ((curve > bottom) & (curve < bottom + tall)).any():
                break
        else:
            right, above, bottom = True, True, level
        taken.append((right, bottom))
        out.append((right, above))
    return out


def shown_name(stage: dict[str, Any]) -> str:
    """A stage's name, shortened so that the bars keep their room, and with no formula for matplotlib to find in it."""
    name = str(stage.get("name") or "")
    name = name if len(name) <= LONGEST_NAME else name[: LONGEST_NAME - 1] + "…"
    return name.replace("$", r"\$")


def bar_label(stage: dict[str, Any]) -> str:
    """Time and memory of a stage in a few words."""
    parts = [duration(stage["seconds"])]
    if stage.get("peak_memory_mb") is not None:
        parts.append(memory(stage["peak_memory_mb"]))
    if stage.get("cached"):
        parts.append("reused")
    return ", ".join(parts)


def stage_bars(stages: list[dict[str, Any]]) -> str | None:
    """Seconds of each stage as bars with its peak memory beside it, in their order, reused ones pale; None when no stage has seconds."""
    known = [stage for stage in stages if stage.get("seconds") is not None]
    if not known:
        return None
    figure, axes = _figure(5, 0.4 + 0.3 * len(known))
    seconds = [max(0.0, float(stage["seconds"])) for stage in known]
    places = list(range(len(known)))
    bars = axes.barh(places, seconds, color=[PALE if stage.get("cached") else ACCENT for stage in known], height=0.62)
    labels = [bar_label(stage) for stage in known]
    axes.bar_label(bars, labels=labels, padding=5, color=INK, fontsize=9.5)
    axes.set_yticks(places, labels=[shown_name(stage) for stage in known], color=INK)
    axes.invert_yaxis()
    axes.spines["bottom"].set_visible(False)
    axes.set_xticks([])
    axes.set_xlim(0, max(max(seconds), 1e-3) * 1.6)  # room for the labels
    return _svg(figure, "Seconds and peak memory by stage", "stages")
