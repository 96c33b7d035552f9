"""Surfaces: the TSDF baseline from sensor depth, and the field's own depth fused into a mesh. Both are written in the input's frame."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fieldfuse import memory
from fieldfuse.camera import Array, Similarity
from fieldfuse.errors import InputError
from fieldfuse.export.surface import Originals, at_most, surface_of_field, whole_mesh
from fieldfuse.memory_limits import require_pictures
from fieldfuse.pipelines.fit_files import fit_left_out
from fieldfuse.pipelines.job import Job
from fieldfuse.pipelines.pictures import NAME, PAGE, camera_of, orbit_cameras, pictures, put_page
from fieldfuse.pipelines.rendered import Pictures, to_picture
from fieldfuse.pipelines.summary import put_cameras
from fieldfuse.pipelines.taken import MESHES, SURFACES, TEXTURE, missing_originals, needs_originals
from fieldfuse.pipelines.textured import TEXTURED, put_textured
from fieldfuse.tone import exposed

if TYPE_CHECKING:
    from fieldfuse.capture.types import Capture, Views
    from fieldfuse.poses.result import PoseResult
    from fieldfuse.poses.scene import Scene
    from fieldfuse.render.field import Field
    from fieldfuse.stereo.match import StereoDepth
    from fieldfuse.tsdf.mesh import Mesh
    from fieldfuse.tsdf.volume import Points

MOST_TRIANGLES = 2_000_000
MOST_SPARSE = 20_000  # points that go with exported cameras
VIDEO_SIDE = 640
FPS = 30


def fuse_training_frames(
    job: Job, folder: Path, posed: Capture, scene: Scene, views: Views, depths: list[StereoDepth] | None = None, exact: bool = False
) -> tuple[Pictures, list[Path]]:
    """The TSDF surface of the training frames: mesh and points in `folder`, pictures at the held-out views.

    Args:
        depths: of the training views, to be used instead of the capture's own.
        exact: these depths are beyond doubt.

    Returns:
        pictures, and the files written. `pictures.facts`: voxel size and range (working units), frames, blocks, seconds with decoding.
    """
    from fieldfuse.export.mesh import mesh_facts
    from fieldfuse.tsdf.fuse import fuse_capture, fuse_stereo

    settings = job.settings.tsdf
    start = time.monotonic()
    if depths is None:
        train = [index for index, test in enumerate(views.test) if not test and posed.frames[index].depth is not None]
        volume = fuse_capture(posed, scene.working_from_input, train, settings, job.progress, views.toned())
    else:
        shown = views.subset(np.flatnonzero(~views.test))
        volume = fuse_stereo(shown, depths, settings.voxel_size, settings.depth_max, carve=not exact, progress=job.progress)
    fused = time.monotonic() - start
    mesh = whole_mesh(volume, job.settings.export.smooth)
    write_surface(folder, scene, mesh, volume.points(), views.exposure)
    found = Pictures()
    lenses = [views.intrinsics[index] for index in np.flatnonzero(views.test)]
    require_pictures(lenses, kept=True, advice="run again with a lower --image-size")
    for index in np.flatnonzero(views.test):
        job.progress.check()
        start = time.monotonic()
        picture = to_picture(volume.render(views.intrinsics[index], views.world_from_camera[index]))
        found.add(views.names[index], picture, time.monotonic() - start)
    found.facts = {
        "depth_share": None if depths is None else round(float(np.mean([(one.depth > 0).mean() for one in depths])), 4),
        "voxel_size": volume.voxel_size,
        "depth_max": volume.depth_max,
        "frames": volume.frames,
        "blocks": volume.blocks,
        "bytes": volume.bytes,
        "fusion_seconds": round(fused, 3),
        "mesh": mesh_facts(mesh),
    }
    return found, [folder / "mesh.ply", folder / "points.ply"]


def write_surface(folder: Path, scene: Scene, mesh: Mesh, points: Points, exposure: float) -> None:
    """Mesh and points of the working frame as files in the input's, brighter by `exposure`."""
    from fieldfuse.export.mesh import write_mesh

    input_from_working = scene.working_from_input.inverse()
    write_mesh(folder / "mesh.ply", replace(mesh, colours=exposed(mesh.colours, exposure)).transformed(input_from_working))
    put_points(folder / "points.ply", points, input_from_working, exposure)


def put_points(path: Path, points: Points, input_from_working: Similarity, exposure: float) -> Path:
    """Points of the working frame as a file in the input's, brighter by `exposure`."""
    from fieldfuse.export.ply import write_points

    colours = exposed(points.colours, exposure)
    write_points(path, input_from_working.points(points.points), colours, input_from_working.directions(points.normals))
    return path


