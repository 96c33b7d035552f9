"""What a few training views give: the networks alone, the fit from the networks' start, and the fit from the classical one.

Held-out views are the same for every number of training views. Seconds are of one thread's processor time, so that other work on the
machine does not blur the comparison; the networks' seconds stand beside, they are not part of a fit's budget.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from fieldfuse.capture.types import Views
from fieldfuse.config import Settings
from fieldfuse.evaluation.baseline import nearest_image_scores
from fieldfuse.evaluation.score import score_views
from fieldfuse.nerfusion.gru import RunningMean
from fieldfuse.nerfusion.keyframes import KeyFrames, select_keyframes
from fieldfuse.nerfusion.model import NerfusionModel
from fieldfuse.poses.scene import Scene
from fieldfuse.progress import SILENT, Progress
from fieldfuse.render.field import Field
from fieldfuse.render.image import make_renderer, render_view

if TYPE_CHECKING:
    from fieldfuse.training.from_network import Inference, NetworkOptions

STARTS = ("direct", "network", "classical")
SHOWN = ("psnr", "ssim", "lpips", "depth_abs_err")
OF_OPTIONS: dict[str, dict[str, Any]] = {
    "no pruning": {"gamma": None},
    "sweeps alone": {"agreement": False},
    "colours of the fusion": {"recolour": False},
}
ABLATIONS = ("whole", "no variance", "no direction code", "mean instead of GRU", *OF_OPTIONS)


@dataclass(frozen=True)
class Ground:
    """One capture with some of its training views."""

    views: Views
    scene: Scene
    settings: Settings

    @property
    def training(self) -> int:
        """Number of training views."""
        return int(np.count_nonzero(~np.asarray(self.views.test)))

    def keys(self) -> KeyFrames:
        """Key frames among the training views, as a run chooses them but for sharpness."""
        train = np.flatnonzero(~np.asarray(self.views.test))
        chosen = self.settings.keyframes
        return select_keyframes(
            self.views.world_from_camera[train],
            [self.views.intrinsics[int(i)] for i in train],
            self.scene.median_depth,
            method=chosen.method,
            every=chosen.every,
            most=chosen.most,
        )


def measured(field: Field, ground: Ground) -> dict[str, Any]:
    """Mean scores of a field over the held-out views."""
    views = ground.views
    view = make_renderer(field, ground.settings.engine)
    indices = np.flatnonzero(views.test)
    shown = (render_view(field, views.intrinsics[i], views.world_from_camera[i], view) for i in indices)
    scores = score_views(shown, views, indices)
    return {name: scores[name] for name in SHOWN}


def infer(model: NerfusionModel, ground: Ground, options: NetworkOptions, progress: Progress = SILENT) -> tuple[Inference, dict[str, Any]]:
    """Direct inference with all key frames fused, and its seconds (processor time) and number of key frames."""
    from fieldfuse.training.from_network import Inference

    began = time.process_time()
    inference = Inference(model, ground.views, ground.scene, ground.keys(), ground.settings.field.background, options)
    for _ in inference.frames(progress):
        pass
    return inference, {"key_frames": inference.done, "seconds": round(time.process_time() - began, 2)}


def measured_alone(inference: Inference, ground: Ground, facts: dict[str, Any], progress: Progress = SILENT) -> dict[str, Any]:
    """What direct inference gives, measured, its facts with the seconds of its colours."""
    began = time.process_time()
    field = inference.result(progress, ground.settings.engine)
    seconds = facts["seconds"] + time.process_time() - began
    return {**measured(field, ground), **facts, "seconds": round(seconds, 2)}


def few_views_rows(
    ground: Ground,
    model: NerfusionModel,
    budgets: Iterable[float],
    done: set[tuple[Any, ...]],
    starts: Iterable[str] = STARTS,
    progress: Progress = SILENT,
) -> Iterable[dict[str, Any]]:
    """A row for the nearest training picture, one for the networks alone, and two for each budget, each as soon as it is measured.

    Args:
        starts: what is measured, a part of `STARTS`.
        done: (views, start, budget) of rows that are there already.
    """
    from fieldfuse.training.from_network import NetworkOptions
    from fieldfuse.training.guided import fit_guided
    from fieldfuse.training.network_start import network_start

    views, scene, settings, count = ground.views, ground.scene, ground.settings, ground.training
    budgets, starts = list(budgets), list(starts)
    if (count, "nearest", 0) not in done:
        nearest = nearest_image_scores(views, np.flatnonzero(views.test))
        yield {"views": count, "start": "nearest", "budget": 0, "psnr": nearest["psnr"]}
    made: Field | None = None
    alone = "direct" in starts and (count, "direct", 0) not in done
    if alone or ("network" in starts and any((count, "network", budget) not in done for budget in budgets)):
        inference, facts = infer(model, ground, NetworkOptions.of(settings.network), progress)
        made = inference.field()
        if alone:
            yield {"views": count, "start": "direct", "budget": 0, **measured_alone(inference, ground, facts, progress)}
    for budget in budgets:
        for start in STARTS[1:]:
            if start not in starts or (count, start, budget) in done:
                continue
            progress.check()
            asked = replace(settings, fit=replace(settings.fit, budget=budget))
            first = network_start(made, views, scene, asked) if start == "network" and made is not None else None
            fitted = fit_guided(views, scene, asked, progress, start=first, coarse=first is not None, ticks=time.process_time)
            row = {"views": count, "start": start, "budget": budget, **measured(fitted.field, ground)}
            yield {**row, "steps": fitted.steps, "resolution": fitted.field.resolution}


def ablation_rows(ground: Ground, model: NerfusionModel, progress: Progress = SILENT) -> Iterable[dict[str, Any]]:
    """Direct inference with parts of the trained networks switched off, one at a time. Nothing is trained again without them."""
    from fieldfuse.training.from_network import NetworkOptions

    options = NetworkOptions.of(ground.settings.network)
    for name in ABLATIONS:
        progress.check()
        with without(model, name):
            inference, facts = infer(model, ground, replace(options, **OF_OPTIONS.get(name, {})), progress)
            yield {"views": ground.training, "part": name, **measured_alone(inference, ground, facts, progress)}


@contextmanager
def without(model: NerfusionModel, part: str) -> Iterator[None]:
    """The model with one part switched off while the context is open: of `ABLATIONS`, those that are parts of the networks.

    Of the direction code the last layer's numbers are set to zero, where they lie: on CUDA encoding is recorded (`networks.recorded`), and
    a recording reads its parameters anew, but knows nothing of hooks.
    """
    config, fusion = model.config, model.fusion
    last = [] if part != "no direction code" or model.direction is None else list(model.direction[-1].parameters())
    kept = [value.detach().clone() for value in last]
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
            for value, old in zip(last, kept, strict=True):
                value.copy_(old)


def few_views_table(rows: list[dict[str, Any]]) -> str:
    """Markdown: a line for each number of views."""
    budgets = sorted({row["budget"] for row in rows if row["start"] in ("network", "classical")})
    fits = [(budget, start) for budget in budgets for start in ("classical", "network")]
    found = {(row["views"], row["start"], row["budget"]): row for row in rows}
    head = ["training views", "nearest picture", "networks alone", "their seconds"]
    head += [f"{start} start, {budget:g} s" for budget, start in fits]
    lines = [" | ".join(["", *head, ""]).strip(), "|".join(["", *(" --- " for _ in head), ""])]
    for count in sorted({row["views"] for row in rows}):
        direct = found.get((count, "direct", 0), {})
        cells = [
            str(count),
            _decibel(found.get((count, "nearest", 0))),
            _decibel(direct),
            f"{direct['seconds']:.0f}" if "seconds" in direct else "",
        ]
        cells += [_decibel(found.get((count, start, budget))) for budget, start in fits]
        lines.append(" | ".join(["", *cells, ""]).strip())
    return "\n".join(lines) + "\n"


def ablation_table(rows: list[dict[str, Any]]) -> str:
    """Markdown: a line for each part."""
    lines = ["| networks | PSNR | SSIM | seconds |", "| --- | --- | --- | --- |"]
    lines += [f"| {row['part']} | {_decibel(row)} | {row['ssim']:.3f} | {row['seconds']:.0f} |" for row in rows]
    return "\n".join(lines) + "\n"


def _decibel(row: dict[str, Any] | None) -> str:
    return f"{row['psnr']:.2f}" if row and row.get("psnr") is not None else ""
