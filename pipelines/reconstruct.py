"""The main job: capture → poses → key frames → views → TSDF surface and radiance field → pictures → exports → report."""

from __future__ import annotations

import time
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fieldfuse.pipelines.console import ConsoleProgress
from fieldfuse.pipelines.job import Job, open_job
from fieldfuse.pipelines.steps_capture import choose_frames, choose_keyframes, find_camera_poses, find_capture, make_views, measure_scene
from fieldfuse.pipelines.steps_effects import find_effects
from fieldfuse.pipelines.steps_network import make_network_field, render_network_views, uses_network
from fieldfuse.pipelines.steps_results import export_results, fit_radiance_field, fuse_tsdf, render_test_views, score_pictures, wants_tsdf
from fieldfuse.pipelines.steps_stereo import reuse_matched
from fieldfuse.pipelines.summary import put_report, summarise_poses
from fieldfuse.pipelines.taken import TEXTURE, require_originals
from fieldfuse.pipelines.textured import TSDF_TEXTURE, texture_tsdf
from fieldfuse.steps import refined

if TYPE_CHECKING:
    from fieldfuse.capture.types import Capture, Views
    from fieldfuse.poses.result import PoseResult
    from fieldfuse.poses.scene import Scene

BEFORE = ("capture", "frames", "poses", "effects", "scene", "keyframes", "views")  # what every result stands on
RESULTS = ("tsdf", "field", "render", "export")
FOR_FIELD = ("network", "direct")  # made with the field
ALL = frozenset(RESULTS)


def run_job(
    target: Path,
    out: Path | None,
    options: dict[str, Any],
    goals: Iterable[str],
    progress: ConsoleProgress,
    trusted: Iterable[str] = BEFORE,
    go_on: bool = False,
) -> dict[str, Any]:
    """Open the run's folder and make `goals` in it, with all that they need; see `open_job` for the arguments."""
    with open_job(target, out, options, progress, trusted) as job:
        if options.get("total_budget") is not None:
            from fieldfuse.pipelines.total_budget import TotalBudget

            job.plan = TotalBudget(options["total_budget"])
        wanted = frozenset(goals)
        job.formats, job.alone = options.get("formats"), wanted == {"export"}
        return reconstruct(job, wanted, go_on) if wanted else reconstruct_poses(job)


def stand(job: Job) -> tuple[Capture, PoseResult, Capture, Scene, Views]:
    """What every result stands on: capture, poses, the posed capture (as far as it takes part), the scene, and the views made ready."""
    from fieldfuse.capture.prepare import limited

    capture = find_capture(job)
    if job.plan is not None:
        job.plan.choose_pictures(job, capture)
    capture = choose_frames(job, capture)
    poses = find_camera_poses(job, capture)
    posed = limited(poses.apply(capture), job.settings.capture.holdout, job.settings.views.limit)
    job.corrections = corrections = find_effects(job, posed)
    poses, posed = refined(poses, corrections), corrections.on_capture(posed)
    scene = measure_scene(job, posed)
    return capture, poses, posed, scene, make_views(job, posed, scene, corrections)


def reconstruct_poses(job: Job) -> dict[str, Any]:
    """Camera poses alone; answers a summary of them."""
    capture = choose_frames(job, find_capture(job))
    return summarise_poses(job, capture, find_camera_poses(job, capture))


def reconstruct(job: Job, goals: frozenset[str] = ALL, go_on: bool = False) -> dict[str, Any]:
    """Make the results named in `goals` (a part of `RESULTS`) and the report of all that is there; answers `report.json`.

    With `go_on`, a field that the folder has is fitted further.

    Results that are not asked for are left as they are, and stay in the report as long as they still fit.
    """
    start = time.monotonic()
    stages = job.stages
    stages.trust(set(RESULTS) - goals)
    stages.trust(() if "tsdf" in goals else (TSDF_TEXTURE,))
    # What the networks left is what a fit begins with, whether the folder's field was fitted or not.
    stages.trust(FOR_FIELD if "field" not in goals or (go_on and not job.other_network) else ())
    capture, poses, posed, scene, views = stand(job)
    if job.again and {"field", "export"} <= goals:
        require_originals(job, posed, views)
    choose_keyframes(job, scene, views)

    timeline: list[dict[str, Any]] = []
    field, exported = None, None
    pictures = {}
    reuse_matched(job, scene, views)
    if ("tsdf" in goals and wants_tsdf(job, posed)) or stages.usable("tsdf"):
        pictures["tsdf"] = fuse_tsdf(job, posed, scene, views)
        wanted = "tsdf" in goals and TEXTURE in job.settings.export.formats and pictures["tsdf"].facts["mesh"]["triangles"]
        if wanted or stages.usable(TSDF_TEXTURE):
            texture_tsdf(job, posed, scene, views)
    if goals & {"field", "render", "export"} or stages.usable("field"):
        if uses_network(job, views):
            made = make_network_field(job, views, scene)
            if job.settings.fit.finetune:  # else the field is this one
                pictures["network"] = render_network_views(job, made, views, scene)
        if job.plan is not None:
            job.plan.choose_fit(job, views, scene)
        field, timeline = fit_radiance_field(job, views, scene, go_on)
        if "render" in goals or stages.usable("render"):
            pictures["field"] = render_test_views(job, field, views, scene)
        # Who has asked to stop waits for the report, not for a video.
        if stages.usable("export") or ("export" in goals and not stages.stopped()):
            if job.plan is not None:
                job.plan.choose_exports(job)
            exported = export_results(job, field, poses, posed, scene, views)
    scores = score_pictures(job, views, pictures)
    return put_report(job, capture, poses, scene, views, field, timeline, pictures, scores, exported, time.monotonic() - start)
