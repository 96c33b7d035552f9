"""What `fieldfuse compare` measures: scores of all methods on the same pixels, and meshes against the truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fieldfuse.errors import InputError
from fieldfuse.files import write_json
from fieldfuse.memory import require_meshes, require_scores
from fieldfuse.pipelines.job import Job
from fieldfuse.pipelines.rendered import Pictures
from fieldfuse.pipelines.schemas import CompareScores, read_checked
from fieldfuse.pipelines.stages import Stage

if TYPE_CHECKING:
    from fieldfuse.camera import Array
    from fieldfuse.capture.types import Capture
    from fieldfuse.evaluation.compare_truth import GroundTruth
    from fieldfuse.pipelines.fields import Fitted, NetworkField
    from fieldfuse.pipelines.prepare import Prepared
    from fieldfuse.tsdf.mesh import Mesh

SURFACES = {"sensor": "tsdf", "matching": "tsdf_stereo", "exact": "tsdf_exact"}  # where depth comes from → stage and folder


@dataclass(frozen=True)
class Compared:
    """Everything that the page is made of."""

    ready: Prepared
    fitted: Fitted
    pictures: dict[str, Pictures]  # by method, the field first
    truth: GroundTruth | None


def choose_surfaces(wanted: str, posed: Capture, truth: GroundTruth | None) -> list[str]:
    """Which depth the TSDF surfaces are made of, from `--depth`.

    `auto`: the sensor's, else by matching; where the truth is known all that there is, so that the field stands between what real depth
    gives and what perfect depth would.

    Raises:
        InputError: an unknown name, or depth that the capture does not bring.
    """
    there = {"sensor": posed.has_depth, "matching": True, "exact": truth is not None and bool(truth.depths)}
    if wanted == "auto":
        if there["exact"]:
            return [kind for kind in SURFACES if there[kind]]
        return ["sensor" if posed.has_depth else "matching"]
    names = [name.strip() for name in wanted.split(",") if name.strip()]
    unknown = [name for name in names if name not in SURFACES]
    if unknown or not names:
        raise InputError(f"--depth is {wanted!r}; it must be auto, or of {', '.join(SURFACES)} one or more, separated by commas")
    missing = [name for name in names if not there[name]]
    if missing:
        raise InputError(f"{posed.root} brings no {missing[0]} depth; leave it out of --depth, or use --depth matching")
    return [kind for kind in SURFACES if kind in names]


def not_fitted(job: Job, ready: Prepared, network: NetworkField | None) -> dict[str, Pictures]:
    """The networks' field without any fitting, as a method of its own; nothing without weights, where it is not wanted
    (`init=classical`), and where it is the field itself (`--no-finetune`). `network`: where the fit started from it."""
    from fieldfuse.pipelines.fields import make_network_field, render_network_views
    from fieldfuse.steps import network_weights

    settings = job.settings
    if settings.field.init == "classical" or not settings.fit.finetune or not network_weights(settings).is_file():
        return {}
    return {"direct": render_network_views(job, ready, network or make_network_field(job, ready), keep=True)}


def measure(job: Job, all_of_it: Compared) -> dict[str, Any]:
    """The stage `compare`: scores, and geometry where there is a true mesh."""
    path = job.folder / "compare" / "scores.json"

    def save(value: dict[str, Any]) -> list[Path]:
        write_json(path, value)
        return [path]

    return job.run(
        Stage(
            "compare",
            make=lambda: {
                "scores": score_methods(job, all_of_it),
                **measure_meshes(job, all_of_it),
                "matching": measure_matching(job, all_of_it),
            },
            save=save,
            load=lambda: read_checked(path, CompareScores),
            inputs=["views", "render", "export", *(name for name in all_of_it.pictures if name != "field")],
            settings=list(all_of_it.pictures),
        )
    )


def score_methods(job: Job, all_of_it: Compared) -> dict[str, Any]:
    """Method → scores, against the exact depth when the capture brings it, else against the sensor's."""
    from fieldfuse.evaluation.compare_score import compare_views
    from fieldfuse.evaluation.report import plain

    views = all_of_it.ready.views
    indices = np.flatnonzero(views.test)
    require_scores(views, len(all_of_it.pictures))
    pictures = {name: shown.pictures for name, shown in all_of_it.pictures.items()}
    seconds = {name: shown.seconds for name, shown in all_of_it.pictures.items()}
    job.progress.update(0, 2, "pictures")
    scores = plain(compare_views(pictures, views, indices, seconds, depths_of_test_views(all_of_it)))
    assert isinstance(scores, dict)
    return scores


