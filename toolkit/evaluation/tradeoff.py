"""What accuracy costs: measured points gathered over seeds, the Pareto front, and what each step along an axis gains and takes, in words.

A row is one measurement (a method with one setting and one seed); a point is the mean of the rows that differ in nothing but the seed.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from fieldfuse.errors import InputError
from fieldfuse.evaluation import words
from fieldfuse.evaluation.report import plain, whole

# Axis → its title, and whether a larger value costs more.
AXES = {
    "iterations": ("Seconds of fitting", True),
    "voxel_size": ("Voxel size", False),
    "keyframes": ("Key frames", True),
    "views": ("Training views", True),
    "samples": ("Samples a voxel, when rendering", True),
    "decoder": ("Decoder", True),
    "precision": ("Precision of the stored field", True),
}
NAMES = {"decoder": ("deferred", "per_sample"), "precision": ("uint8", "float16", "float32")}  # values that are no numbers, by cost
PRECISION_TITLES = {"uint8": "8 bits", "float16": "16 bits", "float32": "32 bits"}
METHODS = {
    "field": "Field",
    "field_per_sample": "Field, decoder per sample",
    "direct": "Networks, not fitted",
    "tsdf": "TSDF",
    "tsdf_stereo": "TSDF of matched pictures",
}


class Measure(NamedTuple):
    """How a quality is called and written."""

    title: str
    unit: str
    digits: int
    larger_is_better: bool


MEASURES = {
    "psnr": Measure("PSNR", "dB", 2, True),
    "ssim": Measure("SSIM", "", 3, True),
    "lpips": Measure("LPIPS", "", 3, False),
    "depth_error": Measure("depth error", "", 4, False),
}
COSTS = {"seconds": "time", "memory_mb": "memory"}
SPENT = ("seconds", "seconds_per_view", "peak_memory_mb", "memory_mb", "disk_bytes")
NUMBERS = (*SPENT, *MEASURES, "coverage", "psnr_masked", "acc_1", "acc_5")
ROW = ("id", "method", "axes", "setting", "seed", "stages", "load", "measured", "error", *NUMBERS)
SAMPLES_A_VOXEL = 4  # `samples` counts them in a brick of four voxels along a ray


@dataclass(frozen=True)
class Point:
    """One setting of one method, over its seeds.

    Attributes:
        axes: those along which it is a step.
        setting: axis → value, None where the method does not have the axis.
        mean, spread: number → mean, and standard deviation over the seeds (0 with one); what is not known is missing.
        seeds: how many.
    """

    id: str
    method: str
    axes: tuple[str, ...]
    setting: dict[str, Any]
    mean: dict[str, float]
    spread: dict[str, float] = field(default_factory=dict)
    seeds: int = 1

    @property
    def shown_otherwise(self) -> bool:
        """The same result as another point's, only rendered or stored in another way: its cost is not in the making."""
        return self.axes in (("samples",), ("precision",))

    @property
    def wanted(self) -> dict[str, Any]:
        """The setting as it was planned, in shares of the automatic one."""
        return self.setting.get("wanted") or {}


def tradeoff_data(data: dict[str, Any]) -> dict[str, Any]:
    """`data` in the fixed form of `tradeoff.json`, plain JSON; applying it twice changes nothing.

    Raises:
        InputError: a row is not a measured point.
    """
    data = plain(data)
    lists = {key: [str(text) for text in data.get(key) or []] for key in ("left_out", "refused")}
    rows = [checked_row(row) for row in data.get("rows") or []]
    return whole(data, unit=data.get("unit"), rows=rows, machine=data.get("machine") or {}, **lists)


def checked_row(row: Any) -> dict[str, Any]:
    """A row in its fixed form: all of `ROW`, null when not known.

    Raises:
        InputError: it is not a table, or of an unknown method.
    """
    row = plain(row)
    if not isinstance(row, dict) or row.get("method") not in METHODS or not isinstance(row.get("setting"), dict):
        raise InputError("a measured point must be a table with `method` and `setting`; measure it again")
    known = {**dict.fromkeys(ROW), **row}
    return {**known, "axes": list(known["axes"] or []), "stages": dict(known["stages"] or {})}


