"""What the engines of a machine reach: fits within seconds of the clock, and the time of a ray of a step and of a picture."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.config import Settings
from fieldfuse.evaluation.few_views import Ground, measured
from fieldfuse.progress import SILENT, Progress
from fieldfuse.render.field import Field
from fieldfuse.render.image import make_renderer, render_view
from fieldfuse.training.engine import chosen_engine, fit_device, make_engine
from fieldfuse.training.guided import fit_guided
from fieldfuse.training.rays import PixelPool
from fieldfuse.training.step import Rates

PICTURE = (640, 480)
REPETITIONS, ENOUGH = 9, 3.0  # of a picture, at most, and seconds after which fewer will do
RAYS, WARM, STEPS = 8192, 3, 50
STILL = Rates(0.0, 0.0, 0.0, 0.01, 0.01)


def engine_rows(ground: Ground, engines: Iterable[str], budgets: Iterable[float], progress: Progress = SILENT) -> Iterable[dict[str, Any]]:
    """A row for each engine and budget: held-out scores, steps, rays, and of the fitted field microseconds of a step's ray and milliseconds
    of a picture.

    The fit is a run's own, with matching before it where a run matches; its seconds are those of the clock, and compiling is not in them.
    """
    device, budgets = fit_device(ground.settings), list(budgets)
    for engine in engines:
        for budget in budgets:
            settings = replace(ground.settings, engine=engine, fit=replace(ground.settings.fit, budget=budget))
            if device.type == "cuda":
                torch.cuda.reset_peak_memory_stats(device)
            result = fit_guided(ground.views, ground.scene, settings, progress)
            row: dict[str, Any] = {"engine": chosen_engine(settings, device), "budget": budget, "seconds": round(result.seconds, 2)}
            row |= measured(result.field, replace(ground, settings=settings))
            row |= {"steps": result.steps, "rays": result.rays, "resolution": result.field.resolution, "voxels": result.field.voxels}
            row["timeline"] = result.timeline
            row["ray_us"] = round(ray_microseconds(result.field, ground, settings), 4)
            row["picture_ms"] = round(picture_milliseconds(result.field, *camera_of(ground), engine), 2)
            if device.type == "cuda":
                row["peak_mb"] = round(torch.cuda.max_memory_allocated(device) / 1e6)
            yield row


def ray_microseconds(field: Field, ground: Ground, settings: Settings) -> float:
    """Of a step on `RAYS` rays: median over steps that move nothing, each waited for."""
    pool = PixelPool(ground.views.subset(np.flatnonzero(~ground.views.test)), field.device)
    engine, seconds = make_engine(settings, field, pool), list[float]()
    for _ in range(WARM):
        engine.step(RAYS, STILL)
    while not seconds or (len(seconds) < STEPS and sum(seconds) < ENOUGH):
        wait(field.device)
        began = time.perf_counter()
        engine.step(RAYS, STILL)
        wait(field.device)
        seconds.append(time.perf_counter() - began)
    return 1e6 * float(np.median(seconds)) / RAYS


def wait(device: torch.device) -> None:
    """Until the device has done all that it was asked for."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def camera_of(ground: Ground) -> tuple[Intrinsics, Array]:
    """A camera of 640×480 pixels where the first held-out picture was taken (else the first), with the same angle across."""
    views = ground.views
    first = int(np.argmax(views.test))
    lens, (width, height) = views.intrinsics[first], PICTURE
    focal = lens.fx * width / lens.width
    return Intrinsics(width, height, focal, focal, width / 2, height / 2), views.world_from_camera[first]


def picture_milliseconds(field: Field, lens: Intrinsics, pose: Array, engine: str = "auto") -> float:
    """Median milliseconds of a picture, from the camera to arrays in the processor's memory. The first one makes things ready."""
    view, seconds = make_renderer(field, engine), list[float]()
    render_view(field, lens, pose, view)
    while not seconds or (len(seconds) < REPETITIONS and sum(seconds) < ENOUGH):
        began = time.perf_counter()
        render_view(field, lens, pose, view)
        seconds.append(time.perf_counter() - began)
    return 1000 * float(np.median(seconds))


def engine_table(rows: list[dict[str, Any]]) -> str:
    """The rows in Markdown."""
    names = "engine | budget | PSNR | SSIM | LPIPS | steps | million rays | voxels | µs a ray | picture of 640×480"
    lines = [f"| {names} |", "| --- " * 10 + "|"]
    for row in rows:
        scores = [f"{row['psnr']:.2f}", *("" if row[name] is None else f"{row[name]:.3f}" for name in ("ssim", "lpips"))]
        counts = [f"{row['steps']:,}", f"{row['rays'] / 1e6:.1f}", f"{row['voxels']:,}"]
        counts += [f"{row['ray_us']:.3f}", f"{row['picture_ms']:.1f} ms"]
        cells = [row["engine"], f"{row['budget']:g} s", *scores, *counts]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"
