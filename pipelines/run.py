"""`fieldfuse run SOURCE --out DIR`: the main job, from a capture to a field, a surface, exports and a report."""

from __future__ import annotations

from typing import Annotated

import typer

from fieldfuse.errors import InputError
from fieldfuse.pipelines.options import (
    Budget,
    Config,
    Decoder,
    Device,
    Engine,
    Finetune,
    Holdout,
    ImageSize,
    Init,
    Json,
    Out,
    Pairs,
    PosesFrom,
    Preset,
    Quiet,
    Seed,
    Source,
    Threads,
    gather,
)

MOST_SECONDS = 1e7  # a third of a year

TotalBudget = Annotated[
    float | None,
    typer.Option(
        min=10,
        help="Seconds for the whole run: picture size, voxels, a video's frames, fitting time and exports are chosen for it.",
        show_default=False,
    ),
]


def run(
    source: Source,
    out: Out,
    preset: Preset = None,
    budget: Budget = None,
    total_budget: TotalBudget = None,
    image_size: ImageSize = None,
    holdout: Holdout = None,
    device: Device = None,
    threads: Threads = None,
    seed: Seed = None,
    engine: Engine = None,
    decoder: Decoder = None,
    init: Init = None,
    finetune: Finetune = None,
    poses: PosesFrom = None,
    config: Config = None,
    pairs: Pairs = None,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Turn a capture into a radiance field (and a TSDF surface, if it has depth), exports and a report.

    Run the same command again after an interruption: what is finished is reused.
    """
    from fieldfuse.pipelines.work import work

    options_given = {"--preset": preset, "--budget": budget, "--image-size": image_size}
    for name, value in options_given.items():
        if total_budget is not None and value is not None:
            raise InputError(f"--total-budget chooses what {name} would set; give one of them")
    if total_budget is not None and not total_budget < MOST_SECONDS:  # not a number neither
        raise InputError(f"--total-budget is {total_budget:g}; it must be a number of seconds, at most 10 million")
    flags = {"budget": budget, "image_size": image_size, "holdout": holdout, "device": device, "threads": threads, "seed": seed}
    flags |= {"engine": engine, "decoder": decoder, "poses.source": poses, "init": init, "finetune": finetune}
    options = {**gather(preset, config, pairs, **flags), "total_budget": total_budget}
    work(source, out, options, ("tsdf", "field", "render", "export"), quiet=quiet, as_json=json)
