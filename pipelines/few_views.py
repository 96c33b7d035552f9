"""`fieldfuse bench few-views SOURCE` and `fieldfuse bench ablations SOURCE`: tables of what few pictures and parts of the networks give."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fieldfuse.pipelines.options import Config, ImageSize, Out, Pairs, Quiet, Seed, Source, gather

if TYPE_CHECKING:
    from fieldfuse.capture.types import Capture
    from fieldfuse.effects.correct import Corrections
    from fieldfuse.evaluation.few_views import Ground
    from fieldfuse.pipelines.job import Job

ALL = "all"
FILE = "few_views"
ABLATIONS = "ablations"


def few_views(
    source: Source,
    out: Out,
    views: Annotated[str, typer.Option(help="Numbers of training views, by comma; 'all' is one.")] = "3,6,12,all",
    budgets: Annotated[str, typer.Option(help="Seconds of fitting (processor time of one thread), by comma.")] = "30,120",
    starts: Annotated[str, typer.Option(help="What is measured, by comma.")] = "direct,network,classical",
    image_size: ImageSize = None,
    seed: Seed = None,
    config: Config = None,
    pairs: Pairs = None,
    quiet: Quiet = False,
) -> None:
    """Held-out quality of 3, 6, 12 … training views: networks alone, and fits from their start and from the classical one.

    Rows that OUT/few_views.json has already are not measured again, so an interrupted table goes on when the command is repeated. With
    other settings, or after the capture has changed, all are.
    """
    from fieldfuse.evaluation.few_views import few_views_rows, few_views_table
    from fieldfuse.training.from_network import load_networks

    seconds, measured = numbers(budgets, "budgets"), part_of(starts)
    counts = [None if part == ALL else int(part) for part in wanted(views)]
    with opened(source, out, gather(None, config, pairs, image_size=image_size, seed=seed, threads=1), quiet) as (job, posed, corrections):
        of = state_of(job)
        rows = rows_of(job, of)
        model = load_networks(job.settings.network.weights, job.settings.device)
        for count in counts:
            job.progress.begin(f"{count or ALL} views")
            ground = ground_of(job, posed, count, corrections)
            done = {(row["views"], row["start"], row["budget"]) for row in rows}
            for row in few_views_rows(ground, model, seconds, done, measured, job.progress):
                rows.append(row)
                keep_rows(job, FILE, rows, few_views_table(rows), of=of)
                job.progress.say(f"{row['views']} views, {row['start']}, {row['budget']:g} s: {row['psnr']:.2f} dB")
    tell(few_views_table(rows), quiet)


def ablations(
    source: Source,
    out: Out,
    views: Annotated[str, typer.Option(help="Number of training views, or 'all'.")] = ALL,
    image_size: ImageSize = None,
    seed: Seed = None,
    config: Config = None,
    pairs: Pairs = None,
    quiet: Quiet = False,
) -> None:
    """Direct inference with parts of the trained networks switched off: variance, direction code, GRU, pruning, second colours."""
    from fieldfuse.evaluation.few_views import ablation_rows, ablation_table
    from fieldfuse.training.from_network import load_networks

    count = None if views == ALL else int(numbers(views, "views")[0])
    rows = []
    with opened(source, out, gather(None, config, pairs, image_size=image_size, seed=seed, threads=1), quiet) as (job, posed, corrections):
        model = load_networks(job.settings.network.weights, job.settings.device)
        job.progress.begin(ABLATIONS)
        for row in ablation_rows(ground_of(job, posed, count, corrections), model, job.progress):
            rows.append(row)
            keep_rows(job, ABLATIONS, rows, ablation_table(rows))
    tell(ablation_table(rows), quiet)


def wanted(text: str) -> list[str]:
    """`3,6,all` → its parts.

    Raises:
        InputError: something is neither a positive whole number nor `all`.
    """
    from fieldfuse.errors import InputError

    parts = [part.strip() for part in text.split(",") if part.strip()]
    for part in parts:
        if part != ALL and not (part.isdigit() and int(part) > 0):
            raise InputError(f"--views {text!r}: {part!r} is neither a positive number nor 'all'")
    return parts


def part_of(text: str) -> list[str]:
    """`direct,network` → its parts.

    Raises:
        InputError: something is none of the starts.
    """
    from fieldfuse.errors import InputError
    from fieldfuse.evaluation.few_views import STARTS

    parts = [part.strip() for part in text.split(",") if part.strip()]
    for part in parts:
        if part not in STARTS:
            raise InputError(f"--starts {text!r}: there is no {part!r}; known are {', '.join(STARTS)}")
    return parts


def numbers(text: str, name: str) -> list[float]:
    """`30,120` → its numbers.

    Raises:
        InputError: something is not a positive number.
    """
    from fieldfuse.errors import InputError

    try:
        values = [float(part) for part in text.split(",") if part.strip()]
    except ValueError as error:
        raise InputError(f"--{name} {text!r} must be numbers separated by commas") from error
    if not values or any(not 0 < value < 1e6 for value in values):
        raise InputError(f"--{name} {text!r} must be positive numbers")
    return values


@contextmanager
def opened(source: Path, out: Path, options: dict[str, Any], quiet: bool) -> Iterator[tuple[Job, Capture, Corrections]]:
    """A job of one thread on `source`, with everything up to the effects done as a run does it with all training pictures, so that poses
    are the same for every number of views."""
    from fieldfuse.pipelines.console import make_progress
    from fieldfuse.pipelines.thread_limits import bound_threads

    bound_threads(options)
    from fieldfuse.pipelines.job import open_job
    from fieldfuse.pipelines.steps_capture import choose_frames, find_camera_poses, find_capture
    from fieldfuse.pipelines.steps_effects import find_effects

    with open_job(source, out, options, make_progress(quiet)) as job:
        capture = choose_frames(job, find_capture(job))
        posed = find_camera_poses(job, capture).apply(capture)
        corrections = find_effects(job, posed)
        yield job, corrections.on_capture(posed), corrections


def ground_of(job: Job, posed: Capture, count: int | None, corrections: Corrections) -> Ground:
    """The capture with `count` of its training views (None: all), as a run would prepare it."""
    from fieldfuse.capture.prepare import prepare_views
    from fieldfuse.capture.subset import limited
    from fieldfuse.evaluation.few_views import Ground
    from fieldfuse.poses.scene import describe_scene

    some = limited(posed, job.settings.capture.holdout, count)
    scene = describe_scene(some, job.progress)
    views = prepare_views(some, scene.working_from_input, job.settings.capture, job.progress)
    return Ground(corrections.on_views(views), scene, job.settings)


def state_of(job: Job) -> str:
    """Changes with whatever rows depend on, but for what they say of themselves: settings, weights, and what was made of the capture."""
    from fieldfuse.config import settings_dict
    from fieldfuse.files import fingerprint
    from fieldfuse.pipelines.direct_field import weights_state

    settings = settings_dict(job.settings)
    settings["fit"] = {key: value for key, value in settings["fit"].items() if key != "budget"}
    return fingerprint(settings, weights_state(job.settings), {name: record.made for name, record in job.stages.records.items()})


def rows_of(job: Job, state: str) -> list[dict[str, Any]]:
    """Rows that an earlier call kept; none when they are of another `state`."""
    from fieldfuse.pipelines.kept import FEW_VIEWS, read_kept

    path = job.folder / f"{FILE}.json"
    kept: dict[str, Any] = read_kept(path, FEW_VIEWS) if path.is_file() else {"rows": []}
    if kept["rows"] and kept.get("of") != state:
        job.progress.say("the rows that are there are of other settings or another state of the capture, and are measured again")
        return []
    return list(kept["rows"])


def keep_rows(job: Job, name: str, rows: list[dict[str, Any]], table: str, **more: str) -> None:
    from fieldfuse.config import settings_dict
    from fieldfuse.evaluation.speed import machine
    from fieldfuse.files import atomic_path, write_json

    about = {"source": str(job.source), "machine": machine(1), "settings": settings_dict(job.settings), **more, "rows": rows}
    write_json(job.folder / f"{name}.json", about)
    with atomic_path(job.folder / f"{name}.md") as temporary:
        temporary.write_text(table, encoding="utf-8")


def tell(table: str, quiet: bool) -> None:
    if not quiet:
        typer.echo(table.rstrip())
