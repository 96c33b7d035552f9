"""`fieldfuse tradeoff SOURCE --out DIR`: what accuracy costs in time and memory on one capture, beside TSDF fusion."""

from __future__ import annotations

import json as writer
import sys
from typing import Annotated

import typer

from fieldfuse.pipelines.options import (
    Config,
    Decoder,
    Device,
    Holdout,
    ImageSize,
    Json,
    OptionalOut,
    Pairs,
    PosesFrom,
    Preset,
    Quiet,
    Seed,
    Target,
    Threads,
    gather,
)

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


def tradeoff(
    target: Target,
    out: OptionalOut = None,
    axes: Axes = None,
    times: Times = None,
    seeds: Seeds = 1,
    budget: SweepBudget = None,
    preset: Preset = None,
    image_size: ImageSize = None,
    holdout: Holdout = None,
    device: Device = None,
    threads: Threads = None,
    seed: Seed = None,
    decoder: Decoder = None,
    poses: PosesFrom = None,
    config: Config = None,
    pairs: Pairs = None,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Make fields and surfaces with one setting changed at a time, measure each, and show quality against time and memory.

    Each point is kept as soon as it is measured: run the same command again after an interruption and it goes on.
    """
    from fieldfuse.pipelines.thread_limits import bound_threads

    flags = {"image_size": image_size, "holdout": holdout, "device": device, "threads": threads, "seed": seed, "decoder": decoder}
    options = gather(preset, config, pairs, **flags, **{"poses.source": poses})
    bound_threads(options)
    from fieldfuse.evaluation.tradeoff import COSTS, front_sentence, points_of, sentence, steps
    from fieldfuse.pipelines.console import make_progress
    from fieldfuse.pipelines.tradeoff_sweep import Choice, tradeoff_run

    data = tradeoff_run(target, out, options, Choice(axes, times, seeds, budget), make_progress(quiet))
    if json:
        sys.stdout.write(writer.dumps(data, indent=1) + "\n")
    elif not quiet:
        points, unit = points_of(data["rows"]), data["unit"] or "units"
        lines = [sentence(step, unit) for step in steps(points)]
        lines += [text for cost in COSTS if (text := front_sentence(points, cost, unit)) is not None]
        lines += [f"note: {row['id']}: {row['error']}" for row in data["rows"] if row["error"] is not None]
        lines += [f"note: not measured yet: {name}" for name in data["left_out"]]
        lines += [f"note: {warning}" for warning in data["warnings"]]
        lines.append(str((out or target) / "tradeoff.html"))
        sys.stdout.write("".join(f"{line}\n" for line in lines))
