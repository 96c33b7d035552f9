"""The child process that runs pycolmap: `python -m fieldfuse.poses.worker job.json`.

COLMAP can abort a process, and its native code cannot be interrupted; here that costs nobody else anything. Messages go to
the parent as JSON lines: `progress` (done, total, note), `step` (name, seconds), `error` (kind, message).
"""

from __future__ import annotations

import os
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2

from fieldfuse.errors import FieldfuseError
from fieldfuse.files import read_json, remove, write_json
from fieldfuse.poses import database as store
from fieldfuse.poses import loops, mapping
from fieldfuse.poses.child import Messages, die_with_parent
from fieldfuse.poses.database import Report
from fieldfuse.poses.health import AGREES, failure, hopeless, turned_only
from fieldfuse.poses.job import GLOBAL, LOOSE, MAX_ASKED_AGAIN, MAX_EXHAUSTIVE, STRICT, Job
from fieldfuse.poses.mapping import Model, agreement, leave_out
from fieldfuse.poses.match import match
from fieldfuse.poses.pairs import Pairs, choose_pairs, pairs_with

Placed = tuple[Model | None, dict[str, Any]]
PROBE_BYTES = 4 * 2**20
WEIGHTS = {"features": (0.0, 0.3), "matching": (0.3, 0.4), "mapping": (0.7, 0.3)}  # start and share of the whole, for the bar
FEW = 12  # photos; up to it their places are held against their matches one by one
SURE = 0.8  # share of an image's matches that agree with its place from which there is no reason to look again


def work(job_file: Path, messages: Messages) -> None:
    """Extract, match, map; leave everything in the job's folder.

    Raises:
        FieldfuseError: with a sentence for the user.
    """
    job = Job.load(job_file)
    began = time.monotonic()

    def finished(step: str) -> None:
        nonlocal began
        messages.send(event="step", name=step, seconds=time.monotonic() - began)
        began = time.monotonic()

    def reporter(step: str) -> Report:
        def report(done: float, total: float, note: str) -> None:
            start, share = WEIGHTS[step]
            messages.send(event="progress", done=100 * (start + share * done / max(total, 1)), total=100, note=note)

        return report

    job, records, pairs = _features(job, reporter("features"), reporter("matching"))
    facts: dict[str, Any] = {"pictures": records, "pairs": [], "attempts": [], "folded": None, "model": None}
    finished("features")
    if hopeless(records) is None or job.second is not None:
        match(job, pairs, reporter("matching"))
        finished("matching")
        model, found = place(job, reporter("mapping"))
        facts |= found
        if model is not None:
            mapping.finish(job, model, reporter("mapping"))
            facts["model"] = mapping.plain(model)
            mapping.save_model(model, [image.name for image in job.images], Path(job.folder) / "model")
        finished("mapping")
    write_json(job.result, facts)


def _features(job: Job, extracting: Report, choosing: Report) -> tuple[Job, list[dict[str, Any]], Pairs]:
    """The job with the tolerance of its features, which are then in its database, a record of each image, and the pairs to match."""
    database = store.open_database(job)
    try:
        records = store.extract(job, database, extracting)
        pairs = [] if hopeless(records) else choose_pairs(job, lambda: store.sketches(job, database), choosing)
        return store.tolerant(job, records), records, pairs
    finally:
        database.close()


# ------------------------------------------------------------------------------------------------- placing


def place(job: Job, report: Report) -> Placed:
    """The model of the job's images, None where there is none, and its facts: `pairs` (`database.pair_facts`), `attempts`
    (`mapping.map_images`), `folded` (`loops.without_folds`), and of few photos `agreement` (`mapping.agreement`).

    Photos of which not all were matched with each other, and some found no place, are tried again: these with all others. Where too many
    have none still, or one of a few photos has a doubtful one, everything is tried once more by the job's second kind of features, unless
    the camera turned on the spot: then they would add nothing.
    """
    model, facts = _mapped(job, report)
    missing = _missing(job, model)
    if not job.sequential and not job.rigged and missing and MAX_EXHAUSTIVE < len(job.images) <= MAX_ASKED_AGAIN:

        def again(done: float, total: float, note: str) -> None:
            report(total, total, f"{note} ({len(missing)} pictures without a place, again)")

        with loops.copied(job) as copy:
            match(copy, pairs_with(missing, len(job.images)), again)
            better, found = _mapped(copy, again)
        if len(_missing(job, better)) < len(missing):
            model, facts = better, found
    facts["agreement"] = {} if model is None else agreement(job, model)
    missing, few = _missing(job, model), _few(job)
    wanting = few and (_fell_back(model) or min(facts["agreement"].values(), default=0.0) < SURE)
    wanting |= len(missing) >= (1 if len(job.images) <= MAX_EXHAUSTIVE else mapping.many(len(job.images)))
    if job.second is not None and wanting and not turned_only({**facts, "pictures": _records(job)}):
        model, facts = _otherwise(job, (model, facts), report)
    facts["agreement"] = leave_out(model, facts["agreement"], AGREES) if few and model is not None else {}
    return model, facts


