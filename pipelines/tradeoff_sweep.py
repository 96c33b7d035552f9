"""The sweep behind `fieldfuse tradeoff`: one step at a time around the default along each axis, each point in a process of its own.

A point is written as soon as it is measured, and reused when nothing that went into it has changed.
"""

from __future__ import annotations

import os
import shlex
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from fieldfuse.config import Settings, settings_dict
from fieldfuse.errors import InputError
from fieldfuse.evaluation.tradeoff import AXES
from fieldfuse.files import fingerprint, read_json, remove, write_json
from fieldfuse.pipelines.console import ConsoleProgress
from fieldfuse.pipelines.direct_field import weights_state
from fieldfuse.pipelines.job import Job, open_job
from fieldfuse.pipelines.options import Place
from fieldfuse.pipelines.prepare import prepare
from fieldfuse.pipelines.schemas import MeasuredPoint, read_checked
from fieldfuse.pipelines.stages import BEFORE
from fieldfuse.poses.child import log_tail, run_logged

VERSION = 1  # raised when what a point measures changes
FIRST_GUESS = 15.0  # seconds that a point takes beside its fitting time, before one was measured
TIMES = (3.0, 10.0, 30.0, 60.0, 120.0, 300.0, 900.0)
BASE_TIME = 30.0  # the largest of the times up to this is the default that single steps start from
DECODER_TIMES = (10.0, 60.0)  # both decoders are measured at the times between these
DEFAULT = {"voxel_size": 1.0, "views": 1.0, "samples": 4, "precision": "float16"}
SHARES = (0.25, 0.5)  # of the training views, beside all of them
SURFACE_STEPS = {"voxel_size": (4.0, 2.0, 1.0, 0.5), "views": SHARES}  # voxel sizes are shares of the automatic one
FIELD_STEPS = {"voxel_size": (2.0, 1.4, 0.7), "views": SHARES}
DIRECT_STEPS = {"keyframes": (0.1, 0.25, 0.5), "voxel_size": (2.0, 1.4)}  # the networks' own voxels are as fine as pays
VARIANTS: dict[str, tuple[Any, ...]] = {"samples": (2, 8), "precision": ("uint8", "float32")}  # of the same fit, beside the default


@dataclass(frozen=True)
class Choice:
    """What the command line chooses: axes and seconds of fitting (names and numbers with commas; None: all), how many seeds, and seconds
    for this call (None: as many as it takes)."""

    axes: str | None = None
    times: str | None = None
    seeds: int = 1
    budget: float | None = None


@dataclass(frozen=True)
class Planned:
    """One thing to make and measure.

    Attributes:
        wanted: axis → value: seconds, shares of the automatic voxel size and of the training views, names.
        axes: those along which it is a step.
        variants: other ways to store or show the same result, each with its axis.
    """

    method: str
    wanted: dict[str, Any]
    axes: tuple[str, ...]
    seed: int = 0
    variants: tuple[dict[str, Any], ...] = ()

    @property
    def id(self) -> str:
        return point_id(self.method, self.wanted)

    @property
    def name(self) -> str:
        """Of its file."""
        return f"{self.id}-seed{self.seed}"

    @property
    def is_surface(self) -> bool:
        return self.method.startswith("tsdf")


def point_id(method: str, wanted: dict[str, Any]) -> str:
    """A name of what differs from the default: `field-30s-views0.5`."""
    parts = [method, *([f"{wanted['iterations']:g}s"] if "iterations" in wanted else [])]
    default = {**DEFAULT, "keyframes": 1.0}
    return "-".join(parts + [f"{key.split('_')[0]}{wanted[key]}" for key in default if wanted.get(key, default[key]) != default[key]])


# ------------------------------------------------------------------------------------------------- the plan


