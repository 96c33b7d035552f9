"""A trade-off as Markdown: the Pareto front in a sentence, its points and every method's curve in one table, the steps."""

from __future__ import annotations

from typing import Any

from fieldfuse.evaluation import words
from fieldfuse.evaluation.suites.tables import machine_line
from fieldfuse.evaluation.tradeoff import METHODS, Point, in_order, pareto, points_of
from fieldfuse.evaluation.tradeoff_text import front_sentence, sentence, setting_text, steps


def tradeoff_table(data: dict[str, Any], name: str) -> str:
    """A section of Markdown. `data` as `tradeoff.json` holds it."""
    points, unit = points_of(data["rows"]), data["unit"] or "units"
    fronts = [{point.id for point in pareto(points, cost)} for cost in ("seconds", "memory_mb")]
    depth = any("depth_error" in point.mean for point in points)
    lines = [f"### {name}", "", machine_line(machine_of(data)), "", f"    {data['command']}", ""]
    lines += [f"{text}\n" for cost in ("seconds", "memory_mb") if (text := front_sentence(points, cost, "psnr", unit)) is not None]
    head = ["method", "setting", "time", "memory", "on disk", "PSNR", "SSIM", "LPIPS", *(["depth error"] if depth else []), "unbeaten in"]
    lines += ["| " + " | ".join(head) + " |", "| " + " | ".join(["---"] * len(head)) + " |"]
    lines += ["| " + " | ".join(_cells(point, fronts, depth, unit)) + " |" for point in in_order(points) if not point.shown_otherwise]
    lines += ["", *(f"- {sentence(step, unit)}" for step in steps(points))]
    if data.get("left_out"):
        lines.append(f"- Not measured for want of time: {', '.join(name.removesuffix('-seed0') for name in data['left_out'])}.")
    lines += [f"- {text}" for text in data.get("refused") or []]
    return "\n".join(lines).rstrip() + "\n"


def machine_of(data: dict[str, Any]) -> dict[str, Any]:
    """The machine with the mean load while points were measured, which says more than that at the end."""
    loads = [value for row in data["rows"] for value in row["load"] or [] if value is not None]
    return {**data["machine"], **({"load": sum(loads) / len(loads)} if loads else {})}


def _cells(point: Point, fronts: list[set[str]], depth: bool, unit: str) -> list[str]:
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
