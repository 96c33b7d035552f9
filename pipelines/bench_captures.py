"""`fieldfuse bench captures DATA --out DIR`: whole runs of a folder of captures by default settings, and what came of each in one table."""

from __future__ import annotations

import json as writer
import os
import sys
import time
from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from fieldfuse.errors import Interrupted
from fieldfuse.pipelines.console import ConsoleProgress
from fieldfuse.pipelines.options import Budget, Config, Device, ImageSize, Json, Out, Pairs, Preset, Quiet, Threads, gather

FILE = "captures"
RUNS = "runs"  # OUT/runs/CAPTURE/VARIANT-SEED are ordinary run folders
VARIANTS = {"default": [], "effects off": ["--set", "effects=off"], "own poses": ["--poses", "sfm"]}
UNPOSED = ("photos", "video")  # kinds whose poses are estimated anyway
REFUSED = 2  # exit code of bad input
MARK = "fieldfuse: "  # what the one sentence of an error begins with
MODELLED = ("view_dependence", "background")  # parts of the field, no corrections


@dataclass(frozen=True)
class Plan:
    """What is run: the options of every run, variants by name, seeds, and seconds after which a run is ended."""

    out: Path
    options: tuple[str, ...]
    compare_effects: bool
    seeds: tuple[int, ...]
    timeout: float


