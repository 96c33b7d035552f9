"""What `fieldfuse compare` makes, measures and shows: all methods on the same pixels, and their meshes against the truth."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fieldfuse.errors import InputError
from fieldfuse.files import write_json
from fieldfuse.memory import require_meshes, require_scores
from fieldfuse.pipelines.console import ConsoleProgress
from fieldfuse.pipelines.exports import Wish, export_results
from fieldfuse.pipelines.fields import (
    DIRECT,
    Fitted,
    fit_radiance_field,
    make_network_field,
    render_network_views,
    render_test_views,
    starting_field,
)
from fieldfuse.pipelines.job import Job, open_job
from fieldfuse.pipelines.options import Place
from fieldfuse.pipelines.prepare import Prepared, prepare
from fieldfuse.pipelines.reconstruct import FOR_FIELD, RESULTS
from fieldfuse.pipelines.rendered import Pictures
from fieldfuse.pipelines.schemas import CompareScores, read_checked
from fieldfuse.pipelines.stages import BEFORE, Stage
from fieldfuse.pipelines.summary import base_data, warnings_of
from fieldfuse.pipelines.surfaces import fuse_tsdf, match_images

if TYPE_CHECKING:
    from fieldfuse.camera import Array
    from fieldfuse.capture.types import Capture
    from fieldfuse.evaluation.compare_meshes import MeshPictures
    from fieldfuse.evaluation.compare_truth import GroundTruth
    from fieldfuse.tsdf.mesh import Mesh

SURFACES = {"sensor": "tsdf", "matching": "tsdf_stereo", "exact": "tsdf_exact"}  # where depth comes from → stage and folder
SHOWN_VIEWS = 8
DEPTH_ERROR_TOP = 0.05  # share of the median depth that gets the brightest colour of a depth error
LITTLE_DEPTH = 0.3  # share of the pixels
MESH_SIDE = 480  # pixels of a mesh picture's long side
# Method → title, and the words below it.
TITLES = {
    "field": ("Field", ""),
    "direct": ("Field, not fitted", "by the networks alone"),
    "tsdf": ("TSDF", "depth of the sensor"),
    "tsdf_stereo": ("TSDF of matched pictures", "depth by matching"),
    "tsdf_exact": ("TSDF of exact depth", "perfect depth"),
}
OWN_STAGES = {"field": ("field", "render"), "direct": ("network", "direct"), "tsdf_stereo": ("stereo", "tsdf_stereo")}
FILES = {"field": "field.safetensors", "direct": DIRECT}


@dataclass(frozen=True)
class Compared:
    """Everything that the page is made of."""

    job: Job
    ready: Prepared
    fitted: Fitted
    renders: dict[str, Pictures]  # by method, the field first
    truth: GroundTruth | None

    def exact_depths(self, indices: Array) -> list[Array | None] | None:
        """The exact depth of the views at `indices`, None when the capture brings none."""
        from fieldfuse.evaluation.compare_truth import true_depths

        if self.truth is None or not self.truth.depths:
            return None
        return true_depths(self.truth, self.ready.posed, self.ready.views, indices, self.ready.scene.working_from_input.scale)

    def mesh_files(self) -> dict[str, Path]:
        """The meshes that there are, in the input's frame."""
        files = {name: self.job.folder / ("mesh.ply" if name == "field" else f"{name}/mesh.ply") for name in self.renders}
        return {name: path for name, path in files.items() if path.is_file()}

    def meshes(self) -> tuple[dict[str, Mesh], Mesh | None]:
        """The methods' meshes that have triangles, and the true one, in the working frame."""
        from fieldfuse.evaluation.geometry import read_mesh

        meshes = {}
        for name, path in self.mesh_files().items():
            try:
                meshes[name] = read_mesh(path).transformed(self.ready.scene.working_from_input)
            except InputError:  # an empty surface is a result, too
                continue
        true = None if self.truth is None else self.truth.mesh
        return meshes, None if true is None else read_mesh(true).transformed(self.ready.scene.working_from_input)

    def voxel(self) -> float:
        """The voxel that distances are counted in, working units: that of the surface made of the best depth."""
        return float(next(self.renders[name].facts for name in ("tsdf_exact", "tsdf", "tsdf_stereo") if name in self.renders)["voxel_size"])


def compare_run(place: Place, options: dict[str, Any], depth: str, progress: ConsoleProgress) -> dict[str, Any]:
    """Make what is missing and write the comparison; answers `compare.json`.

    Raises:
        InputError: no test views, or depth that the capture does not bring.
    """
    from fieldfuse.evaluation.compare_truth import find_truth
    from fieldfuse.steps import network_weights

    start = time.monotonic()
    with open_job(place, options, progress, (*BEFORE, *FOR_FIELD, *RESULTS, *SURFACES.values())) as job:
        ready, settings = prepare(job), job.settings
        if not ready.views.test.any():
            raise InputError("a comparison needs images that were kept for testing; give --holdout 8")
        truth = find_truth(ready.posed) if ready.poses.source == "given" else None
        surfaces = {SURFACES[kind]: kind for kind in choose_surfaces(depth, ready.posed, truth)}
        fused = {name: fuse_tsdf(job, ready, name, kind) for name, kind in surfaces.items()}
        network = starting_field(job, ready)
        fitted = fit_radiance_field(job, ready, network)
        renders = {"field": render_test_views(job, ready, fitted.field)}
        # The networks' field without any fitting is a method of its own, where it is wanted and is not the field itself.
        if settings.field.init != "classical" and settings.fit.finetune and network_weights(settings).is_file():
            renders["direct"] = render_network_views(job, ready, network or make_network_field(job, ready), keep=True)
        facts = export_results(job, ready, fitted, Wish())
        it = Compared(job, ready, fitted, renders | fused, truth)
        return put_comparison(it, measure(it), facts.get("mesh"), start)


