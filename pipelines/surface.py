"""Surfaces: the TSDF baseline from sensor depth, and the field's own depth fused into a mesh. Both are written in the input's frame."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipelines.job import Job
from pipelines.render_path import orbit_cameras, pictures
from pipelines.rendered import Pictures, to_picture
from toolkit.camera import Array, Intrinsics, Similarity

if TYPE_CHECKING:
    from toolkit.capture.types import Capture, Views
    from toolkit.poses.result import PoseResult
    from toolkit.poses.scene import Scene
    from toolkit.render.field import Field
    from toolkit.tsdf.frames import DepthFrame
    from toolkit.tsdf.fuse import Points, TsdfVolume
    from toolkit.tsdf.mesh import Mesh

SMALL_PART = 0.002  # components of a mesh with less than this share of the triangles are specks
MESH_SIDE = 400  # pixels; finer depth than this adds little to a mesh and much to the time
VIDEO_SIDE = 640
FPS = 30


def spread(count: int, most: int) -> list[int]:
    """At most `most` of `count` indices, evenly spread."""
    return sorted({round(i) for i in np.linspace(0, count - 1, min(count, most))}) if count and most else []


def fuse_training_frames(job: Job, folder: Path, posed: Capture, scene: Scene, views: Views) -> tuple[Pictures, list[Path]]:
    """The TSDF surface of the training frames: mesh and points in `folder`, pictures at the held-out views.

    Returns:
        pictures, and the files written. `pictures.facts`: voxel size and range (working units), frames, blocks, seconds with decoding.
    """
    from toolkit.export.mesh import mesh_facts

    from toolkit.tsdf.fuse import fuse_capture

    train = [index for index, test in enumerate(views.test) if not test and posed.frames[index].depth is not None]
    start = time.monotonic()
    volume = fuse_capture(posed, scene.working_from_input, train, job.settings.tsdf, job.progress)
    fused = time.monotonic() - start
    mesh = volume.mesh().cleaned(min_share=SMALL_PART)
    write_surface(folder, scene, mesh, volume.points())
    found = Pictures()
    for index in np.flatnonzero(views.test):
        job.progress.check()
        start = time.monotonic()
        picture = to_picture(volume.render(views.intrinsics[index], views.world_from_camera[index]))
        found.add(views.names[index], picture, time.monotonic() - start)
    found.facts = {
        "voxel_size": volume.voxel_size,
        "depth_max": volume.depth_max,
        "frames": volume.frames,
        "blocks": volume.blocks,
        "bytes": volume.bytes,
        "fusion_seconds": round(fused, 3),
        "mesh": mesh_facts(mesh),
    }
    return found, [folder / "mesh.ply", folder / "points.ply"]


def write_surface(folder: Path, scene: Scene, mesh: Mesh, points: Points) -> None:
    """Mesh and points of the working frame as files in the input's."""
    from toolkit.export.mesh import write_mesh

    input_from_working = scene.working_from_input.inverse()
    write_mesh(folder / "mesh.ply", mesh.transformed(input_from_working))
    put_points(folder / "points.ply", points, input_from_working)


def put_points(path: Path, points: Points, input_from_working: Similarity) -> Path:
    """Points of the working frame as a file in the input's."""
    from toolkit.export.points import write_points

    write_points(path, input_from_working.points(points.points), points.colours, input_from_working.directions(points.normals))
    return path


def export_field(job: Job, folder: Path, field: Field, poses: PoseResult, scene: Scene, views: Views) -> tuple[dict[str, Any], list[Path]]:
    """What the settings' `export.formats` name, in the input's frame.

    Returns:
        facts of the mesh (triangles, watertight, …), and the files written.
    """
    from toolkit.export.cameras import write_cameras
    from toolkit.export.mesh import mesh_facts, write_mesh
    from toolkit.export.video import write_video

    formats = job.settings.export.formats
    facts: dict[str, Any] = {}
    written: list[Path] = []
    if set(formats) & {"points", "ply", "obj", "glb"}:
        volume = fuse_rendered_depth(job, field, scene, views)
        input_from_working = scene.working_from_input.inverse()
        if "points" in formats:
            written.append(put_points(folder / "points.ply", volume.points(), input_from_working))
        mesh = volume.mesh().cleaned(min_share=SMALL_PART).transformed(input_from_working)
        facts["mesh"] = mesh_facts(mesh)
        for path in [job.folder / "mesh.ply", *(folder / f"mesh.{suffix}" for suffix in ("ply", "obj", "glb") if suffix in formats)]:
            write_mesh(path, mesh)
            written.append(path)
    if "cameras" in formats:
        cameras = folder / "cameras"
        write_cameras(cameras, poses.names, poses.intrinsics, poses.world_from_camera, poses.points)
        written += [path for path in sorted(cameras.rglob("*")) if path.is_file()]
    if "video" in formats:
        _, lenses, around = orbit_cameras(views, scene, job.settings.export.video_frames)
        job.progress.update(0, len(around), "orbit video")
        write_video(folder / "orbit.mp4", pictures(field, [at_most(lens, VIDEO_SIDE) for lens in lenses], around, job.progress), FPS)
        written.append(folder / "orbit.mp4")
    return facts, written


def fuse_rendered_depth(job: Job, field: Field, scene: Scene, views: Views) -> TsdfVolume:
    """The field's depth, rendered at the capture's own cameras, as a TSDF volume: its surface is clean where single views are not."""
    from toolkit.tsdf.fuse import fuse_frames

    chosen = spread(len(views), job.settings.export.mesh_views)
    reach = np.linalg.norm(views.world_from_camera[:, :3, 3] - scene.centre, axis=1).max() + np.linalg.norm(scene.half_size)
    depth_max = float(min(reach, scene.far))
    return fuse_frames(rendered_depth(field, views, chosen), mesh_voxel(field, scene, views), depth_max, len(chosen), progress=job.progress)


def mesh_voxel(field: Field, scene: Scene, views: Views) -> float:
    """Not finer than the field, and not finer than the rendered depth can tell."""
    lens = at_most(views.intrinsics[0], MESH_SIDE)
    return float(max(field.voxel_size, 1.5 * scene.median_depth / lens.fx))


def rendered_depth(field: Field, views: Views, chosen: list[int]) -> Iterator[DepthFrame]:
    """Depth and colour of the field at some of the views, as frames to fuse."""
    from toolkit.render.image import render_view
    from toolkit.tsdf.frames import DepthFrame

    for index in chosen:
        lens = at_most(views.intrinsics[index], MESH_SIDE)
        pose: Array = views.world_from_camera[index]
        picture = to_picture(render_view(field, lens, pose))
        yield DepthFrame(picture.depth, picture.rgb, lens, lens, pose)


def at_most(lens: Intrinsics, long_side: int) -> Intrinsics:
    """The camera, made smaller if its long side is larger; sides stay even, as video needs."""
    factor = min(1.0, long_side / max(lens.width, lens.height))
    if factor == 1.0:
        return lens
    return lens.scaled(*(max(2, round(side * factor / 2) * 2) for side in (lens.width, lens.height)))
