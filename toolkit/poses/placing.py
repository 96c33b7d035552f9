"""From matches to a model that holds as many pictures as can be placed. Runs in the child process only."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pycolmap

from toolkit.files import read_json, remove
from toolkit.poses import loops
from toolkit.poses.agreement import agreement, leave_out
from toolkit.poses.database import extract, open_database, pair_facts
from toolkit.poses.health import AGREES, turned_only
from toolkit.poses.job import GLOBAL, LOOSE, MAX_ASKED_AGAIN, MAX_EXHAUSTIVE, MAX_OBLIQUE, Job
from toolkit.poses.mapping import Model, Report, map_pictures
from toolkit.poses.match import match
from toolkit.poses.pairs import exhaustive_pairs, pairs_with

Placed = tuple[Model | None, dict[str, Any]]
OBLIQUE = "oblique"  # the folder in the job's of what was found by looking obliquely
SURE = 0.8  # share of a picture's matches that agree with its place from which there is no reason to look again


def place(job: Job, report: Report) -> Placed:
    """The model of the job's pictures, None where there is none, and what is told of it: `pairs` (`database.pair_facts`), `attempts`
    (`mapping.map_pictures`), `folded` (`loops.without_folds`), and of few photos `agreement` (`agreement.agreement`).

    Photos of which not all were matched with each other, and some found no place, are asked again: these with all others. Of few photos,
    which often stand far apart, the features of oblique views are tried, too, where these have no place or a doubtful one, unless
    the camera turned on the spot: then they would tell nothing more.
    """
    model, facts = _mapped(job, report)
    missing = _missing(job, model)
    if not job.sequential and len(job.pictures) <= MAX_OBLIQUE:
        facts["agreement"] = {} if model is None else agreement(job, model)
        doubtful = missing or _fell_back(model) or min(facts["agreement"].values(), default=0.0) < SURE
        if doubtful and not turned_only({**facts, "pictures": _records(job)}):
            model, facts = _obliquely(job, (model, facts), report)
        if model is not None:
            facts["agreement"] = leave_out(model, facts["agreement"], AGREES)
        return model, facts
    if job.sequential or not missing or not MAX_EXHAUSTIVE < len(job.pictures) <= MAX_ASKED_AGAIN:
        return model, facts

    def again(done: float, total: float, note: str) -> None:
        report(total, total, f"{note} ({len(missing)} pictures without a place, again)")

    with loops.copied(job) as copy:
        match(copy, pairs_with(missing, len(job.pictures)), again)
        better, told = _mapped(copy, again)
    return (better, told) if len(_missing(job, better)) < len(missing) else (model, facts)


def _obliquely(job: Job, before: Placed, report: Report) -> Placed:
    """What features of oblique views, too, give where that is better than `before`: more pictures whose matches agree with their place, or
    as many and none that does not. What only the loose attempts found has to be beyond doubt.

    Their database stays in the job's folder, for a run that is taken up again.
    """
    other = replace(job, folder=str(Path(job.folder) / OBLIQUE), oblique=True)
    Path(other.folder).mkdir(exist_ok=True)
    database = open_database(other)
    total = len(job.pictures)

    def again(done: float, of: float, note: str) -> None:
        report(total, total, f"{note} (seen obliquely)")

    try:
        extract(other, database, again)
    finally:
        database.close()
    match(other, exhaustive_pairs(total), again)
    model, facts = _mapped(other, again)
    facts["agreement"] = {} if model is None else agreement(other, model)
    old, new = (list(told["agreement"].values()) for told in (before[1], facts))
    gained = sum(share >= AGREES for share in new) - sum(share >= AGREES for share in old)
    clean, clearer = min(new, default=0.0) >= AGREES, min(new, default=0.0) > min(old, default=0.0)
    if (gained > 0 and (clean or not _fell_back(model))) or (gained == 0 and clean and (clearer or _fell_back(before[0]))):
        return model, facts
    remove(Path(other.folder))
    return before


def _records(job: Job) -> list[dict[str, Any]]:
    """Of each picture what `database.extract` left."""
    records = {record["name"]: record for record in read_json(job.records)}
    return [records[picture.name] for picture in job.pictures]


def _fell_back(model: Model | None) -> bool:
    return model is None or model.attempt in (LOOSE, GLOBAL)


def _missing(job: Job, model: Model | None) -> list[int]:
    """Indices of the pictures that have no place in the model."""
    placed = set() if model is None else set(loops.axes(model))
    return [index for index in range(len(job.pictures)) if index not in placed]


def _mapped(job: Job, report: Report) -> Placed:
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
