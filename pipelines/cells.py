"""`fieldfuse run --cells`: the fit of a large scene, cell by cell, on this machine or on the nodes of a Ray cluster.

The coarse field is fitted here. Then the folder `cells/` has all that a worker needs, and each cell that is fitted is a file there, so a
run that is killed, or whose worker or node is lost, goes on with the cells that are missing.
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch

from fieldfuse.capture.types import Views
from fieldfuse.cluster import Task, Workers, open_workers
from fieldfuse.errors import FieldfuseError, InputError, Interrupted
from fieldfuse.files import fingerprint, read_json, remove, write_json
from fieldfuse.nerfusion.decoder import Deferred
from fieldfuse.pipelines.job import Job
from fieldfuse.poses.scene import Scene
from fieldfuse.render.field import Field
from fieldfuse.render.image import make_renderer
from fieldfuse.stereo.transients import load_left_out, save_left_out
from fieldfuse.training.cells import scene as cells
from fieldfuse.training.fit import TIMELINE_PIXELS, Begin, FitResult, Sample

FOLDER = "cells"
LEFT_OUT, MATCHED = "left_out.safetensors", "matched.json"  # of the coarse fit, and so of the whole


def fit_in_cells(job: Job, views: Views, scene: Scene, begin: Begin) -> FitResult:
    """Fit a coarse field, cut it, have the cells fitted, and put them together.

    Args:
        views: all of them, as `fit_guided` takes them.
        begin: what the coarse fit begins with.

    Raises:
        InputError: the cluster cannot be used.
        FieldfuseError: a cell could not be fitted; the others are kept.
        Interrupted: the user asked to stop; what was fitted is kept.
    """
    settings, folder = job.settings, job.folder / FOLDER
    folder.mkdir(exist_ok=True)
    inputs = {name: job.stages.records[name].made for name in job.stages.done("scene", "views", "stereo", "network")}
    key = fingerprint(inputs, asdict(settings.field), asdict(settings.fit), settings.seed, settings.preset)
    plan = cells.read_plan(folder)
    if plan is None or plan.key != key or cells.missing(folder, plan):
        # A cluster that cannot be used is to be known before the coarse fit, not after it.
        with open_workers(settings.address, cpus=settings.threads) as workers:
            workers.check(folder)
            if plan is None or plan.key != key:
                for file in folder.iterdir():
                    remove(file)
                coarse = _fit_coarse(job, folder, views, scene, begin)
                if coarse.done == 1:
                    coarse.notes.append("seconds or steps were too few for the finer lattice that cells would have: fitted in one piece")
                    return coarse
                plan = cells.write_scene(folder, key, coarse, scene, settings, job.progress)
            _fit_missing(job, folder, plan, workers)
            cells.remove_pixels(folder)
    notes = [f"fitted as {plan.count} cells of a lattice of {plan.resolution}³ voxels around a coarse field"]
    field, remarks = cells.merge_scene(folder, plan)
    known = [cells.fitted_cell(folder, plan, cell) or {} for cell in range(plan.count)]
    seconds = plan.seconds_before + sum(facts["seconds"] for facts in known)
    result = FitResult(field, seconds=seconds, steps=plan.steps_before + sum(facts["steps"] for facts in known), notes=notes + remarks)
    result.rays = plan.rays_before + sum(facts["rays"] for facts in known)
    result.left_out = load_left_out(folder / LEFT_OUT) if (folder / LEFT_OUT).is_file() else None
    result.matched = read_json(folder / MATCHED) if (folder / MATCHED).is_file() else None
    shown = Sample(views, np.flatnonzero(views.test), TIMELINE_PIXELS, field.device).psnr(_Shown(field))
    result.timeline = [{"seconds": round(seconds, 3), "psnr": round(shown, 4)}] if shown is not None else []
    return result


class _Shown:
    """A finished field as a sample of pixels looks at it."""

    def __init__(self, field: Field) -> None:
        self._view = make_renderer(field)

    def colours(self, origins: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
        return self._view(origins, directions).colour


def _fit_coarse(job: Job, folder: Path, views: Views, scene: Scene, begin: Begin) -> FitResult:
    result = cells.fit_coarse(views, scene, job.settings, job.progress, begin)
    if result.interrupted:
        raise Interrupted("stopped on request before the coarse field was done; run the same command again")
    if not isinstance(result.field.decoder, Deferred):
        raise InputError("cells need the deferred decoder; drop --decoder, or leave --cells out")
    if result.left_out is not None:
        save_left_out(folder / LEFT_OUT, result.left_out)
    if result.matched is not None:
        write_json(folder / MATCHED, result.matched)
    return result


def _fit_missing(job: Job, folder: Path, plan: cells.ScenePlan, workers: Workers) -> None:
    """Have all cells fitted that are not yet."""
    missing = cells.missing(folder, plan)
    if not missing:
        return
    tasks = [Task(f"cell {cell + 1} of {plan.count}", (str(folder), cell), memory=plan.memory[cell]) for cell in missing]
    if refusal := next(filter(None, map(workers.too_large, tasks)), None):
        raise InputError(f"{refusal}; give more --cells, or add a node")
    at_once = workers.at_once(max(tasks, key=lambda task: task.memory))

    def show(done: float) -> None:
        job.progress.update(plan.count - len(missing) + done, plan.count, f"{plan.count} cells, {at_once} at once")
        if job.progress.stopping():
            workers.stop()

    failed = workers.finish(cells.fit_cell_of, tasks, show)
    job.progress.check()
    if failed:
        raise FieldfuseError(f"{failed[0]}; {plan.count - len(failed)} cells are kept, run the same command again to fit the rest")
