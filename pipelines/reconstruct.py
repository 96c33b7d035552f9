"""The main job: capture → poses → key frames → views → TSDF surface and radiance field → renders → exports → report."""

from __future__ import annotations

import time
from typing import Any

from fieldfuse.pipelines.exports import TEXTURE, Wish, export_results, require_originals
from fieldfuse.pipelines.fields import (
    fit_radiance_field,
    make_network_field,
    render_network_views,
    render_test_views,
    score_pictures,
    uses_network,
)
from fieldfuse.pipelines.job import Job
from fieldfuse.pipelines.prepare import Prepared, choose_frames, find_camera_poses, find_capture, find_scaling, prepare
from fieldfuse.pipelines.splats import SPLATS, make_splats, render_splats
from fieldfuse.pipelines.summary import Results, put_report, summarise_poses
from fieldfuse.pipelines.surfaces import fuse_tsdf, match_images
from fieldfuse.pipelines.textured import TSDF_TEXTURE, texture_tsdf
from fieldfuse.pipelines.total_budget import TotalBudget

RESULTS = ("tsdf", "field", "render", "export")
FOR_FIELD = ("network", "direct")  # made with the field


def find_poses(job: Job) -> dict[str, Any]:
    """Camera poses alone; answers a summary of them."""
    capture = choose_frames(job, find_capture(job))
    return summarise_poses(job, *find_scaling(job, capture, find_camera_poses(job, capture)))


def reconstruct(job: Job, goals: frozenset[str], go_on: bool, formats: list[str] | None, total_budget: float | None) -> dict[str, Any]:
    """Make the results named in `goals` (a part of `RESULTS`), with all that they need, and the report of all that is there.

    Results that are not among the goals are left as they are, and stay in the report as long as they still fit.

    Args:
        go_on: a field that the folder has is fitted further.
        formats: to be exported this time, whatever the settings are.
        total_budget: seconds for all of it.

    Returns:
        `report.json`.
    """
    plan = None if total_budget is None else TotalBudget(total_budget)
    start, stages = time.monotonic(), job.stages
    stages.trusted |= set(RESULTS) - goals
    if "tsdf" not in goals:
        stages.trusted.add(TSDF_TEXTURE)
    if "field" not in goals or (go_on and "network" not in job.changed):
        stages.trusted |= set(FOR_FIELD)  # what a fit begins with, whether the folder's field was fitted or not
    capture = find_capture(job)
    if plan is not None:
        plan.choose_pictures(job, capture)
    ready = prepare(job, capture)
    if job.again and {"field", "export"} <= goals:
        require_originals(job, ready)

    results = Results(plan=plan)
    if stages.usable("stereo"):
        match_images(job, ready)  # so that a surface made of it counts as standing on what is there
    if ("tsdf" in goals and wants_tsdf(job, ready)) or stages.usable("tsdf"):
        results.pictures["tsdf"] = surface = fuse_tsdf(job, ready)
        wanted = "tsdf" in goals and TEXTURE in job.settings.export.formats and surface.facts["mesh"]["triangles"]
        if wanted or stages.usable(TSDF_TEXTURE):
            texture_tsdf(job, ready)
    if goals & {"field", "render", "export"} or stages.usable("field"):
        network = None
        if uses_network(job, ready, planned=plan is not None):
            network = make_network_field(job, ready)
            if job.settings.fit.finetune:  # else the field is this one
                results.pictures["network"] = render_network_views(job, ready, network)
        if plan is not None:
            plan.choose_fit(job, ready)
        results.fitted = fitted = fit_radiance_field(job, ready, network, go_on)
        if "render" in goals or stages.usable("render"):
            results.pictures["field"] = render_test_views(job, ready, fitted.field)
        # Who wants to stop waits for the report, not for a video.
        if stages.usable("export") or ("export" in goals and not stages.stopped()):
            if plan is not None:
                plan.choose_exports(job)
            results.exported = export_results(job, ready, fitted, Wish(formats, goals == {"export"}))
        if stages.usable(SPLATS):
            stages.trusted.add(SPLATS)
            results.pictures["splats"] = render_splats(job, ready, make_splats(job, ready, fitted))
    results.scores = score_pictures(job, ready, results.pictures)
    return put_report(job, ready, results, time.monotonic() - start)


def wants_tsdf(job: Job, ready: Prepared) -> bool:
    """Whether this run makes the TSDF surface: when the capture has depth or the settings have it on; then images alone are matched."""
    wanted = job.settings.tsdf.enabled
    return wanted == "on" or (wanted == "auto" and ready.posed.has_depth)
