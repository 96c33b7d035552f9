"""`fieldfuse bench effects`: how well effects are told from pictures of sixty simulated captures that are known, and what that is worth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from pipelines.options import Quiet

WHAT = ("effect", "weak", "medium", "strong", "captures without it")


def effects(
    folder: Annotated[Path, typer.Argument(help="Where the captures are filmed to; what is there is used again.", show_default=False)],
    to: Annotated[Path | None, typer.Option("--json", help="Write everything to this JSON file.", show_default=False)] = None,
    first_seed: Annotated[int | None, typer.Option(min=0, help="Seed of the first capture; others give other captures.")] = None,
    against_all_on: Annotated[
        bool, typer.Option("--against-all-on", help="Fit captures with what was found, and with all effects on.")
    ] = False,
    every: Annotated[int, typer.Option(min=1, help="Of the captures, every so manieth is fitted.")] = 2,
    seconds: Annotated[float, typer.Option(min=0.5, help="Processor seconds of each fit.")] = 3.0,
    quiet: Quiet = False,
) -> None:
    """Film sixty small captures with known effects, look for effects in each, and count what was found."""
    import time

    from pipelines.console import make_progress
    from toolkit.evaluate.effects_bench import confusion, look_at
    from toolkit.evaluate.effects_plan import FIRST_SEED, plan
    from toolkit.files import write_json

    folder.mkdir(parents=True, exist_ok=True)
    progress = make_progress(quiet)
    began = time.monotonic()
    planned = plan(FIRST_SEED if first_seed is None else first_seed)
    data: dict[str, Any]
    with progress.listening():
        progress.begin("effects")
        if against_all_on:
            from toolkit.evaluate.effects_fits import compared

            data = compared(planned[::every], folder, seconds, progress)
        else:
            looked = look_at(planned, folder, progress)
            data = {**confusion(looked), "each": [one.to_dict() for one in looked]}
    progress.finish("effects", time.monotonic() - began, False)
    if to is not None:
        write_json(to, data)
    if not quiet:
        for line in fits_table(data) if against_all_on else table(data):
            typer.echo(line)


def table(data: dict[str, Any]) -> list[str]:
    """The counts as lines of Markdown."""
    out = [f"| {' | '.join(WHAT)} |", "|" + " --- |" * len(WHAT)]
    for effect, row in data["effects"].items():
        cells = [f"{row[key]['found']} of {row[key]['captures']}" for key in ("weak", "medium", "strong", "none")]
        out.append(f"| {effect} | {' | '.join(cells)} |")
    shares = [f"{name} {100 * data[name]:.1f}%" for name in ("precision", "recall") if data[name] is not None]
    out.append("")
    out.append(
        f"{', '.join(shares)} over medium and strong; {data['clean_without_alarm']} of {data['clean']} clean captures without any alarm"
    )
    return out


def fits_table(data: dict[str, Any]) -> list[str]:
    """Each capture's scores with what was found and with all on, as lines of Markdown, and their means."""
    head = ("capture", "found", "auto, dB", "all on, dB", "auto, corrected", "all on, corrected", "auto, seconds", "all on, seconds")
    out = [f"| {' | '.join(head)} |", "|" + " --- |" * len(head)]
    for one in [*data["each"], {"name": "mean", "found": [], **data["mean"]}]:
        cells = [f"{one[mode][key]:.2f}" for key in ("psnr", "psnr_corrected", "seconds") for mode in ("auto", "all_on")]
        out.append(f"| {one['name']} | {', '.join(one['found'])} | {' | '.join(cells)} |")
    return out
