"""Depth of the training pictures that no sensor measured: by matching them with each other (the stage `stereo`), or a simulation's own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fieldfuse.errors import InputError
from fieldfuse.pipelines.job import Job

if TYPE_CHECKING:
    from fieldfuse.capture.types import Capture, Views
    from fieldfuse.poses.scene import Scene
    from fieldfuse.stereo.match import StereoDepth


def match_pictures(job: Job, scene: Scene, views: Views) -> list[StereoDepth]:
    """Depth of every training view, matched, and where bare planes go on; held-out pictures are not looked at.

    Raises:
        InputError: the pictures cannot be matched.
        Interrupted: the user asked to stop.
    """
    from fieldfuse.stereo.maps import load_stereo, save_stereo
    from fieldfuse.stereo.match import stereo_depths
    from fieldfuse.stereo.plane_completion import continued

    path = job.folder / "stereo" / "depths.safetensors"
    training = views.subset(np.flatnonzero(~views.test))

    def make() -> list[StereoDepth]:
        found = stereo_depths(training, scene.near, scene.far, scene.median_depth, progress=job.progress)
        return continued(found, training, scene.median_depth, job.progress)

    def load() -> list[StereoDepth]:
        names, depths = load_stereo(path)
        if names != training.names:
            raise InputError(f"{path} is of other pictures; remove it and run the command again")
        return depths

    def save(depths: list[StereoDepth]) -> list[Path]:
        save_stereo(path, training.names, depths)
        return [path]

    return job.stages.run(
        "stereo",
        make=make,
        save=save,
        load=load,
        after=["scene", "views"],
        rounded=True,
        version=2,
    )


def views_for_fit(job: Job, scene: Scene, views: Views) -> tuple[Views, list[str]]:
    """The views with the depth that the settings' `fit.depth_from` lets a fit know, and the stages that this depth comes from.

    Raises:
        InputError: the pictures are to be matched, and cannot be.
        Interrupted: the user asked to stop.
    """
    from fieldfuse.stereo.fast_mvs import with_depths

    wanted = job.settings.fit.depth_from if job.settings.fit.depth > 0 else "off"
    if wanted == "off":
        return replace(views, depths=[]), []
    known = any(depth is not None for depth in views.depths)
    full = wanted == "any" or (wanted == "auto" and job.settings.tsdf.enabled == "on")  # then it is there for the surface
    if known or not full:
        return views, []  # by `auto`, the fit matches pictures itself, quickly
    return with_depths(views, np.flatnonzero(~views.test), match_pictures(job, scene, views)), ["stereo"]


def reuse_matched(job: Job, scene: Scene, views: Views) -> None:
    """Take up depth by matching that the folder has, so that a surface made of it counts as standing on what is there."""
    if job.stages.usable("stereo"):
        match_pictures(job, scene, views)


def exact_depths(posed: Capture, scene: Scene, views: Views) -> list[StereoDepth]:
    """The true depth of every training view, for captures that bring it.

    Raises:
        InputError: a training picture has none.
    """
    from fieldfuse.evaluation.compare_truth import find_truth, true_depths
    from fieldfuse.stereo.match import StereoDepth

    truth = find_truth(posed)
    training = np.flatnonzero(~views.test)
    depths = [] if truth is None else true_depths(truth, posed, views, training, scene.working_from_input.scale)
    known = [depth for depth in depths if depth is not None]
    if not known or len(known) < len(training):
        raise InputError(f"{posed.root} brings no exact depth for {len(training) - len(known)} of its pictures; choose another depth")
    return [
        StereoDepth(depth, (depth > 0).astype(np.float32), views.intrinsics[index]) for depth, index in zip(known, training, strict=True)
    ]
