"""Plots of the report as SVG text, drawn by matplotlib without a window system.

Colours are written as CSS variables with a fallback, so a plot inside the report follows its light or dark page, and alone it is light.
Text stays text. Nothing in the SVG refers to anything outside it.
"""

from __future__ import annotations

import io
import re
import warnings
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fieldfuse.evaluation import words

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
    known = {name: level for name, level in (levels or {}).items() if level is not None}
    for name, level in known.items():
        axes.axhline(level, color=SECOND, linewidth=1.2, dashes=(4, 3) if name == "TSDF" else (1, 2), label=f"{name} {level:.1f}")
    axes.margins(x=0.02, y=0.14)
    axes.set_xlim(left=0)
    if known:
        axes.legend(frameon=False, fontsize=9.5, labelcolor=SECOND, loc="best")  # where it covers no curve
    axes.set_xlabel("seconds of fitting", color=QUIET, fontsize=9.5)
    axes.set_ylabel("PSNR on test views (dB)", color=QUIET, fontsize=9.5)
    return _svg(figure, "PSNR on test views over seconds of fitting", "time")


def stage_bars(stages: list[dict[str, Any]]) -> str | None:
    """Seconds of each stage as bars with its peak memory beside it, in their order, reused ones pale; None when no stage has seconds."""
    known = [stage for stage in stages if stage.get("seconds") is not None]
    if not known:
        return None
    figure, axes = _figure(5, 0.4 + 0.3 * len(known))
    seconds = [max(0.0, float(stage["seconds"])) for stage in known]
    places = list(range(len(known)))
    bars = axes.barh(places, seconds, color=[PALE if stage.get("cached") else ACCENT for stage in known], height=0.62)
    labels, names = [], []
    for stage in known:
        memory = words.memory(stage["peak_memory_mb"]) if stage.get("peak_memory_mb") is not None else ""
        labels.append(", ".join(filter(None, (words.duration(stage["seconds"]), memory, "reused" if stage.get("cached") else ""))))
        name = str(stage.get("name") or "")
        name = name if len(name) <= LONGEST_NAME else name[: LONGEST_NAME - 1] + "…"
        names.append(name.replace("$", r"\$"))  # no formula for matplotlib to find
    axes.bar_label(bars, labels=labels, padding=5, color=INK, fontsize=9.5)
    axes.set_yticks(places, labels=names, color=INK)
    axes.invert_yaxis()
    axes.spines["bottom"].set_visible(False)
    axes.set_xticks([])
    axes.set_xlim(0, max(max(seconds), 1e-3) * 1.6)  # room for the labels
    return _svg(figure, "Seconds and peak memory by stage", "stages")
