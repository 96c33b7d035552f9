"""What a run found, gathered for `report.json`, `report.html` and the terminal."""

from __future__ import annotations

import platform
import time
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fieldfuse import __version__
from fieldfuse.config import settings_dict
from fieldfuse.files import write_json
from fieldfuse.pipelines.fit_files import fit_left_out, fit_matched, fit_notes
from fieldfuse.pipelines.folder import command_line
from fieldfuse.pipelines.job import Job
from fieldfuse.pipelines.rendered import Pictures, depth_step
from fieldfuse.pipelines.steps_effects import effects_part, effects_warnings, moved_cameras, moved_depth
from fieldfuse.pipelines.textured import TSDF_TEXTURE

if TYPE_CHECKING:
    from fieldfuse.camera import Array
    from fieldfuse.capture.types import Capture, Views
    from fieldfuse.poses.result import PoseResult
    from fieldfuse.poses.scene import Scene
    from fieldfuse.render.field import Field
    from fieldfuse.stereo.transients import LeftOut

SEEN_BY_SFM = (
    "poses were estimated from all images, the held-out ones included, so scores are slightly optimistic"
)
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
OPENED = {".html", ".ply", ".obj", ".glb", ".mp4", ".txt", ".json"}
NO_TEST_VIEWS = "no image was held out, so there are no scores; give --holdout 8 to keep every 8th image for testing"


def picture_size(capture: Capture) -> tuple[int | None, int | None]:
    """Width and height of the capture's first picture, as its header says."""
    first = capture.frames[0]
    if first.intrinsics is not None:
        return first.intrinsics.width, first.intrinsics.height
    if capture.kind == "video":
        return capture.extra.get("width"), capture.extra.get("height")
    from fieldfuse.capture.headers import read_bytes, read_header

    header = read_header(read_bytes(first.image), first.image)
    turned = header.orientation >= 5  # EXIF: the stored picture lies on its side
    return (header.height, header.width) if turned else (header.width, header.height)


def describe_capture(capture: Capture) -> dict[str, Any]:
    """The report's part `capture`."""
    width, height = picture_size(capture)
    return {
        "kind": capture.kind,
        "frames": len(capture.frames),
        "width": width,
        "height": height,
        "posed": capture.posed,
        "depth": sum(frame.depth is not None for frame in capture.frames),
        "masks": sum(frame.mask is not None for frame in capture.frames),
        "metric": capture.metric,
        "extra": capture.extra,
    }


def describe_poses(poses: PoseResult) -> dict[str, Any]:
    """The report's part `poses`."""
    return {
        "source": poses.source,
        "registered": poses.registered,
        "total": poses.total,
        "models": poses.models,
        "missing": poses.missing,
        "seconds": poses.seconds,
        "agreement": poses.agreement,
    }


def base_data(job: Job, capture: Capture, poses: PoseResult) -> dict[str, Any]:
    return {
        "version": __version__,
        "command": command_line(),
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "source": str(job.source),
        "capture": describe_capture(capture),
        "poses": describe_poses(poses),
        "stages": job.stages.summary(),
        "settings": settings_dict(job.settings),
        "machine": {"python": platform.python_version(), "system": platform.platform(), "device": job.settings.device},
    }


def summarise_poses(job: Job, capture: Capture, poses: PoseResult) -> dict[str, Any]:
    """Cameras written for other programs, and what was found."""
    put_cameras(job.folder / "exports" / "cameras", poses, poses.apply(capture))
    data = base_data(job, capture, poses)
    return {**data, "warnings": unique([*capture.warnings, *poses.warnings]), "exports": [{"path": "exports/cameras/transforms.json"}]}


def put_cameras(
    folder: Path, poses: PoseResult, posed: Capture, points: Array | None = None, colours: Array | None = None
) -> None:
    """Cameras as transforms.json and COLMAP text, to be put into the capture's folder: for the pictures as they lie there.

    Args:
        points, colours: (P, 3) of a surface in the input's frame, for poses that came without points: programs that start from points
            need some.
    """
    from fieldfuse.capture.convert import all_converted
    from fieldfuse.capture.select import SELECTED
    from fieldfuse.capture.stored import stored_cameras
    from fieldfuse.export.cameras import write_cameras

    made_here = SELECTED in posed.extra or all_converted(posed)  # then the pictures lie in the run's folder
    root = posed.frames[0].image.parent.parent if made_here else posed.root
    # A capture that is reached through a link has its images where the link leads.
    bases = (root, root.resolve())
    paths = [frame.image for frame in posed.frames]
    files = [next((path.relative_to(base).as_posix() for base in bases if path.is_relative_to(base)), str(path)) for path in paths]
    # Those of the frames that take part, which may be fewer than have a pose.
    intrinsics, world_from_camera = stored_cameras(posed)
    if poses.points is not None and len(poses.points):
        points, colours = poses.points, None
    write_cameras(folder, files, intrinsics, world_from_camera, points, colours)


