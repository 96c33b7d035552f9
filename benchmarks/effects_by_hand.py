"""`python -m benchmarks.effects_by_hand FOLDER CAPTURE …`: fits of real captures with each effect switched on by hand.

They show whether what was found pays, and what was not found would not.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from benchmarks.effects_fits import FIXED, fit_with
from benchmarks.experiment import Experiment, Row, application, chosen, markdown, program, section, show
from fieldfuse.capture import open_capture
from fieldfuse.capture.prepare import held_out
from fieldfuse.config import Settings, load_settings
from fieldfuse.effects.diagnostics import Diagnostics, diagnose
from fieldfuse.errors import InputError
from fieldfuse.pipelines.console import make_progress
from fieldfuse.pipelines.options import Quiet
from fieldfuse.progress import SILENT, Progress

ALONE = ("exposure", "vignetting", "distortion", "poses", "motion_blur")
SWITCHES: dict[str, list[str]] = {
    "all_off": ["effects=off"],
    "auto": ["effects=auto"],
    **{name: ["effects=off", f"effects.on=[{name}]"] for name in ALONE},
    "no_view": ["effects=off", "field.view=none"],
    "background": ["effects=off", "field.background=on"],
    "no_background": ["effects=off", "field.background=off"],
}


def by_hand(
    folder: Annotated[Path, typer.Argument(help="For the results; what is there is used again.", show_default=False)],
    captures: Annotated[list[Path], typer.Argument(help="Captures with poses.", show_default=False)],
    seconds: Annotated[float, typer.Option(min=0.5, help="Processor seconds of each fit.")] = 10.0,
    image_size: Annotated[int, typer.Option(min=32, help="Long side of the images.")] = 240,
    seeds: Annotated[int, typer.Option(min=1, help="Fits of each, whose mean is shown.")] = 1,
    switches: Annotated[str | None, typer.Option(help="Comma-separated part of the switches; default: all.", show_default=False)] = None,
    quiet: Quiet = False,
) -> None:
    """Fit captures with all effects off, with what is found, and with each effect switched on by hand."""
    named = {(path.parent if path.is_file() else path).name: path for path in captures}
    if len(named) < len(captures):
        raise InputError("two captures have the same name, which the table shows them by; give them in folders of different names")
    modes, progress = chosen(switches, SWITCHES, "--switches"), make_progress(quiet)
    experiment = switched(named, seconds, image_size, seeds, modes, progress)
    show(section(experiment.conduct(folder, progress, 1), table), quiet)


def switched(
    captures: dict[str, Path], seconds: float, long_side: int, seeds: int, modes: list[str], progress: Progress = SILENT
) -> Experiment:
    """A row for each capture (by the name that the table shows), seed and mode (of `SWITCHES`), with what `fit_with` answers."""

    @lru_cache(1)  # the same for every effect that is switched on alone
    def found(name: str) -> Diagnostics:
        capture = open_capture(captures[name])
        train = np.flatnonzero(~held_out(capture, Settings().capture.holdout))
        return diagnose(capture, [int(index) for index in train], progress, quick=False)

    def run(entry: Row) -> Row:
        mode, fixed = entry["mode"], [f"budget={seconds}", f"image_size={long_side}", f"seed={entry['seed']}", *FIXED]
        settings = load_settings(pairs=[*SWITCHES[mode], *fixed])
        capture = open_capture(captures[entry["capture"]])
        return fit_with(capture, settings, progress, found=found(entry["capture"]) if mode in ALONE else None)

    entries = [{"capture": name, "mode": mode, "seed": seed} for name in captures for seed in range(seeds) for mode in modes]
    about = {"budget": seconds, "long_side": long_side}
    file = f"by_hand-{long_side}-{seconds:g}s"
    return Experiment("effects_by_hand", entries, run, table, f"{seconds:g} s, {long_side} pixels", about, file)


def table(data: Row) -> str:
    """Markdown: a row a switch, a column a capture; the mean PSNR in the photos' colours / with the left half's correction of colour."""
    rows = data["rows"]
    names, modes = (list(dict.fromkeys(row[key] for row in rows)) for key in ("capture", "mode"))

    def cell(name: str, mode: str) -> str:
        fits = [row for row in rows if (row["capture"], row["mode"]) == (name, mode)]
        means = [float(np.mean([row[key] for row in fits])) for key in ("psnr", "psnr_corrected") if fits]
        return " / ".join(f"{mean:.2f}" for mean in means)

    return markdown(["switched", *names], ([mode.replace("_", " "), *(cell(name, mode) for name in names)] for mode in modes))


app = application(by_hand)
if __name__ == "__main__":
    program(app)
