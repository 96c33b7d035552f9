"""`python -m benchmarks.engines SOURCE --out DIR`: what the engines of this machine reach on a capture within seconds of the clock.

The fit is a run's own, with matching before it where a run matches; compiling is not in its seconds. Of the fitted field the times of a ray
of a training step and of a render of 640×480 pixels are measured.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Annotated

import numpy as np
import torch
import typer

from benchmarks.experiment import Experiment, Row, application, chosen, markdown, numbers, program, section, show
from benchmarks.ground import Ground, measured, opened
from fieldfuse.camera import Array, Intrinsics
from fieldfuse.config import ENGINES, Settings
from fieldfuse.pipelines.options import Config, Device, ImageSize, Out, Pairs, Quiet, Seed, Source, Threads, gather
from fieldfuse.progress import SILENT, Progress
from fieldfuse.render.field import Field
from fieldfuse.render.image import make_renderer, render_view
from fieldfuse.steps import choose_device
from fieldfuse.training.engine import chosen_engine, fit_device, make_engine
from fieldfuse.training.guided import fit_guided
from fieldfuse.training.losses import Rates
from fieldfuse.training.pixels import PixelPool

IMAGE = (640, 480)
RENDERS, STEPS, ENOUGH = 9, 50, 3.0  # repetitions at most, and seconds after which fewer will do
RAYS, WARM = 8192, 3
STILL = Rates(0.0, 0.0, 0.0, 0.01, 0.01)


def engines(
    source: Source,
    out: Out,
    budgets: Annotated[str, typer.Option(help="Seconds of fitting, separated by commas.")] = "5,30",
    engines: Annotated[str, typer.Option(help="Engines, separated by commas: auto, numba, triton, torch.")] = "auto",
    device: Device = None,
    image_size: ImageSize = None,
    threads: Threads = None,
    seed: Seed = None,
    config: Config = None,
    pairs: Pairs = None,
    quiet: Quiet = False,
) -> None:
    """Held-out quality of fits by each engine, and the time of a render of 640×480 pixels."""
    seconds, names = numbers(budgets, "--budgets"), chosen(engines, ENGINES, "--engines")
    options = gather(None, config, pairs, image_size=image_size, seed=seed, threads=threads, device=device)
    with opened(source, out, options, quiet) as ready:
        settings, progress = ready.job.settings, ready.job.progress
        for name in names:
            choose_device(settings.device, name)
        ground = ready.ground()
        plan = [{"engine": name, "budget": budget} for name in names for budget in seconds]
        run = lambda entry: engine_row(ground, entry["engine"], entry["budget"], progress)  # noqa: E731
        data = Experiment("engines", plan, run, table, ready.state(), ready.about()).conduct(
            out, progress, settings.threads, settings.device
        )
    show(section(data, table), quiet)


def engine_row(ground: Ground, engine: str, budget: float, progress: Progress = SILENT) -> Row:
    """Held-out scores of a fit, its steps and rays, and times of the fitted field."""
    settings = replace(ground.settings, engine=engine, fit=replace(ground.settings.fit, budget=budget))
    device = fit_device(settings)
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    fit = fit_guided(ground.views, ground.scene, settings, progress)
    row: Row = {"chosen": chosen_engine(settings, device), "seconds": round(fit.seconds, 2)}
    row |= measured(fit.field, replace(ground, settings=settings))
    row |= {"steps": fit.steps, "rays": fit.rays, "resolution": fit.field.resolution, "voxels": fit.field.voxels, "timeline": fit.timeline}
    row["ray_us"] = round(ray_microseconds(fit.field, ground, settings), 4)
    row["picture_ms"] = round(render_milliseconds(fit.field, *camera_of(ground), engine), 2)
    if device.type == "cuda":
        row["peak_mb"] = round(torch.cuda.max_memory_allocated(device) / 1e6)
    return row


def median_seconds(work: Callable[[], object], most: int) -> float:
    """Of at most `most` repetitions, and fewer once they took `ENOUGH` seconds."""
    seconds = list[float]()
    while not seconds or (len(seconds) < most and sum(seconds) < ENOUGH):
        began = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - began)
    return float(np.median(seconds))


def ray_microseconds(field: Field, ground: Ground, settings: Settings) -> float:
    """Of a step on `RAYS` rays: median over steps that move nothing, each waited for."""
    pool = PixelPool(ground.views.subset(np.flatnonzero(~ground.views.test)), field.device)
    engine = make_engine(settings, field, pool)

    def step() -> None:
        engine.step(RAYS, STILL)
        if field.device.type == "cuda":
            torch.cuda.synchronize(field.device)

    for _ in range(WARM):
        step()
    return 1e6 * median_seconds(step, STEPS) / RAYS


def camera_of(ground: Ground) -> tuple[Intrinsics, Array]:
    """A camera of 640×480 pixels where the first held-out image was taken (else the first), with the same angle across."""
    views = ground.views
    first = int(np.argmax(views.test))
    lens, (width, height) = views.intrinsics[first], IMAGE
    focal = lens.fx * width / lens.width
    return Intrinsics(width, height, focal, focal, width / 2, height / 2), views.world_from_camera[first]


def render_milliseconds(field: Field, lens: Intrinsics, pose: Array, engine: str = "auto") -> float:
    """Median milliseconds of a render, from the camera to arrays in the processor's memory, after a first one that makes things ready."""
    view = make_renderer(field, engine)
    render_view(field, lens, pose, view)
    return 1000 * median_seconds(lambda: render_view(field, lens, pose, view), RENDERS)


def table(data: Row) -> str:
    """Markdown: a line a row."""
    head = ["engine", "budget", "PSNR", "SSIM", "LPIPS", "steps", "million rays", "voxels", "µs a ray", "render of 640×480"]
    lines = []
    for row in data["rows"]:
        scores = [f"{row['psnr']:.2f}", *("" if row[name] is None else f"{row[name]:.3f}" for name in ("ssim", "lpips"))]
        counts = [f"{row['steps']:,}", f"{row['rays'] / 1e6:.1f}", f"{row['voxels']:,}"]
        times = [f"{row['ray_us']:.3f}", f"{row['picture_ms']:.1f} ms"]
        lines.append([row["chosen"], f"{row['budget']:g} s", *scores, *counts, *times])
    return markdown(head, lines)


app = application(engines)
if __name__ == "__main__":
    program(app)