def chosen_axes(text: str | None, can_vary: Sequence[str], why_not: dict[str, str]) -> list[str]:
    """The axes that `--axes` names, all that there are without it.

    Raises:
        InputError: one that does not exist, or that cannot be varied here.
    """
    if text is None:
        return list(can_vary)
    names = [name.strip().replace("-", "_") for name in text.split(",") if name.strip()]
    there = f"here {', '.join(can_vary)} can be varied"
    for name in names:
        if name not in can_vary:
            reason = f"the axis {name} cannot be varied, because {why_not[name]}" if name in why_not else f"there is no axis {name!r}"
            raise InputError(f"{reason}; {there}")
    if not names:
        raise InputError(f"--axes names no axis; {there}")
    return list(dict.fromkeys(names))


def chosen_times(text: str | None) -> list[float]:
    """The seconds that `--times` names, ascending.

    Raises:
        InputError: not a list of positive numbers.
    """
    if text is None:
        return list(TIMES)
    try:
        times = sorted({float(part) for part in text.split(",") if part.strip()})
    except ValueError:
        times = []
    if not times or not all(0.2 <= time <= 86400 for time in times):
        raise InputError(f"--times is {text!r}; it must be seconds of fitting from 0.2 on, separated by commas, such as 3,10,30")
    return times


def plan(axes: Iterable[str], times: Sequence[float], seeds: int, surface: str | None) -> list[Planned]:
    """Everything to be measured, the most telling first; repetitions with other seeds last. Surfaces draw no random numbers.

    Args:
        surface: `tsdf` or `tsdf_stereo`; None: there is no depth.
    """
    axes = list(axes)
    base = max([time for time in times if time <= BASE_TIME] or [min(times)])
    ladder = [base, *(time for time in times if time != base)] if "iterations" in axes else [base]
    both = [time for time in sorted(ladder) if DECODER_TIMES[0] <= time <= DECODER_TIMES[1]] or [base]

    def fields(seed: int) -> list[Planned]:
        deferred = {"iterations": base, **DEFAULT, "decoder": "deferred"}
        first, *others = _steps("field", deferred, FIELD_STEPS, axes, seed)
        on = {time: [axis for axis in ("iterations", "decoder") if axis in axes and (axis != "decoder" or time in both)] for time in ladder}
        variants = tuple({"axis": axis, axis: value} for axis, values in VARIANTS.items() if axis in axes for value in values)
        at_base = tuple(axis for axis in AXES if axis in first.axes or axis in on[base] or (axis in axes and axis in VARIANTS))
        climb = [Planned("field", {**deferred, "iterations": time}, tuple(on[time]), seed) for time in ladder[1:]]
        if "decoder" in axes:
            per_sample = {**deferred, "decoder": "per_sample"}
            along = tuple(axis for axis in ("decoder", "iterations") if axis in axes)
            others += [Planned("field_per_sample", {**per_sample, "iterations": time}, along, seed) for time in both]
        return [replace(first, axes=at_base, variants=variants), *climb, *others]

    surfaces = []
    if surface is not None:  # matching uses all views: with fewer of them depth would be another, too
        along = {key: values for key, values in SURFACE_STEPS.items() if key != "views" or surface == "tsdf"}
        surfaces = _steps(surface, {"voxel_size": 1.0, "views": 1.0}, along, axes)
        surfaces = [replace(surfaces[0], axes=tuple(axis for axis in SURFACE_STEPS if axis in axes)), *surfaces[1:]]
    whole = {"keyframes": 1.0, "views": 1.0, "voxel_size": 1.0}
    direct = _steps("direct", whole, DIRECT_STEPS, axes) if "keyframes" in axes else []
    first = fields(0)
    out = [first[0], *surfaces[:1], *first[1 : len(ladder)], *surfaces[1:], *first[len(ladder) :], *direct]
    return out + [one for seed in range(1, seeds) for one in fields(seed)]


def _steps(method: str, base: dict[str, Any], along: dict[str, tuple[Any, ...]], axes: Sequence[str], seed: int = 0) -> list[Planned]:
    """The base, then one setting changed at a time."""
    varied = {axis: values for axis, values in along.items() if axis in axes}
    out = [Planned(method, base, tuple(axis for axis in AXES if axis in varied), seed)]
    for axis, values in varied.items():
        out += [Planned(method, {**base, axis: value}, (axis,), seed) for value in values if value != base[axis]]
    return out


