"""`fieldfuse tradeoff SOURCE --out DIR`: what accuracy costs in time and memory on one capture, beside TSDF fusion."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

from fieldfuse.pipelines.options import Options, Place, bound_threads, show, takes

Axes = Annotated[
    str | None,
    typer.Option(
        help="Of iterations, voxel_size, keyframes, views, samples, decoder, precision those that are varied, separated by commas.",
        show_default=False,
    ),
]
Times = Annotated[
    str | None, typer.Option(help="Seconds of fitting, separated by commas. Default: 3,10,30,60,120,300,900.", show_default=False)
]
Seeds = Annotated[int, typer.Option(min=1, max=20, help="How often each fit is repeated, with other seeds.")]
SweepBudget = Annotated[
    float | None,
    typer.Option("--budget", min=1, help="Seconds for the whole sweep; what does not fit is left for the next call.", show_default=False),
]


@takes("preset image_size holdout device threads seed decoder poses config pairs quiet json")
def tradeoff(
    place: Place, axes: Axes = None, times: Times = None, seeds: Seeds = 1, budget: SweepBudget = None, *, options: Options
) -> None:
    """Make fields and surfaces with one setting changed at a time, measure each, and show quality against time and memory.

    Each point is kept as soon as it is measured: run the same command again after an interruption and it goes on.
    """
    settings = options.settings()
    bound_threads(settings)
    from fieldfuse.pipelines.console import make_progress

    data = tradeoff_run(place, settings, axes, times, seeds, budget, make_progress(options.quiet))
    show(data, options, lambda: lines(data, place.folder))


def tradeoff_run(
    place: Place,
    options: dict[str, Any],
    axes: str | None = None,
    times: str | None = None,
    seeds: int = 1,
    budget: float | None = None,
    progress: Any = None,
) -> dict[str, Any]:
    """Measure what is missing and write `tradeoff.csv`, `tradeoff.html` and the plots; answers `tradeoff.json`.

    Raises:
        InputError: no test views, an axis that cannot be varied, times that are no numbers.
        Interrupted: the user asked to stop; what was measured is written.
    """
    from fieldfuse.errors import InputError
    from fieldfuse.pipelines.console import make_progress
    from fieldfuse.pipelines.job import open_job
    from fieldfuse.pipelines.prepare import prepare
    from fieldfuse.pipelines.stages import BEFORE
    from fieldfuse.pipelines.surfaces import match_images
    from fieldfuse.pipelines.tradeoff_plan import chosen_axes, chosen_times, plan
    from fieldfuse.pipelines.tradeoff_sweep import Swept, sweep

    ladder = chosen_times(times)
    progress = make_progress(True) if progress is None else progress
    with open_job(place, options, progress, (*BEFORE, "stereo")) as job:
        can_vary, why_not = axes_here(job.settings)
        chosen = chosen_axes(axes, can_vary, why_not)
        ready = prepare(job)
        if not ready.views.test.any():
            raise InputError("what accuracy costs is measured on pictures kept for testing, and there is none; give --holdout 8")
        surface: str | None = "tsdf" if ready.posed.has_depth else "tsdf_stereo"
        refused = [f"The axis {name} was not varied: {why}." for name, why in why_not.items()]
        if surface == "tsdf_stereo":
            try:
                match_images(job, ready)
            except InputError as error:  # a camera that only moves forward leaves nothing to match; the field can still be measured
                surface = None
                refused.append(f"No surface was made: {error}.")
        stereo = job.stages.records["stereo"].seconds if "stereo" in job.stages.records else 0.0
        swept, wanted = Swept([], []), plan(chosen, ladder, seeds, surface)
        try:
            sweep(job, wanted, stereo, budget, swept)
        finally:
            done = {(row["id"], row["seed"]) for row in swept.rows}
            swept.left_out = [one.name for one in wanted if (one.id, one.seed) not in done]
            # What was measured is shown, however the sweep ends.
            data = put(job, swept, ready, refused)
    return data


def axes_here(settings: Any) -> tuple[list[str], dict[str, str]]:
    """The axes that can be varied, and for the others why not."""
    from fieldfuse.evaluation.tradeoff import AXES
    from fieldfuse.training.from_network import SHIPPED

    why_not = {}
    if not SHIPPED.is_file():
        why_not["keyframes"] = "only the networks have key frames, and their weights are not installed"
    if settings.field.decoder == "per_sample":
        why_not["precision"] = "a field with the decoder per sample is stored in one precision only"
        why_not["decoder"] = "it is set; leave out --decoder to compare both"
    return [axis for axis in AXES if axis not in why_not], why_not


def put(job: Any, swept: Any, ready: Any, refused: list[str]) -> dict[str, Any]:
    """Write what is known so far into the run's folder."""
    from fieldfuse.evaluation.tradeoff_page import write_tradeoff
    from fieldfuse.pipelines.comparison import machine
    from fieldfuse.pipelines.summary import base_data, warnings_of

    base, scene, views = base_data(job, ready.capture, ready.poses), ready.scene, ready.views
    data = {
        **base,
        "command": unbounded(base["command"]),
        "warnings": warnings_of(job, ready),
        "scene": scene.to_dict(),
        "unit": "m" if scene.metric else "units",
        "views": {
            "total": len(views),
            "test": int(views.test.sum()),
            "width": views.intrinsics[0].width,
            "height": views.intrinsics[0].height,
        },
        "rows": swept.rows,
        "left_out": swept.left_out,
        "refused": refused,
        "machine": machine(job),
    }
    return write_tradeoff(job.folder.path, data)


def unbounded(command: str) -> str:
    """The command without `--budget`, which bounds one call of several: this one makes every row at once."""
    parts = shlex.split(command)
    named = [index for index, part in enumerate(parts) if part == "--budget"]
    drop = {*named, *(index + 1 for index in named), *(index for index, part in enumerate(parts) if part.startswith("--budget="))}
    return shlex.join(part for index, part in enumerate(parts) if index not in drop)


def lines(data: dict[str, Any], folder: Path) -> Iterator[str]:
    """Sentences on what was measured, remarks, and where the page is."""
    from fieldfuse.evaluation.tradeoff import points_of
    from fieldfuse.evaluation.tradeoff_text import front_sentence, sentence, steps

    points, unit = points_of(data["rows"]), data["unit"] or "units"
    yield from (sentence(step, unit) for step in steps(points))
    yield from (text for cost in ("seconds", "memory_mb") if (text := front_sentence(points, cost, "psnr", unit)) is not None)
    yield from (f"note: {row['id']}: {row['error']}" for row in data["rows"] if row["error"] is not None)
    yield from (f"note: not measured yet: {name}" for name in data["left_out"])
    yield from (f"note: {warning}" for warning in data["warnings"])
    yield str(folder / "tradeoff.html")
