"""The loop of a sweep: each point in a process of its own, written as soon as it is known, reused when nothing that went in has changed."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from fieldfuse.config import settings_dict
from fieldfuse.errors import InputError
from fieldfuse.files import fingerprint, read_json, remove, write_json
from fieldfuse.pipelines.direct_field import weights_state
from fieldfuse.pipelines.job import Job
from fieldfuse.pipelines.schemas import MeasuredPoint, read_checked
from fieldfuse.pipelines.tradeoff_plan import Wanted, point_id
from fieldfuse.poses.child import log_tail, run_logged

VERSION = 1  # raised when what a point measures changes
FIRST_GUESS = 15.0  # seconds that a point takes beside its fitting time, before one was measured
FOLDER = "tradeoff"


@dataclass
class Swept:
    """What a sweep has so far: rows, and the names of what was left out for lack of time."""

    rows: list[dict[str, Any]]
    left_out: list[str]


def sweep(job: Job, wanted: Sequence[Wanted], stereo_seconds: float, budget: float | None, swept: Swept) -> None:
    """Measure everything in `wanted` into `swept`; with a `budget` of seconds, what would not fit into it is left out.

    Raises:
        Interrupted: the user asked to stop; `swept` has what was finished.
    """
    began, base_voxel = time.monotonic(), None
    beside = {True: FIRST_GUESS, False: FIRST_GUESS}  # seconds that a surface (True) or a field takes beside its fitting time
    for one in wanted:
        spec = job_spec(job, one, stereo_seconds, base_voxel)
        rows = known_rows(job, one, spec)
        if rows is None:
            expected = float(one.wanted.get("iterations", 0.0)) + beside[one.is_surface]
            if budget is not None and time.monotonic() - began + expected > budget:
                swept.left_out.append(one.name)
                continue
            start = time.monotonic()
            rows = measure(job, one, spec, expected)
            spent = time.monotonic() - start - float(one.wanted.get("iterations", 0.0))
            beside[one.is_surface] = max(spent, 0.7 * beside[one.is_surface])
        swept.rows += [finish(one, row) for row in rows]
        if one.is_surface and one.wanted["voxel_size"] == 1 and rows[0]["error"] is None:
            base_voxel = rows[0]["setting"]["working_voxel"]


def job_spec(job: Job, one: Wanted, stereo_seconds: float, base_voxel: float | None) -> dict[str, Any]:
    """All that the child is told; its key stands for everything that the result depends on."""
    settings = job.settings
    made = {
        name: job.stages.records[name].made for name in ("views", "scene", "poses", *(["stereo"] if "stereo" in job.stages.records else []))
    }
    if one.is_surface:
        own: list[Any] = [asdict(settings.tsdf), base_voxel]
    elif one.method == "direct":
        own = [asdict(settings.network), asdict(settings.keyframes), weights_state(settings), settings.field.background, settings.device]
    else:
        own = [asdict(settings.field), asdict(replace(settings.fit, budget=None)), settings.engine, settings.device]
    uses = [made, own, settings.threads]
    return {
        "key": fingerprint(VERSION, one.method, one.wanted, one.seed, list(one.variants), uses),
        "folder": str(job.folder.path),
        "settings": settings_dict(settings),
        "method": one.method,
        "wanted": one.wanted,
        "views": one.wanted["views"],
        "seed": one.seed,
        "variants": list(one.variants),
        "stereo_seconds": stereo_seconds,
        "base_voxel": base_voxel,
    }


def place(job: Job, one: Wanted) -> Path:
    return job.folder / FOLDER / "points" / f"{one.name}.json"


def known_rows(job: Job, one: Wanted, spec: dict[str, Any]) -> list[dict[str, Any]] | None:
    """The rows of an earlier sweep, if they are of this very point and not the remains of a crash."""
    return rows_at(place(job, one), spec["key"])


def rows_at(path: Path, key: str) -> list[dict[str, Any]] | None:
    """The rows at `path`, if they were kept under this key and are whole."""
    if not path.is_file():
        return None
    try:
        kept = read_checked(path, MeasuredPoint)
        if kept["key"] == key and not kept["crashed"] and kept["rows"]:
            return [dict(row) for row in kept["rows"]]
    except (InputError, KeyError, TypeError, ValueError):
        pass
    return None


def measure(job: Job, one: Wanted, spec: dict[str, Any], expected: float) -> list[dict[str, Any]]:
    """Have the child measure the point, keep and answer its rows; a point that cannot be made is a row with the reason."""
    path = place(job, one)
    path.parent.mkdir(parents=True, exist_ok=True)
    ask, answer, log = (
        path.with_name(f".tmp-{os.getpid()}-{name}-{one.name}.{suffix}")
        for name, suffix in (("job", "json"), ("answer", "json"), ("log", "txt"))
    )
    try:
        write_json(ask, {**spec, "answer": str(answer)})
        job.progress.begin(one.name)
        start = time.monotonic()
        code = run_child(job, ask, log, expected)
        seconds = time.monotonic() - start
        if answer.is_file():
            found, crashed = read_json(answer), False
        else:
            ended = f"by signal {-code}" if code < 0 else f"with exit code {code}"
            told = "; the memory may not have been enough" if code == -9 else f": {log_tail(log)}"
            found, crashed = {"error": f"its process ended {ended}{told}"}, True
        nothing = {"method": one.method, "wanted": one.wanted, "setting": {}, "seed": one.seed}
        rows = found.get("rows") or [{**nothing, "error": found.get("error", "unknown")}]
        write_json(path, {"key": spec["key"], "crashed": crashed, "wall_seconds": round(seconds, 3), "rows": rows})
        job.progress.finish(one.name, seconds, False)
    finally:
        for leftover in (ask, answer, log):
            remove(leftover)
    return list(rows)


def run_child(job: Job, ask: Path, log: Path, expected: float) -> int:
    """The child's exit code.

    Raises:
        Interrupted: the user asked to stop; the child is dead by then.
    """

    def tick(seconds: float) -> None:
        job.progress.check()
        job.progress.update(min(seconds, expected), expected)

    return run_logged(["-m", "fieldfuse.pipelines.tradeoff_child", str(ask)], log, tick)


def finish(one: Wanted, row: dict[str, Any]) -> dict[str, Any]:
    """A kept row with what the plan says about it: its name and the axes that it is a step on."""
    variant = row.get("variant")
    wanted = row.get("wanted") or one.wanted
    return {
        **row,
        "id": point_id(row["method"], wanted),
        "axes": [variant] if variant else list(one.axes),
        "setting": {**row["setting"], "wanted": wanted},
    }
