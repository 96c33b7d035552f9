"""Depth of the training images by matching them with each other (the stage `stereo`), and TSDF surfaces of depth from any source."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fieldfuse.camera import Array, Intrinsics, Similarity
from fieldfuse.capture.types import Views
from fieldfuse.errors import InputError
from fieldfuse.evaluation.compare_truth import find_truth, true_depths
from fieldfuse.export.surface import whole_mesh
from fieldfuse.memory import require_pictures
from fieldfuse.pipelines.job import Job
from fieldfuse.pipelines.prepare import Prepared
from fieldfuse.pipelines.rendered import Picture, Pictures, depth_steps, load_pictures, save_pictures, to_picture, write_pngs
from fieldfuse.pipelines.source import pixel_state
from fieldfuse.pipelines.stages import Stage, StoredStage
from fieldfuse.stereo.fast_mvs import with_depths
from fieldfuse.stereo.maps import load_stereo, save_stereo
from fieldfuse.stereo.match import StereoDepth, stereo_depths
from fieldfuse.stereo.plane_completion import continued
from fieldfuse.tone import exposed

if TYPE_CHECKING:
    from fieldfuse.georeference import Georeference
    from fieldfuse.tsdf.mesh import Mesh
    from fieldfuse.tsdf.volume import Points, TsdfVolume


def match_images(job: Job, ready: Prepared) -> list[StereoDepth]:
    """Depth of every training view, matched, and where bare planes go on; held-out images are not looked at.

    Raises:
        InputError: the images cannot be matched.
        Interrupted: the user asked to stop.
    """
    path = job.folder / "stereo" / "depths.safetensors"
    scene, training = ready.scene, ready.training

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

    return job.run(StoredStage("stereo", make, save, load, inputs=["scene", "views"], version=2))


def views_for_fit(job: Job, ready: Prepared) -> tuple[Views, list[str]]:
    """The views with the depth that a fit gets by the settings' `fit.depth_from`, and the stages that this depth comes from.

    Raises:
        InputError: the images are to be matched, and cannot be.
        Interrupted: the user asked to stop.
    """
    views = ready.views
    wanted = job.settings.fit.depth_from if job.settings.fit.depth > 0 else "off"
    if wanted == "off":
        return replace(views, depths=[]), []
    measured = any(depth is not None for depth in views.depths)
    full = wanted == "any" or (wanted == "auto" and job.settings.tsdf.enabled == "on")  # then it is there for the surface
    if measured or not full:
        return views, []  # by `auto`, the fit matches images itself, quickly
    return with_depths(views, np.flatnonzero(~views.test), match_images(job, ready)), ["stereo"]


def exact_depths(ready: Prepared) -> list[StereoDepth]:
    """The true depth of every training view, for captures that bring it.

    Raises:
        InputError: a training image has none.
    """
    posed, views, truth = ready.posed, ready.views, find_truth(ready.posed)
    training = np.flatnonzero(~views.test)
    depths = [] if truth is None else true_depths(truth, posed, views, training, ready.scene.working_from_input.scale)
    known = [depth for depth in depths if depth is not None]
    if not known or len(known) < len(training):
        raise InputError(f"{posed.root} brings no exact depth for {len(training) - len(known)} of its pictures; choose another depth")
    return [
        StereoDepth(depth, (depth > 0).astype(np.float32), views.intrinsics[index]) for depth, index in zip(known, training, strict=True)
    ]


def fuse_tsdf(job: Job, ready: Prepared, name: str = "tsdf", depth_from: str | None = None) -> Pictures:
    """Fuse the training frames' depth into a surface; its renders at the held-out views are the result.

    Args:
        name: of the stage, its folder and its renders.
        depth_from: "sensor", "matching" (images with each other) or "exact" (the truth that a simulated capture brings); None: the
            sensor's when the capture has depth, else by matching.
    """
    from fieldfuse.export.mesh import mesh_facts

    depth_from = depth_from or ("sensor" if ready.posed.has_depth else "matching")
    matched = match_images(job, ready) if depth_from == "matching" else None
    folder = job.folder / name

    def make() -> Pictures:
        depths = exact_depths(ready) if depth_from == "exact" else matched
        start = time.monotonic()
        volume = _fused(job, ready, depths, carve=depth_from != "exact")
        fused = time.monotonic() - start
        mesh = whole_mesh(volume, job.settings.export.smooth)
        write_surface(ready, folder, mesh, volume.points())
        found = render_views(job, ready.views, volume.render)
        share = None if depths is None else round(float(np.mean([(one.depth > 0).mean() for one in depths])), 4)
        found.facts = {
            "depth_share": share,
            "voxel_size": volume.voxel_size,
            "depth_max": volume.depth_max,
            "frames": volume.frames,
            "blocks": volume.blocks,
            "bytes": volume.bytes,
            "fusion_seconds": round(fused, 3),
            "mesh": mesh_facts(mesh),
            "depth_from": depth_from,
        }
        return found

    return job.run(
        pictures_stage(
            job,
            ready,
            Stage(
                name,
                make=make,
                save=lambda _: [folder / "mesh.ply", folder / "points.ply"],
                load=Pictures,
                inputs=["scene", "views", *(["stereo"] if matched is not None else [])],
                settings=[asdict(job.settings.tsdf), pixel_state(ready.posed), depth_from, job.settings.export.smooth],
                version=3,
            ),
            name,
        )
    )


def _fused(job: Job, ready: Prepared, depths: list[StereoDepth] | None, carve: bool) -> TsdfVolume:
    """The training frames in one volume; `depths`: of the training views, None: the capture's own."""
    from fieldfuse.tsdf.fuse import fuse_capture, fuse_stereo

    settings, posed, views = job.settings.tsdf, ready.posed, ready.views
    if depths is not None:
        return fuse_stereo(ready.training, depths, settings.voxel_size, settings.depth_max, carve=carve, progress=job.progress)
    train = [index for index, test in enumerate(views.test) if not test and posed.frames[index].depth is not None]
    return fuse_capture(posed, ready.scene.working_from_input, train, settings, job.progress, views.toned())