def _otherwise(job: Job, before: Placed, report: Report) -> Placed:
    """What the second kind of features gives where that is better than `before`: more images whose matches agree with their place, or
    as many and none that does not. It has to come from COLMAP's own rules unless there is no other, and no way of a camera be folded.

    Their database stays in the job's folder, for a run that is taken up again.
    """
    assert job.second is not None
    # Comparing all with all takes the longest, and grows with their square.
    most = job.max_features if len(job.images) <= FEW else job.max_features // 2
    other = replace(job, folder=str(Path(job.folder) / job.second), features=job.second, second=None, max_features=most)
    Path(other.folder).mkdir(exist_ok=True)
    total = len(job.images)

    def again(done: float, of: float, note: str) -> None:
        report(total, total, f"{note} (by other features)")

    other, records, pairs = _features(other, again, again)
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
    return whole and failure({**facts, "model": mapping.plain(model)}) is None


def _better(after: Placed, before: Placed) -> bool:
    old, new = (list(facts["agreement"].values()) for _, facts in (before, after))
    gained = sum(share >= AGREES for share in new) - sum(share >= AGREES for share in old)
    clean, clearer = min(new, default=0.0) >= AGREES, min(new, default=0.0) > min(old, default=0.0)
    # Learned matches between images that see hardly any parallax get places by looser rules that agree with them and are wrong.
    strict = after[0] is not None and after[0].attempt == STRICT
    if before[0] is not None and not strict:
        return False
    return (gained > 0 and (clean or strict)) or (gained == 0 and clean and (clearer or _fell_back(before[0])))


def _few(job: Job) -> bool:
    return not job.sequential and not job.rigged and len(job.images) <= FEW


def _records(job: Job) -> list[dict[str, Any]]:
    """Of each image what `database.extract` left."""
    records = {record["name"]: record for record in read_json(job.records)}
    return [records[image.name] for image in job.images]


def _fell_back(model: Model | None) -> bool:
    return model is None or model.attempt in (LOOSE, GLOBAL)


def _missing(job: Job, model: Model | None) -> list[int]:
    """Indices of the images that have no place in the model."""
    placed = set() if model is None else set(loops.axes(model))
    return [index for index in range(len(job.images)) if index not in placed]


def _mapped(job: Job, report: Report) -> Placed:
    """As `place`, of what has been matched."""
    with store.opened(job.database) as database:
        facts: dict[str, Any] = {"pairs": store.pair_facts(database), "attempts": [], "folded": None}
    if not facts["pairs"]:
        return None, facts
    mapped = loops.never_folded(job, report) if job.sequential and not job.rigged else None
    if mapped is None:
        model, facts["attempts"] = mapping.map_images(job, report)
        if model is None:
            return None, facts
        if job.rigged:  # what shows everything around is seldom taken for another place, and steps are counted in images there
            return model, facts
        mapped = loops.without_folds(job, model, facts["attempts"], report)
    model, facts["attempts"], facts["folded"] = mapped
    return model, facts


# ------------------------------------------------------------------------------------------------- the process


def unwritable(folder: Path) -> str | None:
    """Why a file of the size of a database cannot be written in `folder` now; None when it can."""
    probe = folder / f".probe-{os.getpid()}"
    try:
        with probe.open("wb") as file:
            file.write(b"\0" * PROBE_BYTES)
            file.flush()
            os.fsync(file.fileno())
        return None
    except OSError as error:
        return f"cannot write {folder}: {error.strerror or error}; free space or choose another --out folder"
    finally:
        probe.unlink(missing_ok=True)


def main() -> int:
    die_with_parent()
    messages = Messages()
    cv2.setNumThreads(1)
    try:
        work(Path(sys.argv[1]), messages)
    except FieldfuseError as error:
        messages.send(event="error", kind=type(error).__name__, message=str(error))
    except (OSError, RuntimeError):  # SQLite's and COLMAP's own errors come as RuntimeError, often without their cause
        reason = unwritable(Path(sys.argv[1]).parent)
        if reason is None:
            raise
        messages.send(event="error", kind="OutputError", message=reason)
    return 0


if __name__ == "__main__":
    sys.exit(main())