@dataclass
class Exported:
    """What `export_field` has written."""

    facts: dict[str, Any]  # of the mesh: triangles, watertight, …; `notes` on what was left out
    files: list[Path]
    made: set[str]  # formats
    whole: bool  # False: something was left out for want of the capture's pictures, and can be made when they are there again


def export_field(job: Job, folder: Path, field: Field, poses: PoseResult, posed: Capture, scene: Scene, views: Views) -> Exported:
    """What this command or the settings' `export.formats` name, in the input's frame."""
    from fieldfuse.export.video import write_video

    formats = set(job.settings.export.formats if job.formats is None else job.formats)
    facts: dict[str, Any] = {"mesh": None, "notes": []}
    written: list[Path] = []
    undone: set[str] = set()
    for what, names, side in needs_originals(job, formats):
        gone = missing_originals(job, posed, views, side)
        if gone is not None and names - undone:
            undone |= names
            facts["notes"].append(f"{what} left out: {gone}")
    whole = not undone
    if surfaces := (formats - undone) & SURFACES:
        try:
            facts["mesh"], written = export_surface(job, folder, surfaces, field, posed, scene, views, facts["notes"])
            undone |= {TEXTURE} - {TEXTURE for path in written if path.name == TEXTURED}
        except InputError as error:
            undone |= surfaces
            facts["notes"].append(f"points and meshes were left out: {error}")
    if "cameras" in formats:
        put_cameras(folder / "cameras", poses, posed, *sparse_points(folder / "points.ply"))
        written += [path for path in sorted((folder / "cameras").rglob("*")) if path.is_file()]
    if PAGE in formats:
        try:
            written.append(put_page(job, folder / NAME, field, views, scene))
        except InputError as error:
            undone.add(PAGE)
            facts["notes"].append(f"the page to walk through was left out: {error}")
    if "video" in formats:
        _, lenses, around = orbit_cameras(views, scene, job.settings.export.video_frames)
        job.progress.update(0, len(around), "orbit video")
        camera = camera_of(job, field, views, scene, baked=False)
        lenses = [at_most(lens, VIDEO_SIDE) for lens in lenses]
        require_pictures(lenses, kept=False, advice="leave video out of export.formats")
        write_video(folder / "orbit.mp4", pictures(camera, lenses, around, job.progress), FPS)
        written.append(folder / "orbit.mp4")
    return Exported(facts, written, formats - undone, whole)


def sparse_points(path: Path) -> tuple[Array, Array] | tuple[None, None]:
    """At most `MOST_SPARSE` points (P, 3) of an exported cloud, evenly chosen, and their colours (P, 3) uint8; None where there is none."""
    import trimesh

    if not path.is_file():
        return None, None
    cloud: Any = trimesh.load(path, process=False)
    chosen = np.linspace(0, len(cloud.vertices) - 1, min(MOST_SPARSE, len(cloud.vertices))).astype(int)
    return np.asarray(cloud.vertices)[chosen], np.asarray(cloud.colors)[chosen, :3]


def export_surface(
    job: Job, folder: Path, formats: set[str], field: Field, posed: Capture, scene: Scene, views: Views, notes: list[str]
) -> tuple[dict[str, Any], list[Path]]:
    """The field's depth at the training cameras, polished by their pictures as they were taken and fused: points and meshes of the region
    of interest.

    Args:
        notes: gets a sentence when the texture had to be left out.

    Raises:
        InputError: the field has no surface.
    """
    from fieldfuse.export.mesh import mesh_facts, write_mesh

    volume = surface_of_field(field, views, scene, job.settings, Originals(posed, job.corrections), job.progress)
    memory.give_back()  # what pictures and depth maps took
    input_from_working = scene.working_from_input.inverse()
    exposure = views.exposure
    written = [put_points(folder / "points.ply", volume.points(), input_from_working, exposure)] if "points" in formats else []
    whole = whole_mesh(volume, job.settings.export.smooth)
    del volume
    mesh = whole.decimated(MOST_TRIANGLES).transformed(input_from_working)
    mesh = replace(mesh, colours=exposed(mesh.colours, exposure))
    facts = mesh_facts(mesh)
    for path in [job.folder / "mesh.ply", *(folder / f"mesh.{suffix}" for suffix in MESHES if suffix in formats)]:
        write_mesh(path, mesh)
        written.append(path)
    if TEXTURE in formats:
        memory.give_back()
        try:
            left_out = fit_left_out(job)  # who passed belongs into a texture as little as into the field
            shown = views if left_out is None else left_out.without(views)
            written.append(put_textured(job, folder / TEXTURED, whole, posed, scene, shown))
        except InputError as error:
            notes.append(f"the texture was left out: {error}")
    return facts, written