def write_surface(ready: Prepared, folder: Path, mesh: Mesh, points: Points) -> None:
    """Mesh and points of the working frame as files in the input's, as bright as the images were taken."""
    from fieldfuse.export.mesh import write_mesh

    input_from_working, exposure = ready.scene.working_from_input.inverse(), ready.views.exposure
    write_mesh(folder / "mesh.ply", replace(mesh, colours=exposed(mesh.colours, exposure)).transformed(input_from_working))
    put_points(folder / "points.ply", points, input_from_working, exposure)


def put_points(path: Path, points: Points, input_from_working: Similarity, exposure: float) -> Path:
    """Points of the working frame as a .ply file in the input's, brighter by `exposure`."""
    from fieldfuse.export.ply import write_points

    found = in_input(points, input_from_working, exposure)
    write_points(path, found.points, found.colours, found.normals)
    return path


def in_input(points: Points, input_from_working: Similarity, exposure: float) -> Points:
    """Points of the working frame in the input's, brighter by `exposure`."""
    places, normals = input_from_working.points(points.points), input_from_working.directions(points.normals)
    return replace(points, points=places, colours=exposed(points.colours, exposure), normals=normals)


def put_cloud(path: Path, points: Points, place: Georeference | None) -> str | None:
    """Points of the input's frame as .las, .laz or .e57: where the frame's place on earth is known in UTM coordinates with their reference
    system, else as they are. Answers a sentence where they could not become UTM coordinates."""
    from fieldfuse.export.clouds import write_cloud

    crs, note = None, None
    if place is not None:
        try:
            linear, crs = place.utm_from_input()[:3, :3], place.epsg
            normals = points.normals @ np.linalg.inv(linear)
            normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
            points = replace(points, points=place.to_utm(points.points), normals=normals)
        except InputError as error:
            note = f"{path.name} has the coordinates of the input, not those of its UTM zone: {error}"
    write_cloud(path, points.points, points.colours, points.normals, crs)
    return note


def render_views(job: Job, views: Views, render: Callable[[Intrinsics, Array], Any]) -> Pictures:
    """Renders at the held-out views, with the seconds that each took; `render`: lens and pose in the working frame → `Rendered`."""
    pictures, indices = Pictures(), np.flatnonzero(views.test)
    require_pictures([views.intrinsics[index] for index in indices], kept=True, advice="run again with a lower --image-size")
    for count, index in enumerate(indices):
        job.progress.update(count, len(indices), views.names[index])
        job.progress.check()
        start = time.monotonic()
        picture: Picture = to_picture(render(views.intrinsics[index], views.world_from_camera[index]))
        pictures.add(views.names[index], picture, time.monotonic() - start)
    return pictures


def pictures_stage(job: Job, ready: Prepared, stage: Stage[Pictures], name: str) -> Stage[Pictures]:
    """The stage whose result are renders: they are `renders/<name>.safetensors`, with PNG files beside it; `save` has other files only."""
    path, others = job.folder / "renders" / f"{name}.safetensors", stage.save

    def save(pictures: Pictures) -> Iterable[Path]:
        save_pictures(path, pictures)
        return [path, *others(pictures), *write_pngs(path.parent, name, pictures, ready.views.exposure, depth_steps(ready.scene))]

    return replace(stage, save=save, load=partial(load_pictures, path))
