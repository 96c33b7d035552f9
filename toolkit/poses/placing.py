"""From matches to a model that holds as many pictures as can be placed. Runs in the child process only."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pycolmap

from fieldfuse.files import read_json, remove
from fieldfuse.poses import loops
from fieldfuse.poses.agreement import agreement, leave_out
from fieldfuse.poses.database import extract, open_database, pair_facts, tolerant
from fieldfuse.poses.health import AGREES, failure, hopeless, turned_only
from fieldfuse.poses.job import GLOBAL, LOOSE, MAX_ASKED_AGAIN, MAX_EXHAUSTIVE, Job
from fieldfuse.poses.mapping import LEFT_OUT, LEFT_OUT_SHARE, STRICT, Model, Report, map_pictures, plain
from fieldfuse.poses.match import match
from fieldfuse.poses.pairs import pairs_with
from fieldfuse.poses.selection import choose_pairs

Placed = tuple[Model | None, dict[str, Any]]
FEW = 12  # photos; up to it their places are held against their matches one by one
SURE = 0.8  # share of a picture's matches that agree with its place from which there is no reason to look again


def place(job: Job, report: Report) -> Placed:
    """The model of the job's pictures, None where there is none, and what is told of it: `pairs` (`database.pair_facts`), `attempts`
    (`mapping.map_pictures`), `folded` (`loops.without_folds`), and of few photos `agreement` (`agreement.agreement`).

    Photos of which not all were matched with each other, and some found no place, are asked again: these with all others. Where too many
    have none still, or one of a few photos has a doubtful one, everything is tried once more by the job's second kind of features, unless
    the camera turned on the spot: then they would tell nothing more.
    """
    model, facts = _mapped(job, report)
    missing = _missing(job, model)
    if not job.sequential and missing and MAX_EXHAUSTIVE < len(job.pictures) <= MAX_ASKED_AGAIN:

        def again(done: float, total: float, note: str) -> None:
            report(total, total, f"{note} ({len(missing)} pictures without a place, again)")

        with loops.copied(job) as copy:
            match(copy, pairs_with(missing, len(job.pictures)), again)
            better, told = _mapped(copy, again)
        if len(_missing(job, better)) < len(missing):
            model, facts = better, told
    facts["agreement"] = {} if model is None else agreement(job, model)
    doubtful = _few(job) and (_fell_back(model) or min(facts["agreement"].values(), default=0.0) < SURE)
    wanting = doubtful or _too_many(job, _missing(job, model))
    if job.second is not None and wanting and not turned_only({**facts, "pictures": _records(job)}):
        model, facts = _otherwise(job, (model, facts), report)
    facts["agreement"] = leave_out(model, facts["agreement"], AGREES) if _few(job) and model is not None else {}
    return model, facts


def _otherwise(job: Job, before: Placed, report: Report) -> Placed:
    """What the second kind of features gives where that is better than `before`: more pictures whose matches agree with their place, or
    as many and none that does not. It has to come from COLMAP's own rules unless there is no other, and no way of a camera be folded.

    Their database stays in the job's folder, for a run that is taken up again.
    """
    assert job.second is not None
    # Comparing all with all takes the longest, and grows with their square.
    most = job.max_features if len(job.pictures) <= FEW else job.max_features // 2
    other = replace(job, folder=str(Path(job.folder) / job.second), features=job.second, second=None, max_features=most)
    Path(other.folder).mkdir(exist_ok=True)
    total = len(job.pictures)

    def again(done: float, of: float, note: str) -> None:
        report(total, total, f"{note} (by other features)")

    database = open_database(other)
    try:
        records = extract(other, database, again)
        other = tolerant(other, records)
        pairs = [] if hopeless(records) else choose_pairs(other, database, again)
    finally:
        database.close()
    match(other, pairs, again)
    model, facts = _mapped(other, again)
    facts |= {"pictures": records, "agreement": {} if model is None else agreement(other, model)}
    if model is not None and _few(job):
        facts["agreement"] = leave_out(model, facts["agreement"], AGREES)
    if model is not None and _sane(job, model, facts) and _better((model, facts), before):
        return model, facts
    remove(Path(other.folder))
    return before


def _sane(job: Job, model: Model, facts: dict[str, Any]) -> bool:
    """Whether nothing that can be measured speaks against a model."""
    folded = facts["folded"]
    whole = not job.sequential or folded is None or folded["left"] < folded["contradicting"]
    return whole and failure({**facts, "model": plain(model)}) is None


def _better(after: Placed, before: Placed) -> bool:
    old, new = (list(facts["agreement"].values()) for _, facts in (before, after))
    gained = sum(share >= AGREES for share in new) - sum(share >= AGREES for share in old)
    clean, clearer = min(new, default=0.0) >= AGREES, min(new, default=0.0) > min(old, default=0.0)
    # Learned matches between pictures that see hardly any parallax get places by looser rules that agree with them and are wrong.
    strict = after[0] is not None and after[0].attempt == STRICT
    if before[0] is not None and not strict:
        return False
    return (gained > 0 and (clean or strict)) or (gained == 0 and clean and (clearer or _fell_back(before[0])))


def _few(job: Job) -> bool:
    return not job.sequential and len(job.pictures) <= FEW


def _too_many(job: Job, missing: list[int]) -> bool:
    """Whether so many pictures without a place are worth another attempt."""
    count = len(job.pictures)
    return len(missing) >= (1 if count <= MAX_EXHAUSTIVE else max(LEFT_OUT, LEFT_OUT_SHARE * count))


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