def choose_surfaces(wanted: str, posed: Capture, truth: GroundTruth | None) -> list[str]:
    """Which depth the TSDF surfaces are made of, from `--depth`.

    `auto`: the sensor's, else by matching; where the truth is known all that there is, so that the field stands between what real depth
    gives and what perfect depth would.

    Raises:
        InputError: an unknown name, or depth that the capture does not bring.
    """
    there = {"sensor": posed.has_depth, "matching": True, "exact": truth is not None and bool(truth.depths)}
    if wanted == "auto":
        return [kind for kind in SURFACES if there[kind]] if there["exact"] else ["sensor" if posed.has_depth else "matching"]
    names = [name.strip() for name in wanted.split(",") if name.strip()]
    if not names or any(name not in SURFACES for name in names):
        raise InputError(f"--depth is {wanted!r}; it must be auto, or of {', '.join(SURFACES)} one or more, separated by commas")
    for name in names:
        if not there[name]:
            raise InputError(f"{posed.root} brings no {name} depth; leave it out of --depth, or use --depth matching")
    return [kind for kind in SURFACES if kind in names]


# ------------------------------------------------------------------------------------------------- what is measured


def measure(it: Compared) -> dict[str, Any]:
    """The stage `compare`: scores, and geometry where there is a true mesh."""
    path = it.job.folder / "compare" / "scores.json"

    def save(value: dict[str, Any]) -> list[Path]:
        write_json(path, value)
        return [path]

    return it.job.run(
        Stage(
            "compare",
            make=lambda: {"scores": score_methods(it), **measure_meshes(it), "matching": measure_matching(it)},
            save=save,
            load=lambda: read_checked(path, CompareScores),
            inputs=["views", "render", "export", *(name for name in it.renders if name != "field")],
            settings=list(it.renders),
        )
    )


def score_methods(it: Compared) -> dict[str, Any]:
    """Method → scores, against the exact depth when the capture brings it, else against the sensor's."""
    from fieldfuse.evaluation.report import plain
    from fieldfuse.evaluation.score import compare_views

    require_scores(it.ready.views, len(it.renders))
    it.job.progress.update(0, 2, "pictures")
    indices, renders = np.flatnonzero(it.ready.views.test), {name: shown.pictures for name, shown in it.renders.items()}
    seconds = {name: shown.seconds for name, shown in it.renders.items()}
    scores: dict[str, Any] = plain(compare_views(renders, it.ready.views, indices, seconds, it.exact_depths(indices)))
    return scores


def measure_matching(it: Compared) -> dict[str, Any] | None:
    """How good the depth by matching of the training views is, against the exact depth or the sensor's; None without either."""
    from fieldfuse.evaluation.score import matched_depth_scores

    if "tsdf_stereo" not in it.renders:
        return None
    training = np.flatnonzero(~it.ready.views.test)
    views = it.ready.training
    known = it.exact_depths(training) or views.depths
    return matched_depth_scores(views, match_images(it.job, it.ready), known) if known else None


def measure_meshes(it: Compared) -> dict[str, Any]:
    """`geometry` by method in the input's unit, and `seen_share` of the true surface; both None without a true mesh."""
    from fieldfuse.evaluation.geometry import geometry_metrics, seen_surface
    from fieldfuse.tsdf.mesh import Mesh

    it.job.progress.update(1, 2, "meshes")
    true = None if it.truth is None else it.truth.mesh
    require_meshes([*it.mesh_files().values(), *([] if true is None else [true])])
    meshes, truth = it.meshes()
    if truth is None:
        return {"geometry": None, "seen_share": None}
    views, scene, voxel, scale = it.ready.views, it.ready.scene, it.voxel(), it.ready.scene.working_from_input.scale
    training = np.flatnonzero(~views.test)
    region = (scene.centre - scene.half_size, scene.centre + scene.half_size)
    lenses = [views.intrinsics[index] for index in training]
    wanted, share = seen_surface(truth, lenses, views.world_from_camera[training], voxel, region)
    out = {}
    for name in it.mesh_files():  # not of direct inference, nor of a field that is not exported as a mesh
        found = geometry_metrics(meshes.get(name, Mesh.empty()), truth, wanted, voxel, region)
        lengths = {key: value / scale for key, value in found.items() if key.startswith(("accuracy", "completeness", "voxel")) and value}
        out[name] = {**found, **lengths}
    return {"geometry": out, "seen_share": share}


