"""`python -m benchmarks.few_views SOURCE --out DIR`: held-out quality of 3, 6, 12 … training views.

Measured are the nearest training image, the networks alone ("direct"), and fits from the networks' start and from the classical one.
Held-out views are the same for every number of training views. Seconds are of one thread's processor time, so that other work on the
machine does not blur the comparison; the networks' seconds stand beside, they are not part of a fit's budget.
"""

from __future__ import annotations

import time
from dataclasses import replace
from functools import lru_cache
from typing import Annotated

import numpy as np
import typer

from benchmarks.experiment import Experiment, Row, application, chosen, markdown, numbers, program, section, show
from benchmarks.ground import Ground, Inferred, Opened, measured, opened
from fieldfuse.errors import InputError
from fieldfuse.evaluation.score import nearest_image_scores
from fieldfuse.nerfusion.model import NerfusionModel
from fieldfuse.pipelines.options import Config, ImageSize, Out, Pairs, Quiet, Seed, Source, gather
from fieldfuse.render.field import Field
from fieldfuse.training.fit import Begin
from fieldfuse.training.from_network import load_networks
from fieldfuse.training.guided import fit_guided
from fieldfuse.training.network_start import network_start

ALL = "all"
NEAREST, DIRECT, NETWORK, CLASSICAL = "nearest", "direct", "network", "classical"
STARTS = (DIRECT, NETWORK, CLASSICAL)


def few_views(
    source: Source,
    out: Out,
    views: Annotated[str, typer.Option(help="Numbers of training views, separated by commas; 'all' is one.")] = "3,6,12,all",
    budgets: Annotated[str, typer.Option(help="Seconds of fitting (processor time of one thread), separated by commas.")] = "30,120",
    starts: Annotated[str, typer.Option(help="What is measured, separated by commas.")] = ",".join(STARTS),
    image_size: ImageSize = None,
    seed: Seed = None,
    config: Config = None,
    pairs: Pairs = None,
    quiet: Quiet = False,
) -> None:
    """Held-out quality of 3, 6, 12 … training views: networks alone, and fits from their start and from the classical one."""
    seconds, counts, kinds = numbers(budgets, "--budgets"), counts_of(views), chosen(starts, STARTS, "--starts")
    with opened(source, out, gather(None, config, pairs, image_size=image_size, seed=seed, threads=1), quiet) as ready:
        model = load_networks(ready.job.settings.network.weights, ready.job.settings.device)
        bench = Bench(ready, model)
        plan = [
            {"views": views, "start": start, "budget": budget}
            for views in map(bench.add, counts)
            for start, budget in [(NEAREST, 0.0), *entries(kinds, seconds)]
        ]
        experiment = Experiment("few_views", plan, bench.row, table, ready.state(), ready.about())
        data = experiment.conduct(out, ready.job.progress, 1, ready.job.settings.device)
    show(section(data, table), quiet)


def counts_of(text: str) -> list[int | None]:
    """`3,6,all` → 3, 6, None.

    Raises:
        InputError: something is neither a positive whole number nor `all`.
    """
    parts = [part.strip() for part in text.split(",") if part.strip()]
    for part in parts:
        if part != ALL and not (part.isdigit() and int(part) > 0):
            raise InputError(f"--views {text!r}: {part!r} is neither a positive number nor 'all'")
    return [None if part == ALL else int(part) for part in parts]


def entries(kinds: list[str], seconds: list[float]) -> list[tuple[str, float]]:
    """What is measured of a number of views, and the budget of each fit."""
    return [(kind, 0.0) for kind in kinds if kind == DIRECT] + [(kind, budget) for budget in seconds for kind in kinds if kind != DIRECT]


class Bench:
    """Measures a row; what rows of the same number of views share is made once."""

    def __init__(self, ready: Opened, model: NerfusionModel) -> None:
        self.ready, self.model = ready, model
        self.grounds: dict[int, Ground] = {}  # by their number of training views
        self.inferred = lru_cache(1)(self._inferred)

    def add(self, count: int | None) -> int:
        """Prepare `count` of the training views (None: all), and answer how many there are."""
        ground = self.ready.ground(count)
        self.grounds.setdefault(ground.training, ground)
        return ground.training

    def _inferred(self, views: int) -> tuple[Inferred, Field]:
        """Direct inference, and its field without the second colours."""
        ground = self.grounds[views]
        inferred = Inferred.of(self.model, ground, ground.settings.network, self.ready.job.progress)
        return inferred, inferred.inference.field()

    def row(self, entry: Row) -> Row:
        """Scores of an entry of the plan."""
        ground, start, progress = self.grounds[entry["views"]], entry["start"], self.ready.job.progress
        if start == NEAREST:
            return {"psnr": nearest_image_scores(ground.views, np.flatnonzero(ground.views.test))["psnr"]}
        if start == DIRECT:
            return self.inferred(entry["views"])[0].measured(ground, progress)
        return self.fitted(ground, entry)

    def fitted(self, ground: Ground, entry: Row) -> Row:
        """Scores of a fit from either start."""
        progress, settings = self.ready.job.progress, ground.settings
        settings = replace(settings, fit=replace(settings.fit, budget=entry["budget"]))
        made = self.inferred(entry["views"])[1] if entry["start"] == NETWORK else None
        first = None if made is None else network_start(made, ground.views, ground.scene, settings)
        fit = fit_guided(ground.views, ground.scene, settings, progress, Begin(start=first, coarse=first is not None), time.process_time)
        return {**measured(fit.field, ground), "steps": fit.steps, "resolution": fit.field.resolution}


def table(data: Row) -> str:
    """Markdown: a line for each number of views."""
    found = {(row["views"], row["start"], row["budget"]): row for row in data["rows"]}
    budgets = sorted({budget for _, start, budget in found if start in (NETWORK, CLASSICAL)})
    fits = [(start, budget) for budget in budgets for start in (CLASSICAL, NETWORK)]
    head = ["training views", "nearest image", "networks alone", "their seconds"]
    head += [f"{start} start, {budget:g} s" for start, budget in fits]
    lines = []
    for count in sorted({count for count, _, _ in found}):
        cells = [_decibel(found.get((count, start, budget))) for start, budget in [(NEAREST, 0), (DIRECT, 0), *fits]]
        seconds = found.get((count, DIRECT, 0), {}).get("seconds")
        lines.append([count, *cells[:2], "" if seconds is None else f"{seconds:.0f}", *cells[2:]])
    return markdown(head, lines)


def _decibel(row: Row | None) -> str:
    return f"{row['psnr']:.2f}" if row and row.get("psnr") is not None else ""


app = application(few_views)
if __name__ == "__main__":
    program(app)
