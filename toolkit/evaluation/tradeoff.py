"""What accuracy costs: measured points gathered over seeds, the Pareto front, and what each step along an axis gains and takes.

A row is one measurement (a method with one setting and one seed); a point is the mean of the rows that differ in nothing but the seed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fieldfuse.errors import InputError
from fieldfuse.evaluation.report import plain

# Axis → whether a larger value costs more. In the order in which they are told.
AXES = {
    "iterations": True,
    "voxel_size": False,
    "keyframes": True,
    "views": True,
    "samples": True,
    "decoder": True,
    "precision": True,
}
DECODERS = ("deferred", "per_sample")
PRECISIONS = ("uint8", "float16", "float32")
METHODS = {
    "field": "Field",
    "field_per_sample": "Field, decoder per sample",
    "direct": "Networks, not fitted",
    "tsdf": "TSDF",
    "tsdf_stereo": "TSDF of matched pictures",
}
# Measure → (what people call it, unit, digits, whether larger is better).
MEASURES: dict[str, tuple[str, str, int, bool]] = {
    "psnr": ("PSNR", "dB", 2, True),
    "ssim": ("SSIM", "", 3, True),
    "lpips": ("LPIPS", "", 3, False),
    "depth_error": ("depth error", "", 4, False),
}
COSTS = ("seconds", "memory_mb")
NUMBERS = (
    "seconds",
    "seconds_per_view",
    "peak_memory_mb",
    "memory_mb",
    "disk_bytes",
    *MEASURES,
    "coverage",
    "psnr_masked",
    "acc_1",
    "acc_5",
)
ROW = ("id", "method", "axes", "setting", "seed", "stages", "load", "measured", "error", *NUMBERS)


@dataclass(frozen=True)
class Point:
    """One setting of one method, over its seeds.

    Attributes:
        axes: those along which it is a step.
        setting: axis → value, None where the method does not have the axis.
        mean, spread: number → mean, and standard deviation over the seeds (0 with one); what is not known is left out.
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

    def value(self, axis: str) -> Any:
        return self.setting.get(axis)


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
    """Points in the order of their first row; rows that failed are left out."""
    groups: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        if row["error"] is None:
            groups.setdefault(row["id"], []).append(row)
    out = []
    for name, same in groups.items():
        mean, spread = {}, {}
        for key in NUMBERS:
            known = [float(row[key]) for row in same if row[key] is not None]
            if known:
                mean[key], spread[key] = float(np.mean(known)), float(np.std(known, ddof=1)) if len(known) > 1 else 0.0
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
    better: Callable[[float, float], bool] = (lambda a, b: a > b) if MEASURES[measure][3] else (lambda a, b: a < b)
    sign = -1 if MEASURES[measure][3] else 1
    known = [point for point in points if cost in point.mean and measure in point.mean and not point.shown_otherwise]
    front: list[Point] = []
    for point in sorted(known, key=lambda point: (point.mean[cost], sign * point.mean[measure])):
        if not front or better(point.mean[measure], front[-1].mean[measure]):
            front.append(point)
    return front


def rank(axis: str, value: Any) -> float:
    """Where a value stands on its axis; larger costs more."""
    if axis == "decoder":
        return DECODERS.index(value)
    if axis == "precision":
        return PRECISIONS.index(value)
    return float(value) if AXES[axis] else -float(value)


def series(points: Sequence[Point]) -> list[tuple[str, list[Point]]]:
    """(axis, points along it that differ in nothing else, the cheapest first), with at least two points each."""
    out: list[tuple[str, list[Point]]] = []
    for axis in AXES:
        groups: dict[str, list[Point]] = {}
        for point in points:
            if axis in point.axes and point.value(axis) is not None:
                groups.setdefault(_others(point, axis), []).append(point)
        found = [(axis, _sorted(axis, same)) for same in groups.values() if len(same) > 1]
        out += sorted(found, key=lambda one: one[1][0].value("iterations") or 0.0) if axis == "decoder" else found
    return out


def _sorted(axis: str, points: Sequence[Point]) -> list[Point]:
    return sorted(points, key=lambda point: rank(axis, point.value(axis)))


def _others(point: Point, axis: str) -> str:
    """All that two points of one series have in common. What follows from the axis itself (voxels that became coarser because time ran
    out, say) does not set them apart."""
    wanted = point.setting.get("wanted") or {}
    kept = {key: value for key, value in wanted.items() if key != axis}
    method = "field" if axis == "decoder" else point.method
    return f"{method} {sorted((key, str(value)) for key, value in kept.items())}"
