"""What a run found, gathered for `report.json`, `report.html` and the terminal."""

from __future__ import annotations

import platform
import time
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from fieldfuse import __version__
from fieldfuse.camera import Array
from fieldfuse.capture.types import Capture
from fieldfuse.config import settings_dict
from fieldfuse.effects.correct import apart
from fieldfuse.evaluation.failure import failures
from fieldfuse.evaluation.pictures import method_pictures, moving_pictures
from fieldfuse.evaluation.report import report_data
from fieldfuse.export.georeference import write_georeference
from fieldfuse.export.sparse import thinned
from fieldfuse.files import write_json
from fieldfuse.pipelines.exports import put_cameras
from fieldfuse.pipelines.fields import Fitted
from fieldfuse.pipelines.folder import command_line
from fieldfuse.pipelines.job import Job
from fieldfuse.pipelines.prepare import EFFECTS_FILE, Prepared
from fieldfuse.pipelines.rendered import Pictures, depth_step
from fieldfuse.pipelines.schemas import Effects, read_checked
from fieldfuse.pipelines.source import describe_capture
from fieldfuse.pipelines.splats import SPLATS
from fieldfuse.pipelines.textured import TSDF_TEXTURE
from fieldfuse.pipelines.total_budget import TotalBudget
from fieldfuse.poses.result import PoseResult
from fieldfuse.poses.scene import find_cloud
from fieldfuse.stereo.transients import LeftOut

SEEN_BY_SFM = "poses were estimated from all images, the held-out ones included, so scores are slightly optimistic"
MATCHED = (
    "Matching {views} training images of {pixels} pixels with each other ({seconds:.1f} s of the fit's budget) gave depth for"
    " {percent:.0f}% of their pixels{bare}."
)
BARE = " ({percent:.0f}% without texture, on planes continued from beside them)"
LEFT_OUT = (
    "{percent:.1f}% of the training images' pixels were masked out, in {pictures} of {looked_at} images, since they show something else"
    " than several other images agree on ({seconds:.1f} s of the fit's budget). Test views are scored on all their pixels."
)
NOTHING_LEFT_OUT = "Nothing that moves was found in the {looked_at} training images ({seconds:.1f} s of the fit's budget)."
SEES = {
    "none": "colours do not depend on the direction of view",
    "low": "colours depend on the direction of view in first order",
    "full": "colours depend on the direction of view",
}
POSES = ("source", "registered", "total", "models", "missing", "seconds", "agreement", "metric", "scaling")
OWN = {"facts.json", "index.json"}  # what only Fieldfuse reads: of the exports, and of a page's parts
OPENED = {".html", ".ply", ".spz", ".obj", ".glb", ".usdz", ".las", ".laz", ".e57", ".mp4", ".txt", ".json"}
NO_TEST_VIEWS = "no image was held out, so there are no scores; give --holdout 8 to keep every 8th image for testing"


def base_data(job: Job, capture: Capture, poses: PoseResult) -> dict[str, Any]:
    return {
        "version": __version__,
        "command": command_line(),
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "source": str(job.source),
        "capture": describe_capture(capture),
        "poses": {
            **{name: getattr(poses, name) for name in POSES},
            "georeference": None if poses.georeference is None else poses.georeference.to_dict(),
        },
        "stages": job.stages.summary(),
        "settings": settings_dict(job.settings),
        "machine": {"python": platform.python_version(), "system": platform.platform(), "device": job.settings.device},
    }


def summarise_poses(job: Job, capture: Capture, poses: PoseResult) -> dict[str, Any]:
    """Cameras written for other programs, and what was found."""
    posed, points = poses.apply(capture), poses.points
    if points is None or not len(points):  # programs that start from points need some
        points = find_cloud(posed, job.progress).points
        points = points[thinned(points)]
    put_cameras(job.folder / "exports" / "cameras", posed, points)
    if poses.georeference is not None:
        write_georeference(job.folder / "exports", poses.georeference)
    data = base_data(job, capture, poses)
    return {**data, "warnings": unique([*capture.warnings, *poses.warnings]), "exports": [{"path": "exports/cameras/transforms.json"}]}


def unique(texts: list[str]) -> list[str]:
    return list(dict.fromkeys(texts))


