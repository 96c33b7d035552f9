"""The learning curve: rows of numbers as CSV, and the same as a PNG with the health of the networks beside the PSNR."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from torch import Tensor, nn

from fieldfuse.errors import InputError, first_line
from fieldfuse.files import atomic_path
from fieldfuse.nerfusion.gru import FusionGRU
from fieldfuse.nerfusion.model import NerfusionModel

# Panels of the image: title, columns drawn in it (a column that no row has is left out), and whether the axis is logarithmic.
PANELS: tuple[tuple[str, tuple[str, ...], bool], ...] = (
    ("PSNR (dB)", ("psnr_local", "psnr_fused", "psnr_fused_1"), False),
    ("PSNR on held-out images of real captures (dB)", tuple(f"val_psnr_{n}" for n in ("local", "fused", "fused_1", "nearest")), False),
    ("log likelihood of the true depth", ("depth_likelihood", "val_depth_likelihood"), False),
    ("relative depth error (median)", ("depth_error", "val_depth_error"), False),
    ("spatial deviation of encoder features", ("feature_deviation",), False),
    ("share of saturated gates", ("gate_update_saturated", "gate_reset_saturated"), False),
    ("opacity of rays: share below ⅓, between, above ⅔", ("opacity_low", "opacity_middle", "opacity_high"), False),
    ("loss", ("loss", "loss_depth"), True),
    ("gradient norm, learning rate", ("gradient_norm", "rate"), True),
)
SMOOTH = 30  # rows that the drawn lines average over


class Curve:
    """Rows of one training run; appended to one at a time, rewritten whole so that a file is never half a row."""

    def __init__(self, folder: Path) -> None:
        self.path, self.picture = folder / "curve.csv", folder / "curve.png"
        self.rows: list[dict[str, float]] = []

    def load(self, until: int) -> None:
        """Read the rows up to step `until`, for going on from a checkpoint.

        Raises:
            InputError: the file is there but is not a learning curve.
        """
        if not self.path.is_file():
            return
        try:
            with self.path.open(encoding="utf-8", newline="") as file:
                rows = [{key: float(value) for key, value in row.items() if value} for row in csv.DictReader(file)]
            self.rows = [row for row in rows if row["step"] <= until]
        except (OSError, ValueError, KeyError, TypeError, AttributeError, csv.Error) as error:
            raise InputError(f"{self.path} is not a learning curve ({first_line(error)}); move it away") from error

    def add(self, row: dict[str, float]) -> None:
        """One more row; values that are not finite are left out. Nothing is written yet."""
        self.rows.append({key: float(value) for key, value in row.items() if math.isfinite(value)})

    def write(self) -> None:
        """Write both files.

        Raises:
            OutputError: the folder is not writable.
        """
        columns = list(dict.fromkeys(key for row in self.rows for key in row))
        with atomic_path(self.path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, columns)
            writer.writeheader()
            writer.writerows({key: f"{value:.7g}" for key, value in row.items()} for row in self.rows)
        draw_curve(self.rows, self.picture)


class GateWatch:
    """Shares of saturated values of the fusion's update and reset gates, read from the running GRU by hooks, without touching it.

    The update gate's known part (how many key frames a voxel was in) is not counted: what is watched is what was learned.
    """

    def __init__(self, model: NerfusionModel) -> None:
        self.on = False
        self._seen: dict[str, list[float]] = {}
        if isinstance(model.fusion, FusionGRU):
            for name in ("update", "reset"):
                getattr(model.fusion, name).register_forward_hook(self._hook(f"gate_{name}_saturated"))

    def _hook(self, name: str) -> Any:
        def look(_module: nn.Module, inputs: tuple[Any, ...], output: Tensor) -> None:
            if self.on:
                inside = inputs[2]
                values = output.detach()[: len(inside)][inside]
                self._seen.setdefault(name, []).append(saturation(torch.sigmoid(values)))

        return look

    def shares(self) -> dict[str, float]:
        """Means since the last call; empty when no gate was used."""
        seen, self._seen = self._seen, {}
        return {name: sum(values) / len(values) for name, values in seen.items()}


def saturation(gate: Tensor) -> float:
    """Share of a gate's values within 0.01 of 0 or 1."""
    return float(((gate < 0.01) | (gate > 0.99)).float().mean()) if gate.numel() else 0.0


def smoothed(values: Sequence[float], window: int = SMOOTH) -> list[float]:
    """Trailing mean over up to `window` values; as many values as came in."""
    sums = np.concatenate([[0.0], np.cumsum(np.asarray(values, dtype=np.float64))])
    ends = np.arange(1, len(sums))
    starts = np.maximum(ends - window, 0)
    return ((sums[ends] - sums[starts]) / (ends - starts)).tolist()


def draw_curve(rows: Sequence[dict[str, float]], path: Path) -> None:
    """Draw all panels that have data, as a PNG.

    Raises:
        OutputError: it cannot be written.
    """
    known = {key for row in rows for key in row}
    panels = [panel for panel in PANELS if known & set(panel[1])] or [PANELS[0]]
    lines = -(-len(panels) // 2)
    figure = Figure(figsize=(10, 2.5 * lines), layout="constrained")
    FigureCanvasAgg(figure)
    stage_two = next((row["step"] for row in rows if row.get("stage") == 2.0), None)
    for number, (title, columns, logarithmic) in enumerate(panels):
        axes = figure.add_subplot(lines, 2, number + 1)
        for column in columns:
            points = [(row["step"], row[column]) for row in rows if column in row and (not logarithmic or row[column] > 0)]
            if not points:
                continue
            steps, values = zip(*points, strict=True)
            checked = column.startswith("val_")
            drawn = values if checked else smoothed(values)
            dots = "o" if checked or len(points) == 1 else None  # a line through one point is not seen
            axes.plot(steps, drawn, label=column.replace("_", " "), linewidth=1.3, marker=dots, markersize=3)
        if logarithmic:
            axes.set_yscale("log")
        if stage_two is not None and stage_two > 0:
            axes.axvline(stage_two, color="0.7", linewidth=0.8, linestyle="--")
        axes.set_title(title, fontsize=9)
        axes.set_xlabel("step", fontsize=8)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
        axes.tick_params(labelsize=8)
        axes.grid(color="0.9", linewidth=0.6)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(fontsize=7, frameon=False)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=80)
