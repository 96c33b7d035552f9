"""Runs of a total budget as one Markdown table: seconds asked for, predicted and real, and what was chosen."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from fieldfuse.evaluation import words
from fieldfuse.evaluation.budget import AGREES
from fieldfuse.evaluation.page import short_name

HEAD = ("capture", "asked for", "predicted", "real", "off by", "effects", "fit", "chosen", "PSNR")


def budget_table(reports: Sequence[dict[str, Any]], commands: Sequence[str]) -> str:
    """A section of Markdown. `reports` as `report.json` of runs with `--total-budget` holds them, with the command of each."""
    rows, within = [], 0
    for data in sorted(reports, key=lambda data: (short_name(data["source"]), data["budget"]["asked_seconds"])):
        told = data["budget"]
        off = told["real_seconds"] / told["predicted_seconds"] - 1
        within += abs(off) <= AGREES
        rows.append("| " + " | ".join(_cells(data, told, off)) + " |")
    lines = [f"{within} of {len(rows)} runs took what was predicted, within {100 * AGREES:.0f}%:", ""]
    lines += ["| " + " | ".join(HEAD) + " |", "| " + " | ".join(["---"] * len(HEAD)) + " |", *rows, "", "By:", ""]
    return "\n".join([*lines, *(f"    {command}" for command in commands)]) + "\n"


def _cells(data: dict[str, Any], told: dict[str, Any], off: float) -> list[str]:
    choice, stages = told["choice"], told["stages"]
    video = f"{choice['video_frames']} video frames" if choice.get("video_frames") else "no video"
    made = [video, *(f"no {extra}" for extra in ("texture", "page") if choice.get(extra) is False)]
    effects = stages.get("effects", {}).get("real")
    score = ((data.get("evaluation") or {}).get("field") or {}).get("psnr")
    return [
        short_name(data["source"]),
        f"{told['asked_seconds']:g} s",
        f"{told['predicted_seconds']:.1f} s",
        f"{told['real_seconds']:.1f} s",
        f"{100 * off:+.0f}%".replace("-", "−"),
        "not looked for" if choice.get("effects") is False else words.duration(effects),
        f"{choice['fit_seconds']:.1f} s",
        f"{choice['image_size']} pixels, {choice['resolution']}³, {', '.join(made)}",
        words.decimal(score, 1),
    ]