def captures(
    data: Annotated[Path, typer.Argument(help="Folder of captures: each sub-folder, video or recording is one.", show_default=False)],
    out: Out,
    only: Annotated[str | None, typer.Option(help="Names of captures, separated by commas; default: all.", show_default=False)] = None,
    compare_effects: Annotated[
        bool,
        typer.Option("--compare-effects", help="Run each with effects off, too; and posed captures with their own poses (--poses sfm)."),
    ] = False,
    seeds: Annotated[str, typer.Option(help="Seeds, separated by commas; their scores stand side by side.")] = "0",
    jobs: Annotated[int, typer.Option(min=1, help="Captures at the same time; they share the threads.")] = 1,
    timeout: Annotated[float, typer.Option(min=10, help="Seconds after which a run is ended and counts as failed.")] = 3600.0,
    preset: Preset = None,
    budget: Budget = None,
    image_size: ImageSize = None,
    device: Device = None,
    threads: Threads = None,
    config: Config = None,
    pairs: Pairs = None,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Run every capture of a folder by default settings and write one table: read or refused, frames registered, PSNR beside the nearest
    image's, effects that were corrected, seconds, warnings.

    Each run is a process of its own, so that none of them ends the table. Repeat the command after an interruption: finished runs are
    reused.
    """
    from fieldfuse.errors import InputError
    from fieldfuse.evaluation.captures_table import captures_table
    from fieldfuse.pipelines.console import make_progress
    from fieldfuse.pipelines.job import read_settings

    numbers = tuple(dict.fromkeys(part.strip() for part in seeds.split(",") if part.strip()))
    if not numbers or not all(number.isdecimal() for number in numbers):
        raise InputError(f"--seeds {seeds!r} must be whole numbers separated by commas")
    if threads is None and jobs > 1:
        threads = max(1, (os.cpu_count() or 1) // jobs)
    flags: dict[str, Any] = {"budget": budget, "image_size": image_size, "device": device, "threads": threads}
    read_settings(gather(preset, config, pairs, **flags))  # a bad setting is refused once, not by each run
    flags |= {"preset": preset, "config": config}
    options = [word for name, value in flags.items() if value is not None for word in (f"--{name.replace('_', '-')}", str(value))]
    options += [word for pair in [*(pairs or []), "export.formats=[]"] for word in ("--set", pair)]
    plan = Plan(out, tuple(options), compare_effects, tuple(map(int, numbers)), timeout)
    found = bench_captures(sources(data, out, only), plan, jobs, make_progress(quiet))
    if json:
        sys.stdout.write(writer.dumps(found, indent=1) + "\n")
    elif not quiet:
        sys.stdout.write(captures_table(found))


def sources(data: Path, out: Path, only: str | None = None) -> list[Path]:
    """The captures in the folder: all sub-folders, and files that hold a capture (videos, recordings), by name.

    Raises:
        InputError: there are none, or not those of `only`.
    """
    from fieldfuse.capture.detect import FILMS
    from fieldfuse.capture.listing import natural_key
    from fieldfuse.capture.sens import is_sens
    from fieldfuse.errors import InputError

    try:
        held = sorted(data.absolute().iterdir(), key=lambda path: natural_key(path.name))
    except OSError as error:
        raise InputError(f"cannot list {data} ({error.strerror or error}); give the folder that holds the captures") from error

    def is_source(path: Path) -> bool:
        if path.name.startswith(".") or os.path.realpath(path) == os.path.realpath(out):
            return False
        return path.is_dir() or (path.is_file() and (path.suffix.lower() in FILMS or is_sens(path)))

    found = {path.name: path for path in held if is_source(path)}
    wanted = [name.strip() for name in only.split(",") if name.strip()] if only is not None else list(found)
    if missing := [name for name in wanted if name not in found]:
        raise InputError(f"{data} holds no capture {missing[0]!r}; there are {', '.join(found) or 'none'}")
    if not wanted:
        raise InputError(f"{data} holds no captures; give the folder that has one sub-folder (or video) for each")
    return [found[name] for name in dict.fromkeys(wanted)]


def bench_captures(found: Sequence[Path], plan: Plan, jobs: int, progress: ConsoleProgress) -> dict[str, Any]:
    """Run all captures, `jobs` at the same time; `captures.json` and `captures.md` are written after each. Answers the former.

    Raises:
        Interrupted: the user asked to stop; what is finished is in the files.
    """
    rows: dict[str, list[dict[str, Any]]] = {}
    with progress.listening(), ThreadPoolExecutor(jobs) as pool:
        progress.begin(FILE)
        began = time.monotonic()
        waiting = {pool.submit(runs_of, source, plan, progress): source for source in found}

        def keep(future: Future[list[dict[str, Any]]]) -> None:
            source = waiting.pop(future)
            rows[source.name] = future.result()
            progress.say(f"{shown(source)}: {said(rows[source.name][0])}")
            put(found, rows, plan)
            progress.update(len(rows), len(found), f"{len(rows)} of {len(found)}")

        try:
            while waiting:
                progress.check()
                for future in wait(waiting, timeout=0.2, return_when=FIRST_COMPLETED).done:
                    keep(future)
        except BaseException as error:
            progress.request_stop()  # so that the others end their runs
            pool.shutdown(cancel_futures=True)
            finished = [one for one in waiting if not one.cancelled() and one.exception() is None]
            for future in finished if isinstance(error, Interrupted) else []:
                keep(future)
            raise
        progress.finish(FILE, time.monotonic() - began, False)
    return put(found, rows, plan)


def runs_of(source: Path, plan: Plan, progress: ConsoleProgress) -> list[dict[str, Any]]:
    """The runs of one capture: by default settings, and those that it is compared with."""
    rows: list[dict[str, Any]] = []
    for variant, options in VARIANTS.items():
        if rows and not (plan.compare_effects and worth(variant, rows[0])):
            continue
        for seed in plan.seeds:
            made = run_one(source, plan, [*options, "--seed", str(seed)], f"{variant}-{seed}", progress)
            rows.append({"variant": variant, "seed": seed, **made})
    return rows


def worth(variant: str, first: dict[str, Any]) -> bool:
    """Whether the run can differ from the first: what came without poses has its own anyway, and effects do
    not decide what is refused."""
    if variant == "own poses":
        return first["poses"] != "sfm" and first["kind"] not in UNPOSED
    return first["state"] == "read"


def run_one(source: Path, plan: Plan, options: list[str], name: str, progress: ConsoleProgress) -> dict[str, Any]:
    """One run in a process of its own, as far as it came: `state` is "read", "refused" (bad input, with its sentence) or "failed"."""
    from fieldfuse.errors import FieldfuseError, first_line
    from fieldfuse.files import read_json, remove
    from fieldfuse.poses.child import end_reason, import_path, log_tail, run_logged

    folder = plan.out / RUNS / source.name / name.replace(" ", "-")
    log = folder.with_name(f"{folder.name}.log")
    log.parent.mkdir(parents=True, exist_ok=True)
    command = ["-m", "fieldfuse.pipelines.bench_captures", "run", str(source), "--out", str(folder), *plan.options, *options, "--quiet"]
    try:
        code = run_logged(command, log, lambda _: progress.check(), plan.timeout, import_path())
        if code == 0:
            found = facts(read_json(folder / "report.json"))
            remove(log)
            return {"state": "read", "error": None, **found}
        said = log_tail(log).removeprefix(MARK)
        state, why = ("refused", said) if code == REFUSED else ("failed", f"its process {end_reason(code)}: {said}")
    except Interrupted:
        raise
    except TimeoutError as error:
        state, why = "failed", f"{error}"
    except (FieldfuseError, LookupError, TypeError, AttributeError) as error:
        state, why = "failed", f"its report cannot be read ({first_line(error)})"
    return {"state": state, "error": why, "kind": kind_of(folder), "poses": None}


def kind_of(folder: Path) -> str | None:
    """What a run that was refused later had found its source to be; None: it did not come so far."""
    from fieldfuse.errors import FieldfuseError
    from fieldfuse.files import read_json

    try:
        return str(read_json(folder / "capture.json")["kind"])
    except (FieldfuseError, LookupError, TypeError):
        return None


def shown(source: Path) -> str:
    """The capture's name as text, whatever bytes it is made of."""
    return " ".join(os.fsencode(source.name).decode("utf-8", "replace").split())


def facts(report: dict[str, Any]) -> dict[str, Any]:
    """A finished run's entries in the table; PSNR counts the pixels within the masks of a capture that has them."""
    scores, poses, effects = report["evaluation"], report["poses"], (report.get("effects") or {}).get("effects", [])
    field, nearest = scores["field"] or {}, scores["nearest_image"] or {}
    return {
        "kind": report["capture"]["kind"],
        "poses": poses["source"],
        "registered": poses["registered"],
        "total": poses["total"],
        "masks": report["capture"]["masks"],
        "views": report["views"],
        **{key: field.get(key) for key in ("psnr", "ssim", "lpips")},
        "nearest_image": nearest.get("psnr"),
        "seconds": report["seconds_total"],
        "effects": [entry["effect"] for entry in effects if entry.get("on") and entry["effect"] not in MODELLED],
        "warnings": report["warnings"],
    }


def put(found: Sequence[Path], rows: dict[str, list[dict[str, Any]]], plan: Plan) -> dict[str, Any]:
    """Write what there is so far, in the order of the folder."""
    from fieldfuse import __version__
    from fieldfuse.evaluation.captures_table import captures_table
    from fieldfuse.evaluation.speed import machine
    from fieldfuse.files import atomic_path, write_json
    from fieldfuse.pipelines.folder import command_line

    threads = plan.options[plan.options.index("--threads") + 1] if "--threads" in plan.options else os.cpu_count() or 1
    data = {
        "version": __version__,
        "command": command_line(),
        "machine": {**machine(int(threads)), "measured": time.strftime("%Y-%m-%d")},
        "captures": [{"capture": shown(source), "runs": rows[source.name]} for source in found if source.name in rows],
    }
    write_json(plan.out / f"{FILE}.json", data)
    with atomic_path(plan.out / f"{FILE}.md") as temporary:
        temporary.write_text(captures_table(data), encoding="utf-8")
    return data


def said(row: dict[str, Any]) -> str:
    """A run in a few words."""
    from fieldfuse.evaluation.words import decimal

    return f"{row['state']}: {row['error']}" if row["error"] else f"{decimal(row['psnr'])} dB, {row['registered']} of {row['total']} frames"


if __name__ == "__main__":  # the process of one run
    from fieldfuse.pipelines.cli import program
    from fieldfuse.poses.worker import die_with_parent

    die_with_parent()
    program()
