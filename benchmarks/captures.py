"""`python -m benchmarks.captures DATA --out DIR`: whole runs of a folder of captures by default settings, in one table.

Each run is a process of its own, so that none of them ends the table; OUT/runs/CAPTURE/VARIANT-SEED are ordinary run folders, whose
finished stages are reused.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from benchmarks.experiment import Experiment, Row, application, markdown, program, section, show
from fieldfuse.capture.detect import FILMS
from fieldfuse.capture.listing import natural_key
from fieldfuse.capture.sens import is_sens
from fieldfuse.errors import FieldfuseError, InputError, Interrupted, first_line
from fieldfuse.evaluation import words
from fieldfuse.files import read_json, remove
from fieldfuse.pipelines.console import ConsoleProgress, make_progress
from fieldfuse.pipelines.job import read_settings
from fieldfuse.pipelines.options import Budget, Config, Device, ImageSize, Out, Pairs, Preset, Quiet, Threads, gather
from fieldfuse.poses import child

RUNS = "runs"
VARIANTS = {"default": [], "effects off": ["--set", "effects=off"], "own poses": ["--poses", "sfm"]}
UNPOSED = ("photos", "video")  # kinds whose poses are estimated anyway
REFUSED = 2  # exit code of bad input
MARK = "fieldfuse: "  # what the one sentence of an error begins with
MODELLED = ("view_dependence", "background")  # parts of the field, no corrections
LONGEST = 250  # characters of a sentence in the table; whole in captures.json
RUN = (
    "from fieldfuse.poses.child import die_with_parent; die_with_parent(); from fieldfuse.pipelines.cli import program; program()"
)  # the process of one run


@dataclass(frozen=True)
class Plan:
    """How captures are run: the options of every run, seeds, and seconds after which a run is ended."""

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
) -> None:
    """Run every capture of a folder by default settings and write one table: read or refused, frames registered, PSNR beside the nearest
    image's, effects that were corrected, seconds, warnings."""
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
    progress = make_progress(quiet)
    found = experiment(sources(data, out, only), plan, progress, jobs).conduct(out, progress, threads, device or "cpu")
    show(section(found, table), quiet)


def experiment(found: Sequence[Path], plan: Plan, progress: ConsoleProgress, jobs: int = 1) -> Experiment:
    """A row a capture, with all of its runs."""
    named = {shown(source): source for source in found}
    entries = [{"capture": name} for name in named]
    return Experiment("captures", entries, lambda entry: {"runs": runs_of(named[entry["capture"]], plan, progress)}, table, jobs=jobs)


def sources(data: Path, out: Path, only: str | None = None) -> list[Path]:
    """The captures in the folder: all sub-folders, and files that hold a capture (videos, recordings), by name.

    Raises:
        InputError: there are none, or not those of `only`.
    """
    try:
        inside = sorted(data.absolute().iterdir(), key=lambda path: natural_key(path.name))
    except OSError as error:
        raise InputError(f"cannot list {data} ({error.strerror or error}); give the folder that holds the captures") from error

    def is_source(path: Path) -> bool:
        if path.name.startswith(".") or os.path.realpath(path) == os.path.realpath(out):
            return False
        return path.is_dir() or (path.is_file() and (path.suffix.lower() in FILMS or is_sens(path)))

    found = {path.name: path for path in inside if is_source(path)}
    wanted = [name.strip() for name in only.split(",") if name.strip()] if only is not None else list(found)
    if missing := [name for name in wanted if name not in found]:
        raise InputError(f"{data} holds no capture {missing[0]!r}; there are {', '.join(found) or 'none'}")
    if not wanted:
        raise InputError(f"{data} holds no captures; give the folder that has one sub-folder (or video) for each")
    return [found[name] for name in dict.fromkeys(wanted)]


def runs_of(source: Path, plan: Plan, progress: ConsoleProgress) -> list[Row]:
    """The runs of one capture: by default settings, and those that it is compared with."""
    rows: list[Row] = []
    for variant, options in VARIANTS.items():
        if rows and not (plan.compare_effects and worth(variant, rows[0])):
            continue
        for seed in plan.seeds:
            made = run_one(source, plan, [*options, "--seed", str(seed)], f"{variant}-{seed}", progress)
            rows.append({"variant": variant, "seed": seed, **made})
    return rows


