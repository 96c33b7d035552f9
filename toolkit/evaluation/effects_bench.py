"""Detection of effects on captures that are known: counts of what was found, by strength, and what they come to."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fieldfuse.capture import open_capture
from fieldfuse.effects.survey import VIEWS, survey
from fieldfuse.evaluation.effects_plan import EFFECTS, STRENGTHS, Planned, film
from fieldfuse.progress import SILENT, Progress

FOUND_AS = {VIEWS: "highlights"}  # the simulator's name of what detection calls by its appearance


@dataclass(frozen=True)
class Looked:
    """One capture: what it has, what was found, and how much."""

    name: str
    scene: str
    true: dict[str, str]  # effect → strength
    found: tuple[str, ...]
    numbers: dict[str, float]
    seconds: float

    def to_dict(self) -> dict[str, Any]:
        return {
            "name": self.name,
            "scene": self.scene,
            "true": self.true,
            "found": list(self.found),
            "numbers": {name: round(value, 4) for name, value in self.numbers.items()},
            "seconds": round(self.seconds, 2),
        }


def look_at(planned: Iterable[Planned], folder: Path, progress: Progress = SILENT) -> list[Looked]:
    """Film what is not there yet, and look at each capture with all of its frames.

    Raises:
        Interrupted: stopped by the user; the captures filmed so far stay.
    """
    out = []
    todo = list(planned)
    for number, one in enumerate(todo):
        progress.check()
        progress.update(number, len(todo), one.name)
        found = survey(open_capture(film(one, folder)))
        names = {name: FOUND_AS.get(name, name) for name in found.findings}
        numbers = {names[name]: finding.number for name, finding in found.findings.items()}
        there = tuple(sorted(names[name] for name in found.there))
        out.append(Looked(one.name, one.scene, dict(one.effects), there, numbers, found.seconds))
    return out


def confusion(looked: list[Looked]) -> dict[str, Any]:
    """For each effect: how many captures have it in each strength and in how many of these it was found, and in how many it was found
    although they do not have it; precision and recall over medium and strong. (What is weak is counted, and is neither right nor wrong.)"""
    rows: dict[str, dict[str, Any]] = {}
    for effect in EFFECTS:
        row: dict[str, Any] = {}
        for strength in STRENGTHS:
            having = [one for one in looked if one.true.get(effect) == strength]
            row[strength] = {"captures": len(having), "found": sum(effect in one.found for one in having)}
        without = [one for one in looked if effect not in one.true]
        row["none"] = {"captures": len(without), "found": sum(effect in one.found for one in without)}
        rows[effect] = row
    right = sum(row[strength]["found"] for row in rows.values() for strength in ("medium", "strong"))
    there = sum(row[strength]["captures"] for row in rows.values() for strength in ("medium", "strong"))
    wrong = sum(row["none"]["found"] for row in rows.values())
    return {
        "effects": rows,
        "captures": len(looked),
        "precision": right / (right + wrong) if right + wrong else None,
        "recall": right / there if there else None,
        "clean_without_alarm": sum(not one.found for one in looked if not one.true),
        "clean": sum(not one.true for one in looked),
    }
