"""`fieldfuse bench effects`: how well effects are told from pictures, on sixty simulated captures that are known."""

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
    with progress.listening():
        progress.begin("effects")
        looked = look_at(plan(FIRST_SEED if first_seed is None else first_seed), folder, progress)
    progress.finish("effects", time.monotonic() - began, False)
    data = {**confusion(looked), "each": [one.to_dict() for one in looked]}
    if to is not None:
        write_json(to, data)
    if not quiet:
        for line in table(data):
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