def unique(texts: list[str]) -> list[str]:
    return list(dict.fromkeys(texts))


def warnings_of(job: Job, capture: Capture, poses: PoseResult, scene: Scene, views: Views) -> list[str]:
    """Everything that a reader of the numbers has to know."""
    moved = moved_cameras(job, capture) if poses.source == "given" else []
    moved += moved_depth(job, capture)
    texts = [*capture.warnings, *poses.warnings, *effects_warnings(job), *moved, *scene.warnings, *fit_notes(job)]
    if not np.any(views.test):
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
    told = left_out.to_dict()
    return (LEFT_OUT if left_out.masks else NOTHING_LEFT_OUT).format(**told, percent=100 * left_out.share)


def describe_field(
    field: Field | None, matched: dict[str, Any] | None = None, left_out: LeftOut | None = None
) -> dict[str, Any] | None:
    """The report's part `field`; the voxel size is in working units. `matched` is what the fit's quick matching found, `left_out` what
    it did without."""
    if field is None:
        return None
    return {
        "voxel_size": field.voxel_size,
        "blocks": field.blocks,
        "voxels": field.voxels,
        "bytes": field.bytes,
        "resolution": field.resolution,
        **({"matched": matched} if matched is not None else {}),
        **({"left_out": left_out.to_dict()} if left_out is not None else {}),
    }


def exported_files(job: Job) -> list[dict[str, Any]]:
    """Files that other programs can open, as they stand in the records of the stages."""
    out = []
    for name in ("tsdf", TSDF_TEXTURE, "export"):
        record = job.stages.records.get(name)
        out += [{"path": path, "bytes": size} for path, size in (record.outputs if record else {}).items() if is_export(path)]
    return out


def is_export(path: str) -> bool:
    """True for what other programs open."""
    return path.startswith(("exports/", "tsdf/", "mesh")) and Path(path).suffix in OPENED and not path.endswith("facts.json")


def put_report(
    job: Job,
    capture: Capture,
    poses: PoseResult,
    scene: Scene,
    views: Views,
    field: Field | None,
    timeline: list[dict[str, Any]],
    pictures: dict[str, Pictures],
    scores: dict[str, Any],
    export_facts: dict[str, Any] | None,
    seconds: float,
) -> dict[str, Any]:
    """Write report.json and report.html; `seconds` is what this command took so far, reused stages count as they took."""
    from fieldfuse.evaluation.failure import failures
    from fieldfuse.evaluation.pictures import method_pictures, moving_pictures
    from fieldfuse.evaluation.report import report_data, write_report

    notes = export_facts["notes"] if export_facts else []
    began, told = time.monotonic(), None if job.plan is None else job.plan.told(job)
    matched = None if field is None else fit_matched(job)
    left_out = None if field is None else fit_left_out(job)
    data = {
        **base_data(job, capture, poses),
        "warnings": warnings_of(job, capture, poses, scene, views) + notes,
        "scene": scene.to_dict(),
        "effects": effects_part(job, None if field is None else field.space.shell > 0),
        "views": {
            "total": len(views),
            "test": int(np.sum(views.test)),
            "width": views.intrinsics[0].width,
            "height": views.intrinsics[0].height,
            "depth_step": depth_step(scene),
        },
        "field": describe_field(field, matched, left_out),
        "notes": [
            *([] if matched is None else [describe_matching(matched)]),
            *([] if left_out is None else [describe_left_out(left_out)]),
        ],
        "evaluation": {name: scores.get(name) for name in ("field", "tsdf", *(["network"] if "network" in scores else []))},
        "baseline": scores.get("nearest_image"),
        "timeline": timeline,
        "exports": exported_files(job),
        "export_facts": export_facts,
        "seconds_total": round(seconds + job.stages.fresh_seconds(), 3),
    }
    data["warnings"] = unique([*failures(report_data(data)), *data["warnings"]])
    if job.plan is not None and told is not None:
        data |= {"budget": told, "notes": [job.plan.note(told), *data["notes"]]}
    shown = {name: [*found.pictures] for name, found in pictures.items()}
    unit = "m" if scene.metric else "units"
    tiles = replace(method_pictures(views, np.flatnonzero(views.test), shown, unit), moving=moving_pictures(views, left_out))
    write_report(job.folder.path, data, tiles)
    if job.plan is not None:
        data["budget"] = job.plan.finish(job, time.monotonic() - began)
        write_json(job.folder / "report.json", report_data(data, job.folder.path))
    return report_data(data, job.folder.path)