def warnings_of(job: Job, ready: Prepared, fitted: Fitted | None = None) -> list[str]:
    """Everything that a reader of the numbers has to be aware of."""
    poses = ready.poses
    moved = [*(refined_cameras(ready) if poses.source == "given" else []), *depth_offset(ready)]
    notes = [] if fitted is None else fitted.notes
    texts = [*ready.capture.warnings, *poses.warnings, *effects_warnings(job), *moved, *ready.scene.warnings, *notes]
    if not np.any(ready.views.test):
        texts.append(NO_TEST_VIEWS)
    elif poses.source == "sfm":
        texts.append(SEEN_BY_SFM)
    if not job.settings.fit.finetune:
        texts.append("the field is the networks' own (direct inference); nothing was fitted, and fieldfuse finetune goes on from here")
    texts += [
        f"the stage {name!r} was stopped early on request; run the same command again to do it in full" for name in job.stages.stopped()
    ]
    return unique(texts)


def describe_matching(matched: dict[str, Any]) -> str:
    """A sentence about what the fit's quick matching found."""
    bare = matched.get("bare", 0.0)
    words = BARE.format(percent=100 * bare) if bare >= 0.005 else ""
    return MATCHED.format(**{**matched, "percent": 100 * matched["share"], "bare": words})


def describe_left_out(left_out: LeftOut) -> str:
    """A sentence about what moves."""
    return (LEFT_OUT if left_out.masks else NOTHING_LEFT_OUT).format(**left_out.to_dict(), percent=100 * left_out.share)


def describe_field(fitted: Fitted) -> dict[str, Any]:
    """The report's part `field`; the voxel size is in working units."""
    found = {name: getattr(fitted.field, name) for name in ("voxel_size", "blocks", "voxels", "bytes", "resolution")}
    if fitted.matched is not None:
        found["matched"] = fitted.matched
    if fitted.left_out is not None:
        found["left_out"] = fitted.left_out.to_dict()
    return found


def exported_files(job: Job) -> list[dict[str, Any]]:
    """Files that other programs can open, as they stand in the records of the stages."""
    records = [job.stages.records[name] for name in job.stages.done("tsdf", TSDF_TEXTURE, SPLATS, "export")]
    return [
        {"path": path, "bytes": size}
        for record in records
        for path, size in record.outputs.items()
        if path.startswith(("exports/", "tsdf/", "mesh")) and Path(path).suffix in OPENED and Path(path).name not in OWN
    ]


@dataclass
class Results:
    """What a run made: renders of the held-out views by method, the field, the facts of the exports, scores by method."""

    plan: TotalBudget | None = None
    pictures: dict[str, Pictures] = field(default_factory=dict)
    fitted: Fitted | None = None
    exported: dict[str, Any] | None = None
    scores: dict[str, Any] = field(default_factory=dict)


def put_report(job: Job, ready: Prepared, results: Results, seconds: float) -> dict[str, Any]:
    """Write report.json and report.html; `seconds` is what this command took so far, reused stages count as they took."""
    began, plan, scene, views = time.monotonic(), results.plan, ready.scene, ready.views
    budget = None if plan is None else plan.report(job)
    fitted, exported, scores = results.fitted, results.exported, results.scores
    left_out = None if fitted is None else fitted.left_out
    notes = [] if fitted is None or fitted.matched is None else [describe_matching(fitted.matched)]
    if left_out is not None:
        notes.append(describe_left_out(left_out))
    data = {
        **base_data(job, ready.capture, ready.poses),
        "warnings": warnings_of(job, ready, fitted) + (exported["notes"] if exported else []),
        "scene": scene.to_dict(),
        "effects": effects_part(job, None if fitted is None else fitted.field.space.shell > 0),
        "views": {
            "total": len(views),
            "test": int(np.sum(views.test)),
            "width": views.intrinsics[0].width,
            "height": views.intrinsics[0].height,
            "depth_step": depth_step(scene),
        },
        "field": None if fitted is None else describe_field(fitted),
        "notes": notes,
        "evaluation": {name: scores.get(name) for name in ("field", "tsdf", *(name for name in ("network", "splats") if name in scores))},
        "baseline": scores.get("nearest_image"),
        "timeline": [] if fitted is None else fitted.timeline,
        "exports": exported_files(job),
        "export_facts": exported,
        "seconds_total": round(seconds + job.stages.reused_seconds(), 3),
    }
    data["warnings"] = unique([*failures(report_data(data)), *data["warnings"]])
    if plan is not None and budget is not None:
        data |= {"budget": budget, "notes": [plan.note(budget), *notes]}
    shown = {name: [*found.pictures] for name, found in results.pictures.items()}
    unit = "m" if scene.metric else "units"
    tiles = replace(method_pictures(views, np.flatnonzero(views.test), shown, unit), moving=moving_pictures(views, left_out))
    from fieldfuse.evaluation.report_page import write_report  # the template engine and the plots are needed only here

    write_report(job.folder.path, data, tiles)
    if plan is not None:
        data["budget"] = plan.finish(job, time.monotonic() - began)
        write_json(job.folder / "report.json", report_data(data, job.folder.path))
    return report_data(data, job.folder.path)