# ------------------------------------------------------------------------------------------------- what is shown


def put_comparison(it: Compared, found: dict[str, Any], mesh_facts: dict[str, Any] | None, start: float) -> dict[str, Any]:
    """Write compare.json and compare.html; answers the former. `start`: of the command, by the monotonic clock."""
    from fieldfuse.evaluation.compare import compare_data
    from fieldfuse.evaluation.compare_page import write_comparison
    from fieldfuse.evaluation.machine import machine
    from fieldfuse.evaluation.pictures import method_pictures

    job, views, scene = it.job, it.ready.views, it.ready.scene
    indices = np.flatnonzero(views.test)
    exact = it.exact_depths(indices)
    if exact is not None:
        depths: list[Array | None] = [None] * len(views)
        for index, depth in zip(indices, exact, strict=True):
            depths[index] = depth
        views = replace(views, depths=depths)
    scale = next((score["depth_scale"] for score in found["scores"].values() if score["depth_scale"] is not None), None)
    top = None if scale is None else DEPTH_ERROR_TOP * scale
    warnings = warnings_of(job, it.ready, it.fitted)
    matched = it.renders.get("tsdf_stereo")
    share = None if matched is None else matched.facts.get("depth_share")
    if share is not None and share < LITTLE_DEPTH:
        warnings = [
            *warnings,
            f"matching the pictures gave depth for {100 * share:.0f}% of their pixels only: they show little texture, or their poses do not"
            " fit them; --poses sfm finds others",
        ]
    data = {
        **base_data(job, it.ready.capture, it.ready.poses),
        "warnings": warnings,
        "scene": scene.to_dict(),
        "truth": {
            "mesh": found["geometry"] is not None,
            "depth": "exact" if exact is not None else "sensor" if scale is not None else None,
            "seen_share": found["seen_share"],
            "unit": "m" if scene.metric else "input units",
        },
        "methods": [describe_method(it, name, found, mesh_facts) for name in it.renders],
        "matching": found["matching"],
        "machine": machine(job.settings.threads, job.settings.device),
        "seconds_total": round(time.monotonic() - start + job.stages.reused_seconds(), 3),
    }
    shown = {name: renders.pictures for name, renders in it.renders.items()}
    tiles = method_pictures(views, indices, shown, "m" if scene.metric else "units", SHOWN_VIEWS, top)
    write_comparison(job.folder.path, data, tiles, shown_meshes(it), top)
    return compare_data(data)


def describe_method(it: Compared, name: str, found: dict[str, Any], mesh_facts: dict[str, Any] | None) -> dict[str, Any]:
    """One of the comparison's `methods`."""
    stages = {stage["name"]: stage for stage in it.job.stages.summary()}
    own, (title, note), is_field = OWN_STAGES.get(name, (name,)), TITLES[name], name == "field"
    if is_field:
        fit = it.job.settings.fit
        if "stereo" in it.job.stages.records["field"].after:
            own, note = ("stereo", *own), "fitted to colours and matched depth"
        elif fit.finetune and fit.depth > 0 and fit.depth_from != "off" and any(depth is not None for depth in it.ready.views.depths):
            note = "fitted to colours and the sensor's depth"
        elif it.fitted.matched is not None:
            note = "fitted to colours and depth by quick matching"
    path, facts = it.job.folder / FILES.get(name, f"{name}/mesh.ply"), it.renders[name].facts
    return {
        "key": name,
        "title": title,
        "note": note,
        "reference": name == "tsdf_exact",
        "stages": [stages[stage] for stage in own if stage in stages],
        "mesh_seconds": stages["export"]["seconds"] if is_field else None,
        "disk_bytes": path.stat().st_size if path.is_file() else None,
        "memory_bytes": it.fitted.field.bytes if is_field else facts.get("bytes"),
        "score": found["scores"].get(name),
        "geometry": (found["geometry"] or {}).get(name),
        "mesh": mesh_facts if is_field else facts.get("mesh"),
    }


def shown_meshes(it: Compared) -> list[MeshPictures]:
    """Pictures of the meshes from outside, and from a test view."""
    from fieldfuse.evaluation.compare_meshes import cut_box, from_outside, mesh_pictures
    from fieldfuse.export.surface import at_most

    meshes, truth = it.meshes()
    if not meshes:
        return []
    views, scene, voxel = it.ready.views, it.ready.scene, it.voxel()
    outside = ("Seen from outside", *from_outside(scene.centre, scene.half_size, views.world_from_camera, MESH_SIDE, 3 * MESH_SIDE // 4))
    test = np.flatnonzero(views.test)
    index = int(test[len(test) // 2])
    inside = (f"Seen from {views.names[index]}", at_most(views.intrinsics[index], MESH_SIDE), views.world_from_camera[index])
    return [
        *mesh_pictures(meshes, truth, [outside], voxel, cut_box(scene.centre, scene.half_size)),
        *mesh_pictures(meshes, truth, [inside], voxel),
    ]
