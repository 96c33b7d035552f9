"""`python -m benchmarks.ablations SOURCE --out DIR`: direct inference with parts of the trained networks switched off, one at a time.

Nothing is trained again without them. Seconds are of one thread's processor time.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Annotated, Any

import torch
import typer

from benchmarks.experiment import Experiment, Row, application, markdown, program, section, show
from benchmarks.few_views import ALL, counts_of
from benchmarks.ground import Inferred, opened
from fieldfuse.nerfusion.gru import RunningMean
from fieldfuse.nerfusion.model import NerfusionModel
from fieldfuse.pipelines.options import Config, ImageSize, Out, Pairs, Quiet, Seed, Source, gather
from fieldfuse.training.from_network import load_networks

OF_OPTIONS: dict[str, dict[str, Any]] = {
    "no pruning": {"gamma": 1.0},
    "sweeps alone": {"agreement": False},
    "colours of the fusion": {"recolour": False},
}
PARTS = ("whole", "no variance", "no direction code", "mean instead of GRU", *OF_OPTIONS)


def ablations(
    source: Source,
    out: Out,
    views: Annotated[str, typer.Option(help="Number of training views, or 'all'.")] = ALL,
    image_size: ImageSize = None,
    seed: Seed = None,
    config: Config = None,
    pairs: Pairs = None,
    quiet: Quiet = False,
) -> None:
    """Direct inference with parts of the trained networks switched off: variance, direction code, GRU, pruning, second colours."""
    (count, *_) = counts_of(views) or [None]
    with opened(source, out, gather(None, config, pairs, image_size=image_size, seed=seed, threads=1), quiet) as ready:
        model, ground = load_networks(ready.job.settings.network.weights, ready.job.settings.device), ready.ground(count)
        options = ready.job.settings.network

        def run(entry: Row) -> Row:
            with without(model, entry["part"]):
                changed = replace(options, **OF_OPTIONS.get(entry["part"], {}))
                return Inferred.of(model, ground, changed, ready.job.progress).measured(ground, ready.job.progress)

        plan = [{"views": ground.training, "part": part} for part in PARTS]
        experiment = Experiment("ablations", plan, run, table, ready.state(), ready.about())
        data = experiment.conduct(out, ready.job.progress, 1, ready.job.settings.device)
    show(section(data, table), quiet)


@contextmanager
def without(model: NerfusionModel, part: str) -> Iterator[None]:
    """The model with one part switched off while the context is open: of `PARTS`, those that are parts of the networks.

    Of the direction code the last layer's numbers are set to zero, where they lie: on CUDA encoding is recorded (`networks.recorded`), and
    a recording reads its parameters anew, but calls no hooks.
    """
    config, fusion = model.config, model.fusion
    last = [] if part != "no direction code" or model.direction is None else list(model.direction[-1].parameters())
    before = [value.detach().clone() for value in last]
    if part == "no variance":
        model.config = replace(config, variance=False)
    elif part == "mean instead of GRU":
        model.fusion = RunningMean()
    try:
        with torch.no_grad():
            for value in last:
                value.zero_()
        yield
    finally:
        model.config, model.fusion = config, fusion
        with torch.no_grad():
            for value, old in zip(last, before, strict=True):
                value.copy_(old)


def table(data: Row) -> str:
    """Markdown: a line for each part."""
    head = ("training views", "networks", "PSNR", "SSIM", "seconds")
    rows = ([row["views"], row["part"], f"{row['psnr']:.2f}", f"{row['ssim']:.3f}", f"{row['seconds']:.0f}"] for row in data["rows"])
    return markdown(head, rows)


app = application(ablations)
if __name__ == "__main__":
    program(app)
