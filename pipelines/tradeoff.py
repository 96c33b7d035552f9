"""`fieldfuse tradeoff SOURCE --out DIR`: what accuracy costs in time and memory on one capture, beside TSDF fusion."""

from __future__ import annotations

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
    from fieldfuse.pipelines.tradeoff_sweep import Choice, tradeoff_run

    data = tradeoff_run(place, settings, Choice(axes, times, seeds, budget), make_progress(options.quiet))
    show(data, options, lambda: lines(data, place.folder))


def lines(data: dict[str, Any], folder: Path) -> Iterator[str]:
    """Sentences on what was measured, remarks, and where the page is."""
    from fieldfuse.evaluation.tradeoff import COSTS, front_sentence, points_of, sentence, steps

    points, unit = points_of(data["rows"]), data["unit"] or "units"
    yield from (sentence(step, unit) for step in steps(points))
    yield from (text for cost in COSTS if (text := front_sentence(points, cost, unit)) is not None)
    yield from (f"note: {row['id']}: {row['error']}" for row in data["rows"] if row["error"] is not None)
    yield from (f"note: not measured yet: {name}" for name in data["left_out"])
    yield from (f"note: {warning}" for warning in data["warnings"])
    yield str(folder / "tradeoff.html")