def points_of(rows: Iterable[dict[str, Any]]) -> list[Point]:
    """Points in the order of their first row, without rows that failed."""
    groups: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        if row["error"] is None:
            groups.setdefault(row["id"], []).append(row)
    out = []
    for name, same in groups.items():
        known = {key: [float(row[key]) for row in same if row[key] is not None] for key in NUMBERS}
        mean = {key: float(np.mean(values)) for key, values in known.items() if values}
        spread = {key: float(np.std(known[key], ddof=1)) if len(known[key]) > 1 else 0.0 for key in mean}
        axes = tuple(axis for axis in AXES if axis in same[0]["axes"])
        out.append(Point(name, same[0]["method"], axes, same[0]["setting"], mean, spread, len(same)))
    return out


def in_order(points: Sequence[Point]) -> list[Point]:
    """By method, then by time: as tables list them."""
    methods = list(METHODS)
    return sorted(points, key=lambda point: (methods.index(point.method), point.mean.get("seconds", 0.0)))


def pareto(points: Sequence[Point], cost: str = "seconds", measure: str = "psnr") -> list[Point]:
    """Points that no other is both cheaper and at least as good as, the cheapest first; their quality rises from each to the next.

    What is only shown otherwise takes no part.
    """
    sign = 1 if MEASURES[measure].larger_is_better else -1
    known = [point for point in points if cost in point.mean and measure in point.mean and not point.shown_otherwise]
    front: list[Point] = []
    for point in sorted(known, key=lambda point: (point.mean[cost], -sign * point.mean[measure])):
        if not front or sign * point.mean[measure] > sign * front[-1].mean[measure]:
            front.append(point)
    return front


def series(points: Sequence[Point]) -> list[tuple[str, list[Point]]]:
    """(axis, points along it that differ in nothing else, the cheapest first), with at least two points each."""
    out: list[tuple[str, list[Point]]] = []
    for axis, (_, larger_costs) in AXES.items():

        def rank(point: Point, axis: str = axis, sign: float = 1 if larger_costs else -1) -> float:
            value = point.setting[axis]
            return NAMES[axis].index(value) if axis in NAMES else sign * float(value)

        groups: dict[str, list[Point]] = {}
        for point in points:
            if axis in point.axes and point.setting.get(axis) is not None:
                # What follows from the axis itself (voxels that became coarser because time ran out, say) does not set points apart.
                others = sorted((key, str(value)) for key, value in point.wanted.items() if key != axis)
                groups.setdefault(f"{'field' if axis == 'decoder' else point.method} {others}", []).append(point)
        found = [(axis, sorted(same, key=rank)) for same in groups.values() if len(same) > 1]
        out += sorted(found, key=lambda one: one[1][0].setting.get("iterations") or 0.0) if axis == "decoder" else found
    return out


def steps(points: Sequence[Point]) -> list[tuple[str, Point, Point]]:
    """All steps along all axes: the axis, and the points before and after."""
    return [(axis, before, after) for axis, line in series(points) for before, after in pairwise(line)]


# ------------------------------------------------------------------------------------------------- in words


def value_text(axis: str, value: Any, unit: str = "units") -> str:
    """A value on its axis; lengths are in the input's `unit`."""
    if value is None:
        return words.NONE
    if axis == "voxel_size":
        return length(float(value), unit)
    if axis == "iterations":
        return words.duration(float(value))
    if axis == "samples":
        return words.significant(float(value) / SAMPLES_A_VOXEL)
    return PRECISION_TITLES.get(str(value), str(value).replace("_", " "))


def length(value: float, unit: str) -> str:
    """0.0123 m → 1.23 cm; other units as they are."""
    if unit != "m":
        return f"{words.significant(value)} {unit}"
    factor, name = (1, "m") if value >= 1 else (100, "cm") if value >= 0.01 else (1000, "mm")
    return f"{words.significant(value * factor)} {name}"


