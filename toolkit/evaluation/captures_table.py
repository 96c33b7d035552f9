"""What came of each capture of a folder as one Markdown table: seeds side by side, what it is compared with in columns of their own."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from fieldfuse.evaluation import words
from fieldfuse.evaluation.suites.tables import machine_line, row_line

LONGEST = 250  # characters of a sentence in the table; whole in captures.json
MASKED = " (within its masks)"


def captures_table(data: dict[str, Any]) -> str:
    """A section of Markdown: machine, command and a row a capture. `data` as `fieldfuse bench captures` writes it."""
    variants = list(dict.fromkeys(run["variant"] for one in data["captures"] for run in one["runs"])) or ["default"]
    head = ["capture", "poses", "frames", *(f"PSNR, {name}" for name in variants), "nearest image", "corrected", "seconds", "warnings"]
    lines = [row_line(head), row_line(["---"] * len(head))]
    lines += [row_line([one["capture"], *_cells(one["runs"], variants)]) for one in data["captures"]]
    return "\n".join([machine_line(data["machine"]), "", f"    {data['command']}", "", *lines]) + "\n"


def _cells(runs: Sequence[dict[str, Any]], variants: Sequence[str]) -> list[str]:
    """All but the capture's name. What is said of the capture itself is of its first run."""
    first = runs[0]
    scores = [_scores([run for run in runs if run["variant"] == name], first) for name in variants]
    if first["state"] != "read":
        return ["", words.NONE, *scores, "", "", "", ""]
    warned = first["warnings"]
    return [
        f"{first['kind']}, {first['poses']}",
        f"{first['registered']} of {first['total']}",
        scores[0] + (MASKED if first["masks"] else ""),
        *scores[1:],
        words.decimal(first["nearest_image"], 1),
        ", ".join(name.replace("_", " ") for name in first["effects"]) or "nothing",
        words.decimal(first["seconds"], 0),
        f"{len(warned)}: {_short(warned[0])}" if warned else "none",
    ]


def _scores(runs: Sequence[dict[str, Any]], first: dict[str, Any]) -> str:
    """PSNR of each seed; for one that made nothing its sentence, which is not said again where it is the first run's."""

    def text(run: dict[str, Any]) -> str:
        if run["state"] == "read":
            return words.decimal(run["psnr"])
        again = run is not first and run["error"] == first["error"]
        return str(run["state"]) if again else _short(f"{run['state']}: {run['error']}")

    return ", ".join(map(text, runs)) or words.NONE


def _short(text: str) -> str:
    return text if len(text) <= LONGEST else text[: LONGEST - 1].rstrip() + "…"