def depths_of_test_views(all_of_it: Compared) -> list[Array | None] | None:
    """The exact depth of the test views; None when the capture brings none."""
    return exact_depths_of(all_of_it, np.flatnonzero(all_of_it.ready.views.test))


def exact_depths_of(all_of_it: Compared, indices: Array) -> list[Array | None] | None:
    """The exact depth of the views at `indices`, None when the capture brings none."""
    from fieldfuse.evaluation.compare_truth import true_depths

    truth, views = all_of_it.truth, all_of_it.ready.views
    if truth is None or not truth.depths:
        return None
    return true_depths(truth, all_of_it.ready.posed, views, indices, all_of_it.ready.scene.working_from_input.scale)


def measure_matching(job: Job, all_of_it: Compared) -> dict[str, Any] | None:
    """How good the depth by matching of the training views is, against the exact depth or the sensor's; None without either."""
    from fieldfuse.evaluation.compare_stereo import matched_depth_scores
    from fieldfuse.pipelines.surfaces import match_images

    if "tsdf_stereo" not in all_of_it.pictures:
        return None
    training = np.flatnonzero(~all_of_it.ready.views.test)
    views = all_of_it.ready.views.subset(training)
    known = exact_depths_of(all_of_it, training) or views.depths
    return matched_depth_scores(views, match_images(job, all_of_it.ready), known) if known else None


def mesh_files(job: Job, methods: Mapping[str, Any]) -> dict[str, Path]:
    """The meshes that there are, in the input's frame."""
    files = {name: job.folder / ("mesh.ply" if name == "field" else f"{name}/mesh.ply") for name in methods}
    return {name: path for name, path in files.items() if path.is_file()}


def working_meshes(job: Job, all_of_it: Compared) -> tuple[dict[str, Mesh], Mesh | None]:
    """The methods' meshes that have triangles, and the true one, in the working frame."""
    from fieldfuse.evaluation.geometry import read_mesh

    to_working = all_of_it.ready.scene.working_from_input
    meshes = {}
    for name, path in mesh_files(job, all_of_it.pictures).items():
        try:
            meshes[name] = read_mesh(path).transformed(to_working)
        except InputError:  # an empty surface is a result, too
            continue
    truth = all_of_it.truth
    return meshes, None if truth is None or truth.mesh is None else read_mesh(truth.mesh).transformed(to_working)


def common_voxel(all_of_it: Compared) -> float:
    """The voxel that distances are counted in, working units: that of the surface made of the best depth."""
    facts = [all_of_it.pictures[name].facts for name in ("tsdf_exact", "tsdf", "tsdf_stereo") if name in all_of_it.pictures]
    return float(facts[0]["voxel_size"])


def measure_meshes(job: Job, all_of_it: Compared) -> dict[str, Any]:
    """`geometry` by method in the input's unit, and `seen_share` of the true surface; both None without a true mesh."""
    from fieldfuse.evaluation.geometry import geometry_metrics, seen_surface
    from fieldfuse.tsdf.mesh import Mesh

    job.progress.update(1, 2, "meshes")
    true_mesh = None if all_of_it.truth is None else all_of_it.truth.mesh
    require_meshes([*mesh_files(job, all_of_it.pictures).values(), *([true_mesh] if true_mesh is not None else [])])
    meshes, truth = working_meshes(job, all_of_it)
    if truth is None:
        return {"geometry": None, "seen_share": None}
    views, scene = all_of_it.ready.views, all_of_it.ready.scene
    training = np.flatnonzero(~views.test)
    region = (scene.centre - scene.half_size, scene.centre + scene.half_size)
    voxel, scale = common_voxel(all_of_it), scene.working_from_input.scale
    lenses = [views.intrinsics[index] for index in training]
    wanted, share = seen_surface(truth, lenses, views.world_from_camera[training], voxel, region)
    out = {}
    for name in all_of_it.pictures:
        if name == "direct":  # shown and not made into a mesh
            continue
        found = geometry_metrics(meshes.get(name, Mesh.empty()), truth, wanted, voxel, region)
        lengths = {key: value / scale for key, value in found.items() if key.startswith(("accuracy", "completeness", "voxel")) and value}
        out[name] = {**found, **lengths}
    return {"geometry": out, "seen_share": share}
