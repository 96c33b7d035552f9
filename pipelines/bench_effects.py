"""`fieldfuse bench effects`: how well effects are told from pictures of sixty simulated captures that are known, and what that is worth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from fieldfuse.pipelines.options import Quiet

WHAT = ("effect", "weak", "medium", "strong", "captures without it")


def effects(
    folder: Annotated[Path, typer.Argument(help="Where the captures are filmed to; what is there is used again.", show_default=False)],
    to: Annotated[Path | None, typer.Option("--json", help="Write everything to this JSON file.", show_default=False)] = None,
    first_seed: Annotated[int | None, typer.Option(min=0, help="Seed of the first capture; others give other captures.")] = None,
    against_all_on: Annotated[
        bool, typer.Option("--against-all-on", help="Fit captures with what was found, and with all effects on.")
    ] = False,
    against_all_off: Annotated[
        bool, typer.Option("--against-all-off", help="Fit captures with what was found, and with all effects off.")
    ] = False,
    drifting: Annotated[
        bool,
        typer.Option(
            "--drifting", help="Film ten with drift and vignetting; fit with what was found, with all off, and with what is true."
        ),
    ] = False,
    every: Annotated[int, typer.Option(min=1, help="Of so many captures one is fitted; 1: all.")] = 1,
    seconds: Annotated[float, typer.Option(min=0.5, help="Processor seconds of each fit.")] = 3.0,
    quiet: Quiet = False,
) -> None:
    """Film sixty small captures with known effects, look for effects in each, and count what was found."""
    import time

    from fieldfuse.evaluation.effects_bench import confusion, look_at
    from fieldfuse.evaluation.effects_plan import FIRST_DRIFTING, FIRST_SEED, plan
    from fieldfuse.evaluation.effects_plan import drifting as plan_drifting
    from fieldfuse.files import write_json
    from fieldfuse.pipelines.console import make_progress

    folder.mkdir(parents=True, exist_ok=True)
    progress = make_progress(quiet)
    began = time.monotonic()
    planned = (plan_drifting if drifting else plan)(first_seed if first_seed is not None else FIRST_DRIFTING if drifting else FIRST_SEED)
    against = [mode for mode, wanted in (("all_off", against_all_off), ("all_on", against_all_on)) if wanted]
    if drifting:
        against = ["all_off", "known"]
    data: dict[str, Any]
    with progress.listening():
        progress.begin("effects")
        if against:
            from fieldfuse.evaluation.effects_fits import compared

            data = compared(planned[::every], folder, seconds, against, progress)
        else:
            looked = look_at(planned, folder, progress)
            data = {**confusion(looked), "each": [one.to_dict() for one in looked]}
    progress.finish("effects", time.monotonic() - began, False)
    if to is not None:
        write_json(to, data)
    if not quiet:
        for line in fits_table(data) if against else table(data):
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
    """Each capture's scores in each mode as lines of Markdown, and their means."""
    modes = data["modes"]
    told = (("canonical", "dB"), ("canonical_corrected", "dB, corrected"), ("psnr", "dB, photos' colours"), ("seconds", "s"))
    head = ["capture", "found", *(f"{mode.replace('_', ' ')}, {unit}" for _, unit in told for mode in modes)]
    out = [f"| {' | '.join(head)} |", "|" + " --- |" * len(head)]
    for one in [*data["each"], {"name": "mean", "found": [], **data["mean"]}]:
        cells = [f"{one[mode][key]:.2f}" for key, _ in told for mode in modes]
        out.append(f"| {one['name']} | {', '.join(one['found'])} | {' | '.join(cells)} |")
    return out


def by_hand(
    folder: Annotated[Path, typer.Argument(help="Where what each fit gave is kept; what is there is used again.", show_default=False)],
    captures: Annotated[list[Path], typer.Argument(help="Captures with poses.", show_default=False)],
    to: Annotated[Path | None, typer.Option("--json", help="Write everything to this JSON file.", show_default=False)] = None,
    seconds: Annotated[float, typer.Option(min=0.5, help="Processor seconds of each fit.")] = 10.0,
    image_size: Annotated[int, typer.Option(min=32, help="Long side of the pictures.")] = 240,
    seeds: Annotated[int, typer.Option(min=1, help="Fits of each, of which the mean is told.")] = 1,
    switches: Annotated[
        str | None, typer.Option(help="Comma-separated part of what can be switched; all when left out.", show_default=False)
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Fit captures with all effects off, with what is found, and with each effect switched on by hand."""
    import time

    from fieldfuse.errors import InputError
    from fieldfuse.evaluation.effects_switch import SWITCHES, switched
    from fieldfuse.files import write_json
    from fieldfuse.pipelines.console import make_progress

    progress = make_progress(quiet)
    began = time.monotonic()
    named = {(path.parent if path.is_file() else path).name: path for path in captures}
    if len(named) < len(captures):
        raise InputError("two captures have the same name, which the table shows them by; give them in folders of different names")
    modes = tuple(SWITCHES) if switches is None else tuple(name.strip() for name in switches.split(","))
    with progress.listening():
        progress.begin("effects")
        data = switched(named, folder, seconds, image_size, seeds, modes, progress)
    progress.finish("effects", time.monotonic() - began, False)
    if to is not None:
        write_json(to, data)
    if not quiet:
        for line in switched_table(data):
            typer.echo(line)


def switched_table(data: dict[str, Any]) -> list[str]:
    """One row a switch, one column a capture: PSNR in the photos' colours / with the left half's correction of colour."""
    names = list(data["mean"])
    out = [f"| switched | {' | '.join(names)} |", "|" + " --- |" * (1 + len(names))]
    for mode in next(iter(data["mean"].values()), {}):
        means = [data["mean"][name][mode] for name in names]
        cells = [f"{one['psnr']:.2f} / {one['psnr_corrected']:.2f}" for one in means]
        out.append(f"| {mode.replace('_', ' ')} | {' | '.join(cells)} |")
    return out
