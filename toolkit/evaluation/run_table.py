"""Ordinary runs as one Markdown table: a row a setting, seeds side by side, with the commands that made them."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

from fieldfuse.evaluation import words
from fieldfuse.evaluation.page import short_name

HEAD = ("capture", "views", "pixels", "how", "PSNR", "SSIM", "LPIPS", "nearest picture", "field made in", "peak memory", "whole run")
PLAIN = ("images", "frames", "photos")
MAKING = ("network", "direct", "field")
NOT_TOLD = ("export.", "tsdf.enabled")  # settings that change no score


def is_report(found: Any) -> bool:
    """Whether it is what a run leaves in `report.json`."""
    return isinstance(found, dict) and {"evaluation", "timeline", "stages", "settings"} <= found.keys()


def run_table(reports: Sequence[dict[str, Any]], commands: Sequence[str]) -> str:
    """A section of Markdown. `reports` as `report.json` holds them, with the command of each."""
    rows: dict[tuple[str, ...], list[dict[str, Any]]] = {}
    for data in reports:
        rows.setdefault((_capture(data), _views(data), _pixels(data), _how(data)), []).append(data)
    told = set()  # captures whose surface has its row
    lines = ["| " + " | ".join(HEAD) + " |", "| " + " | ".join(["---"] * len(HEAD)) + " |"]
    for key, group in rows.items():
        nearest = (group[0]["evaluation"].get("nearest_image") or {}).get("psnr")
        whole = [_each(group, _making, words.duration), _each(group, _peak, words.memory)]
        whole.append(_each(group, lambda data: data["seconds_total"], words.duration))
        lines.append("| " + " | ".join([*key, *_scores(group, "field"), words.decimal(nearest, 1), *whole]) + " |")
        if group[0]["evaluation"].get("tsdf") and key[:3] not in told:
            told.add(key[:3])
            surface = [*key[:3], "its TSDF", *_scores(group[:1], "tsdf"), words.decimal(nearest, 1), "", "", ""]
            lines.append("| " + " | ".join(surface) + " |")
    days = sorted({str(data["created"])[:10] for data in reports})
    when = days[0] if len(days) == 1 else f"{days[0]} to {days[-1]}"
    return "\n".join([f"Measured {when}, {_machine(reports)}:", "", *lines, "", "By:", "", *(f"    {one}" for one in commands)]) + "\n"


def _each(group: Sequence[dict[str, Any]], value: Callable[[dict[str, Any]], Any], text: Callable[[Any], str]) -> str:
    """What each run of the group has, said once where all say the same."""
    return ", ".join(dict.fromkeys(text(value(data)) for data in group))


def _scores(group: Sequence[dict[str, Any]], what: str) -> list[str]:
    """PSNR, SSIM and LPIPS, one after the other for each run; where there is surface in part only, PSNR on it too."""
    found = [data["evaluation"].get(what) or {} for data in group]
    cells = [", ".join(words.decimal(one.get(key), digits) for one in found) for key, digits in (("psnr", 1), ("ssim", 3), ("lpips", 3))]
    masked, coverage = found[0].get("psnr_masked"), found[0].get("coverage")
    if masked is not None and coverage is not None:
        cells[0] += f" ({masked:.1f} on the {100 * coverage:.0f}% where it has surface)"
    return cells


def _capture(data: dict[str, Any]) -> str:
    """The last part of its path; where that says nothing, the one before, too."""
    name = short_name(data["source"])
    before = short_name(str(data["source"]).rstrip("/").removesuffix(name)) if name in PLAIN else ""
    return f"{before}/{name}" if before else name


def _views(data: dict[str, Any]) -> str:
    return f"{data['views']['total'] - data['views']['test']} / {data['views']['test']}"


def _pixels(data: dict[str, Any]) -> str:
    return f"{data['views']['width']}×{data['views']['height']}"


def _how(data: dict[str, Any]) -> str:
    """What was asked for, beyond the capture and its size: seconds, threads, and settings that were given."""
    settings = data["settings"]
    threads = settings.get("threads")
    parts = [f"{settings['fit']['budget']:g} s" if settings["fit"]["finetune"] else "networks alone"]
    if settings["engine"] != "auto":
        parts.append(f"engine {settings['engine']}")
    if threads is not None:
        parts.append("one thread" if threads == 1 else f"{threads} threads")
    given = shlex.split(str(data["command"]))
    pairs = [value for name, value in pairwise(given) if name == "--set" and not value.startswith(NOT_TOLD)]
    return ", ".join([*parts, *(f"`{pair}`" for pair in pairs)])


def _making(data: dict[str, Any]) -> float:
    """Seconds of the stages that make the field: matching and fitting, and the networks where they took part."""
    return float(sum(stage["seconds"] for stage in data["stages"] if stage["name"] in MAKING))


def _peak(data: dict[str, Any]) -> float | None:
    return max((stage["peak_memory_mb"] for stage in data["stages"] if stage.get("peak_memory_mb") is not None), default=None)


def _machine(reports: Sequence[dict[str, Any]]) -> str:
    """Interpreter and device."""
    machines = {f"Python {data['machine']['python']}, device {data['machine']['device']}" for data in reports}
    return "; ".join(sorted(machines))