def times_text(ratio: float) -> str:
    return f"{ratio:.2g}×" if ratio < 10 else f"{ratio:.0f}×"


def sentence(step: tuple[str, Point, Point], unit: str = "units") -> str:
    """From 2 cm to 1 cm: +0.8 dB, 2.4× time, 3.9× memory."""
    axis, before, after = step
    gains = {key: after.mean[key] - before.mean[key] for key in ("psnr", "depth_error") if key in before.mean and key in after.mean}
    what = f"{METHODS['field' if axis == 'decoder' else after.method]}, {AXES[axis][0].lower()}"
    if axis == "decoder":
        what += f" at {value_text('iterations', after.wanted.get('iterations'))} of fitting"
    parts = []
    if "psnr" in gains:
        parts.append(f"{gains['psnr']:+.1f} dB".replace("-", "−"))
        # What is only shown otherwise is of the same fits: how these differ from each other says nothing about the step.
        if before.seeds > 1 and after.seeds > 1 and not after.shown_otherwise:
            parts[0] += f" (±{np.hypot(before.spread.get('psnr', 0), after.spread.get('psnr', 0)):.1f})"
    if "depth_error" in gains:
        parts.append(f"{100 * gains['depth_error']:+.1f} points of depth error".replace("-", "−"))
    costs = {"seconds": "time", "memory_mb": "memory"}
    if axis in ("samples", "precision"):
        costs = {"seconds_per_view": "time a picture"} | ({"disk_bytes": "size on disk"} if axis == "precision" else {})
    known = {key: title for key, title in costs.items() if before.mean.get(key, 0) > 1e-9 and key in after.mean}
    parts += [f"{times_text(after.mean[key] / before.mean[key])} {title}" for key, title in known.items()]
    first, last = (value_text(axis, point.setting.get(axis), unit) for point in (before, after))
    return f"{what}: from {first} to {last}: {', '.join(parts)}."


def setting_text(point: Point, unit: str = "units") -> str:
    """What sets a point apart, in a few words: its time or voxel, and how it differs from the default."""
    setting, wanted = point.setting, point.wanted
    parts = []
    if setting.get("iterations") is not None:
        parts.append(value_text("iterations", setting["iterations"]))
    if setting.get("keyframes") is not None:
        parts.append(words.counted(setting["keyframes"], "key frame"))
    if setting.get("voxel_size") is not None and ("voxel_size" in point.axes or not parts):
        parts.append(value_text("voxel_size", setting["voxel_size"], unit))
    if wanted.get("views", 1) != 1:
        parts.append(words.counted(setting.get("views"), "view"))
    if wanted.get("samples", SAMPLES_A_VOXEL) != SAMPLES_A_VOXEL:
        parts.append(f"{value_text('samples', setting.get('samples'))} samples a voxel")
    if wanted.get("precision", "float16") != "float16":
        parts.append(value_text("precision", setting.get("precision")))
    return ", ".join(parts)


def front_sentence(points: Sequence[Point], cost: str = "seconds", unit: str = "units") -> str | None:
    """One sentence on the whole front of PSNR; None when nothing was measured."""
    front = pareto(points, cost)
    if not front:
        return None
    first, last, over = front[0], front[-1], COSTS[cost]

    def at(point: Point) -> str:
        spent = words.duration(point.mean[cost]) if cost == "seconds" else words.memory(point.mean[cost])
        return f"{point.mean['psnr']:.2f} dB in {spent} ({METHODS[point.method]}, {setting_text(point, unit)})"

    if len(front) == 1:
        return f"One setting is best in PSNR whatever the {over}: {at(first)}."
    span = times_text(last.mean[cost] / max(first.mean[cost], 1e-9))
    return f"PSNR over {over}: {len(front)} settings that nothing beats, over {span} in {over}: from {at(first)} to {at(last)}."
