"""Which part of a true surface the cameras saw: only that can be asked of a reconstruction."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import open3d as o3d
import open3d.core as o3c

from fieldfuse.camera import Array, Intrinsics, invert
from fieldfuse.tsdf.mesh import Mesh, ray_scene

AT_ONCE = 1 << 19  # rays


def seen_points(points: Array, mesh: Mesh, cameras: Sequence[Intrinsics], world_from_camera: Array, margin: float) -> Array:
    """(N,) bool: which (N, 3) points on the surface of `mesh` some camera sees, inside its picture and with nothing of the mesh before it.

    Args:
        cameras: one a pose (N, 4, 4); lenses are ignored.
        margin: length before a point where the surface itself does not hide it; some tenths of a voxel.
    """
    points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    seen = np.zeros(len(points), bool)
    if len(points) == 0 or len(mesh.triangles) == 0:
        return seen
    origin = mesh.bounds().mean(axis=0)  # float32 rays start near zero, wherever the scene lies
    scene = ray_scene(mesh, origin)
    for camera, pose in zip(cameras, np.asarray(world_from_camera, dtype=np.float64), strict=True):
        open_ones = np.flatnonzero(~seen)
        inside = open_ones[in_picture(points[open_ones], camera, pose)]
        for start in range(0, len(inside), AT_ONCE):
            part = inside[start : start + AT_ONCE]
            seen[part] = ~_hidden(scene, points[part] - origin, pose[:3, 3] - origin, margin)
    return seen


def in_picture(points: Array, camera: Intrinsics, world_from_camera: Array) -> Array:
    """(N,) bool: which (N, 3) points lie in front of a pinhole camera and inside its picture."""
    pose = invert(world_from_camera)
    local = points @ pose[:3, :3].T + pose[:3, 3]
    z = np.where(local[:, 2] > 1e-9, local[:, 2], np.nan)
    with np.errstate(invalid="ignore"):
        u, v = local[:, 0] / z * camera.fx + camera.cx, local[:, 1] / z * camera.fy + camera.cy
        return np.asarray((u >= 0) & (u <= camera.width) & (v >= 0) & (v <= camera.height))


def _hidden(scene: o3d.t.geometry.RaycastingScene, points: Array, eye: Array, margin: float) -> Array:
    """(N,) bool: the mesh stands between the eye and the point, more than `margin` before it."""
    away = points - eye
    distance = np.linalg.norm(away, axis=1, keepdims=True)
    rays = np.concatenate([np.broadcast_to(eye, points.shape), away / np.maximum(distance, 1e-12)], axis=1).astype(np.float32)
    hit = scene.cast_rays(o3c.Tensor.from_numpy(rays))["t_hit"].numpy()
    return np.asarray(hit < distance[:, 0] - margin)