def axes_here(settings: Settings) -> tuple[list[str], dict[str, str]]:
    """The axes that can be varied, and for the others why not."""
    from fieldfuse.training.from_network import SHIPPED

    why_not = {}
    if not SHIPPED.is_file():
        why_not["keyframes"] = "only the networks have key frames, and their weights are not installed"
    if settings.field.decoder == "per_sample":
        why_not["precision"] = "a field with the decoder per sample is stored in one precision only"
        why_not["decoder"] = "it is set; leave out --decoder to compare both"
    return [axis for axis in AXES if axis not in why_not], why_not


# ------------------------------------------------------------------------------------------------- the sweep


def tradeoff_run(place: Place, options: dict[str, Any], choice: Choice, progress: ConsoleProgress) -> dict[str, Any]:
    """Measure what is missing and write `tradeoff.csv`, `tradeoff.html` and the plots; answers `tradeoff.json`.

    Raises:
        InputError: no test views, an axis that cannot be varied, times that are no numbers.
        Interrupted: the user asked to stop; what was measured is written.
    """
    from fieldfuse.evaluation.machine import machine
    from fieldfuse.evaluation.tradeoff_page import write_tradeoff
    from fieldfuse.pipelines.summary import base_data, warnings_of
    from fieldfuse.pipelines.surfaces import match_images

    ladder = chosen_times(choice.times)
    with open_job(place, options, progress, (*BEFORE, "stereo")) as job:
        can_vary, why_not = axes_here(job.settings)
        axes = chosen_axes(choice.axes, can_vary, why_not)
        ready = prepare(job)
        scene, views = ready.scene, ready.views
        if not views.test.any():
            raise InputError("what accuracy costs is measured on images kept for testing, and there is none; give --holdout 8")
        surface: str | None = "tsdf" if ready.posed.has_depth else "tsdf_stereo"
        refused = [f"The axis {name} was not varied: {why}." for name, why in why_not.items()]
        if surface == "tsdf_stereo":
            try:
                match_images(job, ready)
            except InputError as error:  # a camera that only moves forward leaves nothing to match; the field can still be measured
                surface = None
                refused.append(f"No surface was made: {error}.")
        planned, rows = plan(axes, ladder, choice.seeds, surface), list[dict[str, Any]]()
        try:
            for found in sweep(job, planned, choice.budget):
                rows += found
        finally:  # what was measured is shown, however the sweep ends
            done = {(row["id"], row["seed"]) for row in rows}
            base, lens = base_data(job, ready.capture, ready.poses), views.intrinsics[0]
            data = {
                **base,
                "command": unbounded(base["command"]),
                "warnings": warnings_of(job, ready),
                "scene": scene.to_dict(),
                "unit": "m" if scene.metric else "units",
                "views": {"total": len(views), "test": int(views.test.sum()), "width": lens.width, "height": lens.height},
                "rows": rows,
                "left_out": [one.name for one in planned if (one.id, one.seed) not in done],
                "refused": refused,
                "machine": machine(job.settings.threads, job.settings.device),
            }
            data = write_tradeoff(job.folder.path, data)
    return data


def sweep(job: Job, planned: Sequence[Planned], budget: float | None) -> Iterator[list[dict[str, Any]]]:
    """The rows of each point, measured or reused; with a `budget` of seconds, without those that would not fit into it.

    Raises:
        Interrupted: the user asked to stop.
    """
    began, base_voxel = time.monotonic(), None
    beside = {True: FIRST_GUESS, False: FIRST_GUESS}  # seconds that a surface (True) or a field takes beside its fitting time
    for one in planned:
        spec = point_spec(job, one, base_voxel)
        path = job.folder / "tradeoff" / "points" / f"{one.name}.json"
        rows, fitting = rows_at(path, spec["key"]), float(one.wanted.get("iterations", 0.0))
        if rows is None:
            start, expected = time.monotonic(), fitting + beside[one.is_surface]
            if budget is not None and start - began + expected > budget:
                continue
            rows = measure(job, one, spec, path, expected)
            beside[one.is_surface] = max(time.monotonic() - start - fitting, 0.7 * beside[one.is_surface])
        if one.is_surface and one.wanted["voxel_size"] == 1 and rows[0]["error"] is None:
            base_voxel = rows[0]["setting"]["working_voxel"]
        out = []
        for row in rows:
            wanted, variant = row.get("wanted") or one.wanted, row.get("variant")
            setting = {**row["setting"], "wanted": wanted}
            out.append({**row, "id": point_id(row["method"], wanted), "axes": [variant] if variant else list(one.axes), "setting": setting})
        yield out