def worth(variant: str, first: Row) -> bool:
    """Whether the run can differ from the first: what came without poses has its own anyway, and effects do
    not decide what is refused."""
    if variant == "own poses":
        return first["poses"] != "sfm" and first["kind"] not in UNPOSED
    return bool(first["state"] == "read")


def run_one(source: Path, plan: Plan, options: list[str], name: str, progress: ConsoleProgress) -> Row:
    """One run in a process of its own, as far as it came: `state` is "read", "refused" (bad input, with its sentence) or "failed"."""
    folder = plan.out / RUNS / source.name / name.replace(" ", "-")
    log = folder.with_name(f"{folder.name}.log")
    log.parent.mkdir(parents=True, exist_ok=True)
    command = ["-c", RUN, "run", str(source), "--out", str(folder), *plan.options, *options, "--quiet"]
    try:
        code = child.run_logged(command, log, lambda _: progress.check(), plan.timeout, child.import_path())
        if code == 0:
            found = facts(read_json(folder / "report.json"))
            remove(log)
            return {"state": "read", "error": None, **found}
        said = child.log_tail(log).removeprefix(MARK)
        state, why = ("refused", said) if code == REFUSED else ("failed", f"its process {child.end_reason(code)}: {said}")
    except Interrupted:
        raise
    except TimeoutError as error:
        state, why = "failed", f"{error}"
    except (FieldfuseError, LookupError, TypeError, AttributeError) as error:
        state, why = "failed", f"its report cannot be read ({first_line(error)})"
    return {"state": state, "error": why, "kind": kind_of(folder), "poses": None}


def kind_of(folder: Path) -> str | None:
    """The kind of source that a run had found before it was refused; None: it did not come so far."""
    try:
        return str(read_json(folder / "capture.json")["kind"])
    except (FieldfuseError, LookupError, TypeError):
        return None


def shown(source: Path) -> str:
    """The capture's name as text, whatever bytes it is made of."""
    return " ".join(os.fsencode(source.name).decode("utf-8", "replace").split())


def facts(report: dict[str, Any]) -> Row:
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


def table(data: Row) -> str:
    """Markdown: a row a capture; seeds side by side, variants in columns of their own."""
    rows = data["rows"]
    variants = list(dict.fromkeys(run["variant"] for row in rows for run in row["runs"])) or ["default"]
    head = ["capture", "poses", "frames", *(f"PSNR, {name}" for name in variants), "nearest image", "corrected", "seconds", "warnings"]
    return markdown(head, ([row["capture"], *_cells(row["runs"], variants)] for row in rows))


def _cells(runs: Sequence[Row], variants: Sequence[str]) -> list[str]:
    """All but the capture's name. Poses, frames, effects, seconds and warnings are of its first run."""
    first = runs[0]
    scores = [_scores([run for run in runs if run["variant"] == name], first) for name in variants]
    if first["state"] != "read":
        return ["", words.NONE, *scores, "", "", "", ""]
    warned = first["warnings"]
    return [
        f"{first['kind']}, {first['poses']}",
        f"{first['registered']} of {first['total']}",
        scores[0] + (" (within its masks)" if first["masks"] else ""),
        *scores[1:],
        words.decimal(first["nearest_image"], 1),
        ", ".join(name.replace("_", " ") for name in first["effects"]) or "nothing",
        words.decimal(first["seconds"], 0),
        f"{len(warned)}: {_short(warned[0])}" if warned else "none",
    ]


def _scores(runs: Sequence[Row], first: Row) -> str:
    """PSNR of each seed; for a run that failed its sentence, once."""

    def text(run: Row) -> str:
        if run["state"] == "read":
            return words.decimal(run["psnr"])
        again = run is not first and run["error"] == first["error"]
        return str(run["state"]) if again else _short(f"{run['state']}: {run['error']}")

    return ", ".join(map(text, runs)) or words.NONE


def _short(text: str) -> str:
    return text if len(text) <= LONGEST else text[: LONGEST - 1].rstrip() + "…"


app = application(captures)
if __name__ == "__main__":
    program(app)