def effects_part(job: Job, background: bool | None) -> dict[str, Any] | None:
    """The report's part `effects`: decisions without the corrections' many numbers; None when nothing was looked for."""
    if "effects" not in job.stages.records:
        return None
    data = read_checked(job.folder / EFFECTS_FILE, Effects)
    effects, view = data["effects"], job.settings.field.view
    for entry in effects:
        if entry["effect"] == "view_dependence" and view != "auto":
            entry["on"] = view != "none"
            entry["note"] = f"{SEES[view]}: field.view={view}"
        if entry["effect"] == "background" and background is not None:
            entry["on"] = background
            entry["note"] = "space beyond the region of interest is modelled" if background else "nothing beyond the region is modelled"
    dimmed = (data.get("corrections") or {}).get("dimmed", 1.0)
    return {"effects": effects, "seconds": data["seconds"], "looked_at": data["looked_at"], "dimmed": dimmed}


def refined_cameras(ready: Prepared) -> list[str]:
    """How far poses that came with the capture were refined by what images and depth show: what is exported lies with the refined ones."""
    corrections, capture = ready.corrections, ready.capture
    given = {frame.name: frame.world_from_camera for frame in capture.frames if frame.world_from_camera is not None}
    names = [name for name in corrections.poses if name in given]
    if not names:
        return []
    length, turn = _apart(capture, np.stack([given[name] for name in names]), np.stack([corrections.poses[name] for name in names]))
    if length[:4] in ("0.0 ", "0 of") and turn == "0.00°":
        return []
    unregistered = capture.has_depth and corrections.depth is None and not corrections.by_depth
    depth = "; a sensor's depth that is not registered with the colours fits those better" if unregistered else ""
    return [
        f"the poses that came with the capture were refined by its pictures{' and depth' if corrections.by_depth else ''}: cameras moved by"
        f" {length} and turned by {turn} in the median, and surfaces lie with them; --set effects.off=[poses] keeps the poses as they came"
        f"{depth}"
    ]


def depth_offset(ready: Prepared) -> list[str]:
    """How far the depth camera stands from the images', where depth is reprojected from the one to the other."""
    if ready.corrections.depth is None:
        return []
    length, turn = _apart(ready.capture, np.eye(4)[None], ready.corrections.depth[None])
    return [
        f"the depth camera was found to stand {length} beside the pictures' and to be turned by {turn}, and its depth is carried over;"
        " --set effects.off=[depth_offset] uses depth as it came"
    ]


def _apart(capture: Capture, some: Array, others: Array) -> tuple[str, str]:
    """How far poses (N, 4, 4) lie from others in the median, and how far they are turned, in words."""
    way, turn = apart(some, others)
    length = f"{100 * np.median(way):.1f} cm" if capture.metric else f"{np.median(way):.3g} of the capture's units"
    return length, f"{np.median(turn):.2f}°"


def effects_warnings(job: Job) -> list[str]:
    """What a user has to be aware of: effects that are there and cannot be corrected."""
    part = effects_part(job, None)
    if part is None:
        return []
    shown = {
        "rolling_shutter": "the pictures' rows were read one after the other while the camera moved",
        "motion_blur": "some pictures are blurred",
    }
    return [
        f"{shown[entry['effect']]}: {entry['reason']}"
        for entry in part["effects"]
        if entry["there"] and not entry["on"] and entry["effect"] in shown and entry["wish"] != "off"
    ]
