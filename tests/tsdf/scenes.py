"""RGB-D pictures of a sphere and a plane, computed exactly ray by ray."""

from __future__ import annotations

import numpy as np

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.render.paths import look_at
from fieldfuse.tsdf.volume import DepthFrame

CAMERA = Intrinsics(160, 120, 150.0, 150.0, 80.0, 60.0)
UP = np.array([0.0, 0.0, 1.0])


def ring(centre: Array, radius: float, count: int, height: float = 0.0) -> Array:
    """(count, 4, 4) poses on a circle round `centre`, looking at it."""
    angle = 2 * np.pi * np.arange(count) / count
    at = centre + np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(count, height)], axis=1)
    return look_at(at, centre, UP)


def all_round(centre: Array, radius: float, count: int) -> Array:
    """(count, 4, 4) poses spread evenly over a sphere round `centre` (golden spiral), looking at it."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.arange(count) * np.pi * (3 - 5**0.5)
    flat = np.sqrt(1 - z**2)
    return look_at(centre + radius * np.stack([flat * np.cos(angle), flat * np.sin(angle), z], axis=1), centre, UP)


def directions(camera: Intrinsics, pose: Array) -> Array:
    """(H, W, 3) world directions whose parameter is depth along z."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    local = np.stack([(u + 0.5 - camera.cx) / camera.fx, (v + 0.5 - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    return np.asarray(local @ pose[:3, :3].T)


def sphere_depth(camera: Intrinsics, pose: Array, centre: Array, radius: float) -> Array:
    """(H, W) float32 depth of a sphere, 0 beside it."""
    ray = directions(camera, pose)
    start = pose[:3, 3] - centre
    a, b, c = (ray**2).sum(-1), (ray @ start), start @ start - radius**2
    inside = b**2 - a * c
    near = (-b - np.sqrt(np.maximum(inside, 0))) / a
    return np.where((inside > 0) & (near > 0), near, 0).astype(np.float32)


def sphere_colour(points: Array, centre: Array) -> Array:
    """(..., 3) uint8: red above the centre, green below, more blue towards +x."""
    offset = points - centre
    above = offset[..., 2] > 0
    blue = np.clip(128 + 100 * offset[..., 0] / (np.linalg.norm(offset, axis=-1) + 1e-9), 0, 255)
    return np.stack([np.where(above, 220, 30), np.where(above, 30, 200), blue], axis=-1).astype(np.uint8)


def sphere_frame(
    pose: Array, centre: Array, radius: float, camera: Intrinsics = CAMERA, colour_camera: Intrinsics | None = None
) -> DepthFrame:
    """The sphere before black nothing, depth and colour by separate cameras when `colour_camera` is given."""
    colour_camera = colour_camera or camera
    depth = sphere_depth(camera, pose, centre, radius)
    seen = sphere_depth(colour_camera, pose, centre, radius)
    points = pose[:3, 3] + directions(colour_camera, pose) * seen[..., None]
    colour = np.where(seen[..., None] > 0, sphere_colour(points, centre), 0).astype(np.uint8)
    return DepthFrame(depth, colour, camera, colour_camera, pose)


def plane_frame(pose: Array, normal: Array, offset: float, camera: Intrinsics = CAMERA) -> DepthFrame:
    """The plane normal · x = offset, grey, filling the picture where it lies before the camera."""
    ray = directions(camera, pose)
    with np.errstate(divide="ignore"):
        depth = (offset - pose[:3, 3] @ normal) / (ray @ normal)
    depth = np.where((depth > 0) & (depth < 100), depth, 0).astype(np.float32)
    return DepthFrame(depth, np.full((*depth.shape, 3), 100, np.uint8), camera, camera, pose)
