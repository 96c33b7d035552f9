"""What the engines of a machine reach: fits of one capture within seconds of the clock, and the time of a picture, engine beside engine."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from toolkit.camera import Array, Intrinsics
from toolkit.evaluate.few_views import Ground, measured
from toolkit.progress import SILENT, Progress
from toolkit.render.field import Field
from toolkit.render.image import make_renderer, render_view
from toolkit.training.engine import chosen_engine, fit_device
from toolkit.training.guided import fit_guided

PICTURE = (640, 480)
REPETITIONS, ENOUGH = 9, 3.0  # of a picture, at most, and seconds after which fewer will do


def engine_rows(ground: Ground, engines: Iterable[str], budgets: Iterable[float], progress: Progress = SILENT) -> Iterable[dict[str, Any]]:
    """A row for each engine and budget: held-out scores, steps, rays, and milliseconds of a picture of the fitted field.

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
            row["picture_ms"] = round(picture_milliseconds(result.field, *camera_of(ground), engine), 2)
            if device.type == "cuda":
                row["peak_mb"] = round(torch.cuda.max_memory_allocated(device) / 1e6)
            yield row


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
    lines = ["| engine | budget | PSNR | SSIM | LPIPS | steps | million rays | voxels | picture of 640×480 |", "| --- " * 9 + "|"]
    for row in rows:
        scores = [f"{row['psnr']:.2f}", *("" if row[name] is None else f"{row[name]:.3f}" for name in ("ssim", "lpips"))]
        counts = [f"{row['steps']:,}", f"{row['rays'] / 1e6:.1f}", f"{row['voxels']:,}", f"{row['picture_ms']:.1f} ms"]
        cells = [row["engine"], f"{row['budget']:g} s", *scores, *counts]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"
