"""From matches to a model that holds as many pictures as can be placed. Runs in the child process only."""

from __future__ import annotations

from typing import Any

import pycolmap

from toolkit.poses import loops
from toolkit.poses.database import pair_facts
from toolkit.poses.job import MAX_ASKED_AGAIN, MAX_EXHAUSTIVE, Job
from toolkit.poses.mapping import Model, Report, map_pictures
from toolkit.poses.match import match
from toolkit.poses.pairs import pairs_with


def place(job: Job, report: Report) -> tuple[Model | None, dict[str, Any]]:
    """The model of the job's pictures, None where there is none, and what is told of it: `pairs` (`database.pair_facts`), `attempts`
    (`mapping.map_pictures`) and `folded` (`loops.without_folds`).

    Photos of which not all were matched with each other, and some found no place, are asked again: these with all others.
    """
    model, facts = _mapped(job, report)
    missing = _missing(job, model)
    if job.sequential or not missing or not MAX_EXHAUSTIVE < len(job.pictures) <= MAX_ASKED_AGAIN:
        return model, facts

    def again(done: float, total: float, note: str) -> None:
        report(total, total, f"{note} ({len(missing)} pictures without a place, again)")

    with loops.copied(job) as copy:
        match(copy, pairs_with(missing, len(job.pictures)), again)
        better, told = _mapped(copy, again)
    return (better, told) if len(_missing(job, better)) < len(missing) else (model, facts)


def _missing(job: Job, model: Model | None) -> list[int]:
    """Indices of the pictures that have no place in the model."""
    placed = set() if model is None else set(loops.axes(model))
    return [index for index in range(len(job.pictures)) if index not in placed]


def _mapped(job: Job, report: Report) -> tuple[Model | None, dict[str, Any]]:
    """As `place`, of what has been matched."""
    database = pycolmap.Database.open(job.database)
    try:
        facts: dict[str, Any] = {"pairs": pair_facts(job, database), "attempts": [], "folded": None}
    finally:
        database.close()
    if not facts["pairs"]:
        return None, facts
    mapped = loops.never_folded(job, report) if job.sequential else None
    if mapped is None:
        model, facts["attempts"] = map_pictures(job, report)
        if model is None:
            return None, facts
        mapped = loops.without_folds(job, model, facts["attempts"], report)
    model, facts["attempts"], facts["folded"] = mapped
    return model, facts
