"""A clean surface of a radiance field: depth rendered from many views, what is uncertain left out, the rest fused into a TSDF."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.errors import InputError
from fieldfuse.progress import SILENT, Progress
from fieldfuse.stereo.maps import enlarged
from fieldfuse.tsdf.fuse import fuse_held
from fieldfuse.tsdf.mesh import as_bytes
from fieldfuse.tsdf.volume import DepthFrame, TsdfVolume

# (intrinsics, world_from_camera) → (rgb, depth, opacity), or an object with these names, as `render_view` gives.
Render = Callable[[Intrinsics, Array], Any]
Polish = Callable[[Array], tuple[Array, Array]]  # depth (H, W) → better depth, 0 = none, and bool where pictures tell it
# Reliable depth of all views, all of their depth that is opaque enough, where pictures tell it → better depth, 0 = none.
Settle = Callable[[list[Array], list[Array], list[Array]], list[Array]]

STEEPEST = 4.0  # tangent of the angle between view and surface normal (76°) beyond which a depth step is taken as an edge
OPAQUE = 0.7  # opacity from which a pixel has a surface
SMALLEST_EDGE = 0.02  # share of depth: smaller steps are never an edge
AFTERWARDS = 0.2  # of the time that rendering takes, for the progress


def reliable_depth(depth: Array, opacity: Array, focal: float) -> Array:
    """(H, W) depth with 0 where it cannot be trusted: little opacity, or beside a depth edge, where it lies between two surfaces.

    An edge is a range over 3×3 pixels larger than a plane seen at 76° would have. Missing neighbours do not make an edge.
    """
    depth = np.where(np.isfinite(depth) & (depth > 0) & (opacity >= OPAQUE), depth, 0).astype(np.float32)
    window = np.ones((3, 3), np.uint8)
    farthest = cv2.dilate(depth, window)
    nearest = cv2.erode(np.where(depth > 0, depth, np.float32(np.inf)), window)
    step = np.maximum(SMALLEST_EDGE, 2 * STEEPEST / focal)
    return np.asarray(np.where(farthest - nearest <= step * depth, depth, np.float32(0)))


def rendered_frame(
    render: Render, intrinsics: Intrinsics, world_from_camera: Array, polish: Polish | None = None
) -> tuple[DepthFrame, Array, Array]:
    """Render one view: a frame of its reliable depth, polished before; (H, W) all depth that is opaque enough; where pictures tell it.

    What is rendered may be smaller than the camera, whose pictures then tell what is finer.
    """
    rendered = render(intrinsics, world_from_camera)
    rgb, depth, opacity = (rendered.rgb, rendered.depth, rendered.opacity) if hasattr(rendered, "rgb") else rendered
    camera, size = intrinsics.pinhole(), (intrinsics.width, intrinsics.height)
    small = camera.scaled(np.shape(depth)[1], np.shape(depth)[0])
    if small != camera:
        depth = enlarged(np.asarray(depth), *size)
        opacity = cv2.resize(np.asarray(opacity, dtype=np.float32), size, interpolation=cv2.INTER_LINEAR)
    depth, told = (np.asarray(depth), np.ones(np.shape(depth), bool)) if polish is None else polish(np.asarray(depth))
    opaque = np.where(np.isfinite(depth) & (np.asarray(opacity) >= OPAQUE), depth, 0).astype(np.float32)
    depth = reliable_depth(depth, np.asarray(opacity), camera.fx)
    return DepthFrame(depth, as_bytes(np.asarray(rgb)), camera, small, np.asarray(world_from_camera, dtype=np.float64)), opaque, told


def within(frame: DepthFrame, region: tuple[Array, Array]) -> DepthFrame:
    """The frame without depth of points outside the box (lowest corner, highest corner)."""
    depth, camera, pose = frame.depth.copy(), frame.depth_intrinsics, frame.world_from_camera
    v, u = np.nonzero(depth)
    z = depth[v, u].astype(np.float64)
    points = np.stack([(u + 0.5 - camera.cx) / camera.fx * z, (v + 0.5 - camera.cy) / camera.fy * z, z], axis=1)
    points = points @ pose[:3, :3].T + pose[:3, 3]
    outside = ((points < region[0]) | (points > region[1])).any(axis=1)
    depth[v[outside], u[outside]] = 0
    return replace(frame, depth=depth)


def field_volume(
    render: Render,
    poses: Array,
    intrinsics: Intrinsics | Sequence[Intrinsics],
    voxel_size: float | None = None,
    depth_max: float | None = None,
    *,
    region: tuple[Array, Array] | None = None,
    carve: bool = True,
    polish: Sequence[Polish] | None = None,
    settle: Settle | None = None,
    progress: Progress = SILENT,
) -> TsdfVolume:
    """Render all (N, 4, 4) poses and fuse their reliable depth; its `mesh()` and `points()` are the field's surface.

    Args:
        render: see `Render`.
        intrinsics: one for all, or one a pose.
        voxel_size, depth_max: working units; None: from the rendered depth, the voxel size made coarser until it fits into memory.
        region: lowest and highest corner (3,) of the box that is kept, working frame.
        carve: views also empty what others put in front of their surface, which removes most floaters.
        polish: for each pose what its rendered depth is made better by; see `stereo/depth_refinement.py`.
        settle: what all depth maps together are made better by; see `stereo/depth_refinement.py`.

    Raises:
        InputError: no view shows a surface, or the voxel size that was asked for is too fine for the memory.
        Interrupted: the user asked to stop.
    """
    poses = np.asarray(poses, dtype=np.float64).reshape(-1, 4, 4)
    cameras = [intrinsics] * len(poses) if isinstance(intrinsics, Intrinsics) else list(intrinsics)
    if len(cameras) != len(poses) or not cameras:
        raise InputError(f"a surface needs one camera a pose, there are {len(cameras)} cameras and {len(poses)} poses")
    better = [None] * len(poses) if polish is None else list(polish)
    made: list[DepthFrame] = []
    opaque: list[Array] = []
    told: list[Array] = []
    for camera, pose, how in zip(cameras, poses, better, strict=True):
        progress.check()
        frame, all_depth, where = rendered_frame(render, camera, pose, how)
        made.append(frame)
        opaque.append(all_depth)
        told.append(where)
        progress.update(len(made), (1 + AFTERWARDS) * len(poses), "views made for the surface")
    if settle is not None:
        depths = settle([frame.depth for frame in made], opaque, told)
        # Planes and what is left beside them have edges of their own.
        depths = [reliable_depth(depth, np.ones_like(depth), frame.depth_intrinsics.fx) for frame, depth in zip(made, depths, strict=True)]
        made = [replace(frame, depth=depth) for frame, depth in zip(made, depths, strict=True)]
    del opaque, told
    return fuse_held(
        made if region is None else [within(frame, region) for frame in made],
        voxel_size,
        depth_max,
        # What pictures tell beyond what was rendered makes depth better, not voxels finer: those would keep its noise.
        focal=min(frame.colour_intrinsics.fx for frame in made),
        carve=carve,
        nothing="no rendered view shows a surface (nothing is opaque) to make a mesh of; fit the field longer or check its poses",
        progress=progress,
    )
