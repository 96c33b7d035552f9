"""A capture as benchmarks of fits use it: prepared as a run does it, with some of its training views, and scored at its held-out views."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fieldfuse.capture.prepare import limited, prepare_views
from fieldfuse.capture.types import Capture, Views
from fieldfuse.config import NetworkSettings, Settings, settings_dict
from fieldfuse.effects.correct import Corrections
from fieldfuse.evaluation.score import score_views
from fieldfuse.files import fingerprint
from fieldfuse.nerfusion.model import NerfusionModel
from fieldfuse.pipelines.console import make_progress
from fieldfuse.pipelines.direct_field import training_key_frames, weights_state
from fieldfuse.pipelines.job import Job, open_job
from fieldfuse.pipelines.options import Place
from fieldfuse.pipelines.prepare import choose_frames, find_camera_poses, find_capture, find_effects
from fieldfuse.poses.scene import Scene, describe_scene
from fieldfuse.progress import SILENT, Progress
from fieldfuse.render.field import Field
from fieldfuse.render.image import make_renderer, render_view
from fieldfuse.training.from_network import Inference

SHOWN = ("psnr", "ssim", "lpips", "depth_abs_err")


@dataclass(frozen=True)
class Ground:
    """A capture with some of its training views."""

    views: Views
    scene: Scene
    settings: Settings

    @property
    def training(self) -> int:
        """Number of training views."""
        return int(np.count_nonzero(~np.asarray(self.views.test)))


@dataclass(frozen=True)
class Opened:
    """A capture whose poses and effects were found with all training images, so that they are the same for every number of views."""

    job: Job
    posed: Capture
    corrections: Corrections

    def ground(self, count: int | None = None) -> Ground:
        """The capture with `count` of its training views (None: all)."""
        settings, progress = self.job.settings, self.job.progress
        some = limited(self.posed, settings.capture.holdout, count)
        scene = describe_scene(some, progress)
        views = prepare_views(some, scene.working_from_input, settings.capture, progress)
        return Ground(self.corrections.on_views(views), scene, settings)

    def state(self) -> str:
        """Changes with settings, weights, and what was made of the capture; rows name the budget themselves."""
        settings = settings_dict(self.job.settings)
        settings["fit"] = {key: value for key, value in settings["fit"].items() if key != "budget"}
        return fingerprint(settings, weights_state(self.job.settings), {name: one.made for name, one in self.job.stages.records.items()})

    def about(self) -> dict[str, Any]:
        """For the file of results."""
        return {"source": str(self.job.source), "settings": settings_dict(self.job.settings)}


@contextmanager
def opened(source: Path, out: Path, options: dict[str, Any], quiet: bool) -> Iterator[Opened]:
    """`source` in a run folder `out`, with everything up to the effects done as a run does it."""
    with open_job(Place(source, out), options, make_progress(quiet)) as job:
        capture = choose_frames(job, find_capture(job))
        posed = find_camera_poses(job, capture).apply(capture)
        corrections = find_effects(job, posed)
        yield Opened(job, corrections.on_capture(posed), corrections)


def measured(field: Field, ground: Ground) -> dict[str, Any]:
    """Mean scores of a field over the held-out views."""
    views = ground.views
    view = make_renderer(field, ground.settings.engine)
    indices = np.flatnonzero(views.test)
    scores = score_views((render_view(field, views.intrinsics[i], views.world_from_camera[i], view) for i in indices), views, indices)
    return {name: scores[name] for name in SHOWN}


@dataclass(frozen=True)
class Inferred:
    """Direct inference with all key frames fused: seconds are processor time."""

    inference: Inference
    seconds: float

    @classmethod
    def of(cls, model: NerfusionModel, ground: Ground, options: NetworkSettings, progress: Progress = SILENT) -> Inferred:
        """Fuse the key frames of the training views."""
        began = time.process_time()
        keys = training_key_frames(ground.views, ground.scene, ground.settings)
        inference = Inference(model, ground.views, ground.scene, keys, ground.settings.field.background, options)
        for _ in inference.frames(progress):
            pass
        return cls(inference, round(time.process_time() - began, 2))

    def measured(self, ground: Ground, progress: Progress = SILENT) -> dict[str, Any]:
        """Scores of the field with its colours, whose seconds count too."""
        began = time.process_time()
        field = self.inference.result(progress, ground.settings.engine)
        seconds = self.seconds + time.process_time() - began
        return {**measured(field, ground), "key_frames": self.inference.done, "seconds": round(seconds, 2)}
