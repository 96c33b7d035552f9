"""What a step along an axis gains and takes, in sentences; settings and numbers as people read them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from fieldfuse.evaluation import words
from fieldfuse.evaluation.tradeoff import MEASURES, METHODS, Point, pareto, series

AXIS_TITLES = {
    "iterations": "Seconds of fitting",
    "voxel_size": "Voxel size",
    "keyframes": "Key frames",
    "views": "Training views",
    "samples": "Samples a voxel, when rendering",
    "decoder": "Decoder",
    "precision": "Precision of the stored field",
}
PRECISION_TITLES = {"uint8": "8 bits", "float16": "16 bits", "float32": "32 bits"}
SAMPLES_A_VOXEL = 4  # `samples` counts them in a brick of four voxels along a ray
RATIO_FLOOR = 1e-9


@dataclass(frozen=True)
class Step:
    """From one point of a series to the next.

    Attributes:
        gains: measure → how much larger it became.
        times, memory, disk, rendering: ratios of the costs; None where they are not known.
    """

    axis: str
    before: Point
    after: Point
    gains: dict[str, float]
    times: float | None
    memory: float | None
    disk: float | None
    rendering: float | None


def steps(points: Sequence[Point]) -> list[Step]:
    """All steps along all axes."""
    return [_step(axis, a, b) for axis, line in series(points) for a, b in pairwise(line)]


def _step(axis: str, a: Point, b: Point) -> Step:
    gains = {key: b.mean[key] - a.mean[key] for key in MEASURES if key in a.mean and key in b.mean}
    return Step(axis, a, b, gains, *(_ratio(a, b, key) for key in ("seconds", "memory_mb", "disk_bytes", "seconds_per_view")))


def _ratio(a: Point, b: Point, key: str) -> float | None:
    if key not in a.mean or key not in b.mean or a.mean[key] <= RATIO_FLOOR:
        return None
    return b.mean[key] / a.mean[key]


def value_text(axis: str, value: Any, unit: str = "units") -> str:
    """A value on its axis in words; lengths are in the input's `unit`."""
    if value is None:
        return words.NONE
    if axis == "voxel_size":
        return length(float(value), unit)
    if axis == "iterations":
        return words.duration(float(value))
    if axis == "samples":
        return words.significant(float(value) / SAMPLES_A_VOXEL)
    if axis == "precision":
        return PRECISION_TITLES.get(str(value), str(value))
    return str(value).replace("_", " ")


def length(value: float, unit: str) -> str:
    """0.0123 m → 1.23 cm; other units as they are."""
    if unit != "m":
        return f"{words.significant(value)} {unit}"
    for factor, name in ((1, "m"), (100, "cm"), (1000, "mm")):
        if value * factor >= 1 or name == "mm":
            return f"{words.significant(value * factor)} {name}"
    return words.NONE


def times_text(ratio: float | None) -> str:
    if ratio is None:
        return words.NONE
    return f"{ratio:.2g}×" if ratio < 10 else f"{ratio:.0f}×"


def gain_text(key: str, gain: float) -> str:
    """+0.8 dB; lengths of depth errors as a share of the depth."""
    title, unit, digits, _ = MEASURES[key]
    if key == "depth_error":
        return f"{100 * gain:+.1f} points of depth error"
    shown = f"{gain:+.{1 if key == 'psnr' else digits}f}".replace("-", "−")
    return f"{shown} {unit}" if unit else f"{shown} {title}"


def sentence(step: Step, unit: str = "units") -> str:
    """From 2 cm to 1 cm: +0.8 dB, 2.4× time, 3.9× memory."""
    a, b = (value_text(step.axis, point.value(step.axis), unit) for point in (step.before, step.after))
    first = METHODS["field" if step.axis == "decoder" else step.after.method]
    at = ""
    if step.axis == "decoder":
        at = f" at {value_text('iterations', (step.after.setting.get('wanted') or {}).get('iterations'))} of fitting"
    parts = [gain_text("psnr", step.gains["psnr"])] if "psnr" in step.gains else []
    # What is only shown otherwise is of the same fits: how these differ from each other says nothing about the step.
    if "psnr" in step.gains and step.before.seeds > 1 and step.after.seeds > 1 and not step.after.shown_otherwise:
        both = (step.before.spread.get("psnr", 0) ** 2 + step.after.spread.get("psnr", 0) ** 2) ** 0.5
        parts[0] += f" (±{both:.1f})"
    if "depth_error" in step.gains:
        parts.append(gain_text("depth_error", step.gains["depth_error"]).replace("-", "−"))
    if step.axis in ("samples", "precision"):  # the same fit, shown otherwise
        costs = [(step.rendering, "time a picture"), (step.disk if step.axis == "precision" else None, "size on disk")]
    else:
        costs = [(step.times, "time"), (step.memory, "memory")]
    parts += [f"{times_text(ratio)} {name}" for ratio, name in costs if ratio is not None]
    return f"{first}, {AXIS_TITLES[step.axis].lower()}{at}: from {a} to {b}: {', '.join(parts)}."


def setting_text(point: Point, unit: str = "units") -> str:
    """What sets a point apart, in a few words: its time or voxel, and how it differs from the default."""
    parts = []
    if point.value("iterations") is not None:
        parts.append(value_text("iterations", point.value("iterations")))
    if point.value("keyframes") is not None:
        parts.append(words.counted(point.value("keyframes"), "key frame"))
    if point.value("voxel_size") is not None and ("voxel_size" in point.axes or not parts):
        parts.append(value_text("voxel_size", point.value("voxel_size"), unit))
    wanted = point.setting.get("wanted") or {}
    if wanted.get("views", 1) != 1:
        parts.append(words.counted(point.value("views"), "view"))
    if wanted.get("samples", SAMPLES_A_VOXEL) != SAMPLES_A_VOXEL:
        parts.append(f"{value_text('samples', point.value('samples'))} samples a voxel")
    if wanted.get("precision", "float16") != "float16":
        parts.append(value_text("precision", point.value("precision")))
    return ", ".join(parts)


def front_sentence(points: Sequence[Point], cost: str = "seconds", measure: str = "psnr", unit: str = "units") -> str | None:
    """One sentence on the whole front; None when nothing was measured."""
    front = pareto(points, cost, measure)
    if not front:
        return None
    title, measured_in, digits, _ = MEASURES[measure]
    first, last = front[0], front[-1]

    def at(point: Point) -> str:
        spent = words.duration(point.mean[cost]) if cost == "seconds" else words.memory(point.mean[cost])
        reached = f"{point.mean[measure]:.{digits}f} {measured_in}".rstrip()
        return f"{reached} in {spent} ({METHODS[point.method]}, {setting_text(point, unit)})"

    over = {"seconds": "time", "memory_mb": "memory"}[cost]
    if len(front) == 1:
        return f"One setting is best in {title} whatever the {over}: {at(first)}."
    span = last.mean[cost] / max(first.mean[cost], RATIO_FLOOR)
    return (
        f"{title} over {over}: {len(front)} settings that nothing beats, over {times_text(span)} in {over}: from {at(first)} to {at(last)}."
    )