def point_spec(job: Job, one: Planned, base_voxel: float | None) -> dict[str, Any]:
    """All that the child is given; its key stands for everything that the result depends on."""
    settings, records = job.settings, job.stages.records
    if one.is_surface:
        own: list[Any] = [asdict(settings.tsdf), base_voxel]
    elif one.method == "direct":
        own = [asdict(settings.network), asdict(settings.keyframes), weights_state(settings), settings.field.background, settings.device]
    else:
        own = [asdict(settings.field), asdict(replace(settings.fit, budget=None)), settings.engine, settings.device]
    made = {name: records[name].made for name in ("views", "scene", "poses", "stereo") if name in records}
    return {
        "key": fingerprint(VERSION, one.method, one.wanted, one.seed, list(one.variants), [made, own, settings.threads]),
        "folder": str(job.folder.path),
        "settings": settings_dict(settings),
        "method": one.method,
        "wanted": one.wanted,
        "seed": one.seed,
        "variants": list(one.variants),
        "stereo_seconds": records["stereo"].seconds if "stereo" in records else 0.0,
        "base_voxel": base_voxel,
    }


def rows_at(path: Path, key: str) -> list[dict[str, Any]] | None:
    """The rows of an earlier sweep at `path`, if they were kept under this key and are not the remains of a crash."""
    if not path.is_file():
        return None
    try:
        kept = read_checked(path, MeasuredPoint)
        if kept["key"] == key and not kept["crashed"] and kept["rows"]:
            return [dict(row) for row in kept["rows"]]
    except (InputError, KeyError, TypeError, ValueError):
        pass
    return None


def measure(job: Job, one: Planned, spec: dict[str, Any], path: Path, expected: float) -> list[dict[str, Any]]:
    """Have a child measure the point, and keep and answer its rows; a point that cannot be made is a row with the reason.

    Raises:
        Interrupted: the user asked to stop; the child is dead by then.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    ask, answer, log = (path.with_name(f".tmp-{os.getpid()}-{what}-{one.name}") for what in ("job.json", "answer.json", "log.txt"))
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
            why = "; the memory may not have been enough" if code == -9 else f": {log_tail(log)}"
            found, crashed = {"error": f"its process ended {ended}{why}"}, True
        nothing = {"method": one.method, "wanted": one.wanted, "setting": {}, "seed": one.seed}
        rows: list[dict[str, Any]] = found.get("rows") or [{**nothing, "error": found.get("error", "unknown")}]
        write_json(path, {"key": spec["key"], "crashed": crashed, "wall_seconds": round(seconds, 3), "rows": rows})
        job.progress.finish(one.name, seconds, False)
    finally:
        for leftover in (ask, answer, log):
            remove(leftover)
    return rows


def run_child(job: Job, ask: Path, log: Path, expected: float) -> int:
    """The exit code of the process that measures the point in the file `ask`."""

    def tick(seconds: float) -> None:
        job.progress.check()
        job.progress.update(min(seconds, expected), expected)

    return run_logged(["-m", "fieldfuse.pipelines.tradeoff_point", str(ask)], log, tick)


def unbounded(command: str) -> str:
    """The command without `--budget`, which bounds one call of several: this one makes every row at once."""
    parts, out = iter(shlex.split(command)), []
    for part in parts:
        if part == "--budget":
            next(parts, None)
        elif not part.startswith("--budget="):
            out.append(part)
    return shlex.join(out)
