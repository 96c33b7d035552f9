"""`fieldfuse bench engines SOURCE`: what the engines of this machine reach on a capture within seconds."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from fieldfuse.pipelines.few_views import ground_of, keep_rows, numbers, opened, tell
from fieldfuse.pipelines.options import Config, Device, ImageSize, Out, Pairs, Quiet, Seed, Source, Threads, gather

FILE = "engines"


def engines(
    source: Source,
    out: Out,
    budgets: Annotated[str, typer.Option(help="Seconds of fitting, by comma.")] = "5,30",
    engines: Annotated[str, typer.Option(help="Engines, by comma: auto, numba, triton, torch.")] = "auto",
    device: Device = None,
    image_size: ImageSize = None,
    threads: Threads = None,
    seed: Seed = None,
    config: Config = None,
    pairs: Pairs = None,
    quiet: Quiet = False,
) -> None:
    """Held-out quality of fits by each engine, and the time of a picture of 640×480 pixels."""
    from fieldfuse.evaluation.engines import engine_rows, engine_table
    from fieldfuse.steps import check_engine

    seconds, names = numbers(budgets, "budgets"), named(engines)
    options = gather(None, config, pairs, image_size=image_size, seed=seed, threads=threads, device=device)
    rows: list[dict[str, Any]] = []
    with opened(source, out, options, quiet) as (job, posed, corrections):
        for name in names:
            check_engine(name, job.settings.device)
        ground = ground_of(job, posed, None, corrections)
        job.progress.begin("fits")
        for row in engine_rows(ground, names, seconds, job.progress):
            rows.append(row)
            keep_rows(job, FILE, rows, engine_table(rows))
            job.progress.say(f"{row['engine']}, {row['budget']:g} s: {row['psnr']:.2f} dB; a picture takes {row['picture_ms']:.1f} ms")
    tell(engine_table(rows), quiet)


def named(text: str) -> list[str]:
    """`auto,torch` → its parts.

    Raises:
        InputError: something is no engine.
    """
    from fieldfuse.config import ENGINES
    from fieldfuse.errors import InputError

    parts = [part.strip() for part in text.split(",") if part.strip()]
    for part in parts or [""]:
        if part not in ENGINES:
            raise InputError(f"--engines {text!r}: there is no {part!r}; known are {', '.join(ENGINES)}")
    return parts
