"""`python -m benchmarks.effects FOLDER`: how well effects are found in simulated captures that are known, and what that is worth.

Captures are filmed into FOLDER, where they stay. Each is looked at; with --against-all-on, --against-all-off or --drifting, each is fitted
in several modes instead, for some seconds of the processor.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from benchmarks.effects_fits import FIXED, fit_with
from benchmarks.experiment import Experiment, Row, application, markdown, program, section, show
from benchmarks.simulated import (
    EFFECTS,
    FIRST_DRIFTING,
    FIRST_SEED,
    STRENGTHS,
    Planned,
    canonical_capture,
    film,
    known_light,
    plan,
    plan_drifting,
)
from fieldfuse.capture import open_capture
from fieldfuse.capture.prepare import held_out
from fieldfuse.config import Settings, load_settings
from fieldfuse.effects.diagnostics import VIEWS, diagnose
from fieldfuse.pipelines.console import make_progress
from fieldfuse.pipelines.options import Quiet
from fieldfuse.progress import SILENT, Progress

FOUND_AS = {VIEWS: "highlights"}  # the simulator's name of what detection calls by its appearance
AUTO = "auto"
MODES = {
    AUTO: ["effects=auto"],
    "all_off": ["effects=off"],
    "all_on": ["effects.on=[exposure,vignetting,distortion,poses,motion_blur,view_dependence,background]"],
    "known": ["effects=off"],  # exposure and vignetting as they were simulated
}
SHOWN = {"canonical": "dB", "canonical_corrected": "dB, corrected", "psnr": "dB, photos' colours", "seconds": "s"}


def effects(
    folder: Annotated[Path, typer.Argument(help="For the captures and the results; what is there is used again.", show_default=False)],
    first_seed: Annotated[int | None, typer.Option(min=0, help="Seed of the first capture; others give other captures.")] = None,
    against_all_on: Annotated[
        bool, typer.Option("--against-all-on", help="Fit captures with what was found, and with all effects on.")
    ] = False,
    against_all_off: Annotated[
        bool, typer.Option("--against-all-off", help="Fit captures with what was found, and with all effects off.")
    ] = False,
    drifting: Annotated[
        bool,
        typer.Option("--drifting", help="Film ten with drift and vignetting; fit with what was found, with all off, with what is true."),
    ] = False,
    every: Annotated[int, typer.Option(min=1, help="Every n-th capture is fitted; 1: all.")] = 1,
    seconds: Annotated[float, typer.Option(min=0.5, help="Processor seconds of each fit.")] = 3.0,
    quiet: Quiet = False,
) -> None:
    """Film sixty small captures with known effects, look for effects in each, and count what was found."""
    against = [mode for mode, wanted in (("all_off", against_all_off), ("all_on", against_all_on)) if wanted]
    against = ["all_off", "known"] if drifting else against
    seed = first_seed if first_seed is not None else FIRST_DRIFTING if drifting else FIRST_SEED
    planned = (plan_drifting if drifting else plan)(seed)
    folder.mkdir(parents=True, exist_ok=True)
    progress = make_progress(quiet)
    found = fits(planned[::every], folder, seconds, against, progress) if against else detection(planned, folder)
    show(section(found.conduct(folder, progress, 1), table), quiet)


def detection(planned: list[Planned], folder: Path) -> Experiment:
    """A row a capture: its true effects, those that were found with all of its frames, and their numbers."""
    named = {one.name: one for one in planned}

    def run(entry: Row) -> Row:
        one = named[entry["capture"]]
        found = diagnose(open_capture(film(one, folder)))
        names = {name: FOUND_AS.get(name, name) for name in found.findings}
        numbers = {names[name]: round(finding.number, 4) for name, finding in found.findings.items()}
        there = sorted(names[name] for name in found.there)
        return {"scene": one.scene, "true": dict(one.effects), "found": there, "numbers": numbers, "seconds": round(found.seconds, 2)}

    return Experiment("effects", [{"capture": name} for name in named], run, table)


def fits(planned: list[Planned], folder: Path, seconds: float, against: list[str], progress: Progress = SILENT) -> Experiment:
    """A row for each capture with what was found (`auto`) and with each mode of `against`; rows hold what `fit_with` answers."""
    named = {one.name: one for one in planned}

    def run(entry: Row) -> Row:
        place = film(named[entry["capture"]], folder)
        capture = open_capture(place)
        test = held_out(capture, Settings().capture.holdout)
        settings = load_settings(pairs=[*MODES[entry["mode"]], f"budget={seconds}", *FIXED])
        known = known_light(place, capture, test) if entry["mode"] == "known" else None
        return fit_with(capture, settings, progress, canonical_capture(place, capture, test), known)

    entries = [{"capture": name, "mode": mode} for name in named for mode in (AUTO, *against)]
    return Experiment("effects", entries, run, table, f"{seconds:g} s", {"fitted": True, "budget": seconds}, f"fits-{seconds:g}s")


def confusion(rows: list[Row]) -> Row:
    """For each effect: how many captures have it in each strength and in how many of these it was found, and in how many it was found
    although they do not have it; precision and recall over medium and strong. (What is weak is counted, and is neither right nor wrong.)"""
    counted: dict[str, Row] = {}
    for effect in EFFECTS:
        counts: Row = {}
        for strength in (*STRENGTHS, None):
            having = [row for row in rows if row["true"].get(effect) == strength]
            counts[strength or "none"] = {"captures": len(having), "found": sum(effect in row["found"] for row in having)}
        counted[effect] = counts
    right = sum(counts[strength]["found"] for counts in counted.values() for strength in ("medium", "strong"))
    there = sum(counts[strength]["captures"] for counts in counted.values() for strength in ("medium", "strong"))
    wrong = sum(counts["none"]["found"] for counts in counted.values())
    return {
        "effects": counted,
        "precision": right / (right + wrong) if right + wrong else None,
        "recall": right / there if there else None,
        "clean_without_alarm": sum(not row["found"] for row in rows if not row["true"]),
        "clean": sum(not row["true"] for row in rows),
    }


def table(data: Row) -> str:
    """Markdown: what was found of each effect; or the scores of each capture's fits."""
    if data.get("fitted"):
        return fits_table(data["rows"])
    counted = confusion(data["rows"])
    keys = (*STRENGTHS, "none")
    lines = [[effect, *(f"{row[key]['found']} of {row[key]['captures']}" for key in keys)] for effect, row in counted["effects"].items()]
    shares = [f"{name} {100 * counted[name]:.1f}%" for name in ("precision", "recall") if counted[name] is not None]
    shares = [", ".join(shares) + " over medium and strong"] if shares else []
    clean = f"{counted['clean_without_alarm']} of {counted['clean']} clean captures without any alarm"
    return markdown(["effect", *STRENGTHS, "captures without it"], lines) + "\n" + "; ".join([*shares, clean]) + "\n"


def fits_table(rows: list[Row]) -> str:
    """Markdown: a row for each capture that was fitted in every mode, and the means."""
    modes = list(dict.fromkeys(row["mode"] for row in rows))
    captures: dict[str, dict[str, Row]] = {}
    for row in rows:
        captures.setdefault(row["capture"], {})[row["mode"]] = row
    whole = {name: fits for name, fits in captures.items() if len(fits) == len(modes)}
    head = ["capture", "found", *(f"{mode.replace('_', ' ')}, {unit}" for unit in SHOWN.values() for mode in modes)]
    lines = [
        [name, ", ".join(fits[AUTO]["on"]), *(f"{fits[mode][key]:.2f}" for key in SHOWN for mode in modes)] for name, fits in whole.items()
    ]
    if whole:
        means = [float(np.mean([fits[mode][key] for fits in whole.values()])) for key in SHOWN for mode in modes]
        lines.append(["mean", "", *(f"{mean:.2f}" for mean in means)])
    return markdown(head, lines)


app = application(effects)
if __name__ == "__main__":
    program(app)
