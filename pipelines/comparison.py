"""The page of `fieldfuse compare`: what was measured, pictures of the test views and of the meshes, in compare.html and compare.json."""

from __future__ import annotations

import os
import platform
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from fieldfuse.pipelines.fields import DIRECT
from fieldfuse.pipelines.job import Job
from fieldfuse.pipelines.steps_compare import Compared, common_voxel, depths_of_test_views, working_meshes
from fieldfuse.pipelines.summary import base_data, warnings_of

if TYPE_CHECKING:
    from fieldfuse.camera import Array
    from fieldfuse.evaluation.compare_meshes import MeshPictures

SHOWN_VIEWS = 8
DEPTH_ERROR_TOP = 0.05  # share of the median depth that gets the brightest colour of a depth error
LITTLE_DEPTH = 0.3  # share of the pixels
MESH_SIDE = 480  # pixels of a mesh picture's long side
TITLES = {
    "field": "Field",
    "direct": "Field, not fitted",
    "tsdf": "TSDF",
    "tsdf_stereo": "TSDF of matched pictures",
    "tsdf_exact": "TSDF of exact depth",
}
NOTES = {
    "direct": "by the networks alone",
    "tsdf": "depth of the sensor",
    "tsdf_stereo": "depth by matching",
    "tsdf_exact": "perfect depth",
}
OWN_STAGES = {"field": ("field", "render"), "direct": ("network", "direct"), "tsdf_stereo": ("stereo", "tsdf_stereo")}
KEPT = {"field": "field.safetensors", "direct": DIRECT}


def put_comparison(
    job: Job, all_of_it: Compared, found: dict[str, Any], mesh_facts: dict[str, Any] | None, seconds: float
) -> dict[str, Any]:
    """Write compare.json and compare.html; answers the former."""
    from fieldfuse.evaluation.compare import compare_data
    from fieldfuse.evaluation.compare_page import write_comparison
    from fieldfuse.evaluation.pictures import method_pictures

    views, scene = all_of_it.ready.views, all_of_it.ready.scene
    exact = depths_of_test_views(all_of_it)
    indices = np.flatnonzero(views.test)
    if exact is not None:
        depths: list[Array | None] = [None] * len(views)
        for index, depth in zip(indices, exact, strict=True):
            depths[index] = depth
        views = replace(views, depths=depths)
    scale = next((score["depth_scale"] for score in found["scores"].values() if score["depth_scale"] is not None), None)
    top = None if scale is None else DEPTH_ERROR_TOP * scale
    data = {
        **base_data(job, all_of_it.ready.capture, all_of_it.ready.poses),
        "warnings": [*warnings_of(job, all_of_it.ready, all_of_it.fitted), *little_depth(all_of_it)],
        "scene": scene.to_dict(),
        "truth": {
            "mesh": found["geometry"] is not None,
            "depth": "exact" if exact is not None else "sensor" if scale is not None else None,
            "seen_share": found["seen_share"],
            "unit": "m" if scene.metric else "input units",
        },
        "methods": [describe_method(job, all_of_it, name, found, mesh_facts) for name in all_of_it.pictures],
        "matching": found["matching"],
        "machine": machine(job),
        "seconds_total": round(seconds + job.stages.reused_seconds(), 3),
    }
    shown = {name: pictures.pictures for name, pictures in all_of_it.pictures.items()}
    tiles = method_pictures(views, indices, shown, "m" if scene.metric else "units", SHOWN_VIEWS, top)
    write_comparison(job.folder.path, data, tiles, shown_meshes(job, all_of_it), top)
    return compare_data(data)


def little_depth(all_of_it: Compared) -> list[str]:
    """A warning when matching found depth for few pixels."""
    matched = all_of_it.pictures.get("tsdf_stereo")
    share = None if matched is None else matched.facts.get("depth_share")
    if share is None or share >= LITTLE_DEPTH:
        return []
    return [
        f"matching the pictures gave depth for {100 * share:.0f}% of their pixels only: they show little texture, or their poses do not fit"
        " them; --poses sfm finds others"
    ]


def describe_method(job: Job, all_of_it: Compared, name: str, found: dict[str, Any], mesh_facts: dict[str, Any] | None) -> dict[str, Any]:
    """One of the comparison's `methods`."""
    stages = {stage["name"]: stage for stage in job.stages.summary()}
    own = OWN_STAGES.get(name, (name,))
    note = NOTES.get(name, "")
    if name == "field":
        matched, note = depth_in_fit(job, all_of_it)
        own = (*matched, *own)
    path = job.folder / KEPT.get(name, f"{name}/mesh.ply")
    facts = all_of_it.pictures[name].facts
    return {
        "key": name,
        "title": TITLES[name],
        "note": note,
        "reference": name == "tsdf_exact",
        "stages": [stages[stage] for stage in own if stage in stages],
        "mesh_seconds": stages["export"]["seconds"] if name == "field" else None,
        "disk_bytes": path.stat().st_size if path.is_file() else None,
        "memory_bytes": all_of_it.fitted.field.bytes if name == "field" else facts.get("bytes"),
        "score": found["scores"].get(name),
        "geometry": (found["geometry"] or {}).get(name),
        "mesh": mesh_facts if name == "field" else facts.get("mesh"),
    }


def depth_in_fit(job: Job, all_of_it: Compared) -> tuple[tuple[str, ...], str]:
    """The stages before the fit that its depth comes from, and the words for it."""
    fit = job.settings.fit
    if "stereo" in job.stages.records["field"].after:
        return ("stereo",), "fitted to colours and matched depth"
    if fit.finetune and fit.depth > 0 and fit.depth_from != "off" and any(depth is not None for depth in all_of_it.ready.views.depths):
        return (), "fitted to colours and the sensor's depth"
    if all_of_it.fitted.matched is not None:
        return (), "fitted to colours and depth by quick matching"
    return (), ""


def shown_meshes(job: Job, all_of_it: Compared) -> list[MeshPictures]:
    """Pictures of the meshes from outside, and from a test view."""
    from fieldfuse.evaluation.compare_meshes import cut_box, from_outside, mesh_pictures
    from fieldfuse.export.field_surface import at_most

    meshes, truth = working_meshes(job, all_of_it)
    if not meshes:
        return []
    views, scene, voxel = all_of_it.ready.views, all_of_it.ready.scene, common_voxel(all_of_it)
    outside = ("Seen from outside", *from_outside(scene.centre, scene.half_size, views.world_from_camera, MESH_SIDE, 3 * MESH_SIDE // 4))
    out = mesh_pictures(meshes, truth, [outside], voxel, cut_box(scene.centre, scene.half_size))
    test = np.flatnonzero(views.test)
    if len(test):
        index = int(test[len(test) // 2])
        inside = (f"Seen from {views.names[index]}", at_most(views.intrinsics[index], MESH_SIDE), views.world_from_camera[index])
        out += mesh_pictures(meshes, truth, [inside], voxel)
    return out


def machine(job: Job) -> dict[str, Any]:
    """What the times were measured on; a load above the cores means that they are upper bounds."""
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    return {
        "system": platform.platform(),
        "cores": os.cpu_count(),
        "threads": job.settings.threads or os.cpu_count(),
        "device": job.settings.device,
        "load": None if load is None else round(load, 2),
        "measured": time.strftime("%Y-%m-%d %H:%M"),
    }
