"""How well pictures see the vertices of a mesh.

Pictures are weighed by angle, resolution, and distance from their border and from what hides something behind it; of each vertex the four
best count, less what the fifth would, so that weights fade to zero where pictures take over from each other. Between vertices weights are
interpolated like anything else.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import open3d as o3d

from fieldfuse.camera import Array, Intrinsics, invert
from fieldfuse.progress import SILENT, Progress
from fieldfuse.tsdf.mesh import Mesh

BEST = 4  # pictures of a vertex
SIDE = 320  # pixels along the depth maps that tell what is hidden
BEHIND = 0.02  # of the depth: what lies so far behind what a picture shows is hidden
STEP = 0.05  # of the depth: a larger step between neighbours hides something
FADE = 8.0  # pixels of these maps over which a picture fades out towards such a step, and towards its border
SHARP = 2.0  # exponent of a picture's resolution on the surface: the better ones count for more
ALIKE = 1e-4  # of the weights: smaller differences between the best pictures do not tell which are better


def picture_weights(
    mesh: Mesh,
    intrinsics: Sequence[Intrinsics],
    world_from_camera: Array,
    valid: Sequence[Array | None] = (),
    progress: Progress = SILENT,
) -> Array:
    """(V, N) float32 how well each picture shows each vertex: the power `SHARP` of its pixels per unit of length there, less towards what
    hides something; 0: not at all."""
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(mesh.to_open3d()))
    normals = mesh.normals if mesh.normals is not None else np.zeros_like(mesh.vertices)
    out = np.zeros((len(mesh.vertices), len(intrinsics)), np.float32)
    for index, (camera, pose) in enumerate(zip(intrinsics, world_from_camera, strict=True)):
        progress.check()
        factor = min(1.0, SIDE / max(camera.width, camera.height))
        small = camera.scaled(max(1, round(camera.width * factor)), max(1, round(camera.height * factor)))
        depth, open_ = _shown(scene, small, pose, valid[index] if len(valid) else None)
        local = (mesh.vertices - pose[:3, 3]) @ pose[:3, :3]
        z = np.maximum(local[:, 2], 1e-9)
        u, v = local[:, 0] / z * small.fx + small.cx, local[:, 1] / z * small.fy + small.cy
        inside = (local[:, 2] > 0) & (u >= 0) & (u < small.width) & (v >= 0) & (v < small.height)
        column, row = np.where(inside, u, 0).astype(int), np.where(inside, v, 0).astype(int)
        cosine = -np.einsum("ij,ij->i", normals @ pose[:3, :3], local) / np.maximum(np.linalg.norm(local, axis=1), 1e-9)
        seen = inside & (local[:, 2] <= depth[row, column] * (1 + BEHIND)) & (cosine > 0)
        resolution = np.maximum(cosine, 0) * camera.fx / z
        out[:, index] = np.where(seen, open_[row, column] * resolution**SHARP, 0)
        progress.update(index + 1, 2 * len(intrinsics), "texture")
    return out


def strongest(weights: Array) -> tuple[Array, Array]:
    """(V, N) weights → (V, K ≤ BEST) pictures and (V, K) what they count, less what the next one would; sums are 1, or 0 where nothing is
    seen."""
    count = min(BEST, weights.shape[1])
    order = np.argsort(-weights, axis=1, kind="stable")
    which = order[:, :count]
    whole = np.take_along_axis(weights, which, axis=1)
    best = whole
    if weights.shape[1] > count:
        best = whole - np.take_along_axis(weights, order[:, count : count + 1], axis=1)
        alike = best.sum(axis=1) <= ALIKE * whole.sum(axis=1)  # the same picture several times: any of them will do
        best[alike] = whole[alike]
    total = best.sum(axis=1, keepdims=True)
    return which, np.where(total > 0, best / np.maximum(total, 1e-30), 0).astype(np.float32)


def _shown(scene: Any, camera: Intrinsics, pose: Array, valid: Array | None) -> tuple[Array, Array]:
    """(H, W) depth of what a camera sees of the scene, and (H, W) 0 … 1 how far each pixel is from a step in it, from what is not to be
    looked at, and from the border."""
    rays = scene.create_rays_pinhole(camera.matrix(), invert(pose), camera.width, camera.height)
    depth = scene.cast_rays(rays)["t_hit"].numpy()  # rays of length 1 along z: distances are depths
    known = np.where(np.isfinite(depth), depth, np.float32(1e9))
    window = np.ones((3, 3), np.uint8)
    even = cv2.dilate(known, window) - cv2.erode(known, window) <= STEP * known
    if valid is not None:
        even &= cv2.resize(valid.astype(np.float32), (camera.width, camera.height), interpolation=cv2.INTER_AREA) > 0.999
    whole = np.pad(even.astype(np.uint8), 1)  # the border is an edge, too
    away = cv2.distanceTransform(whole, cv2.DIST_L2, 3)[1:-1, 1:-1]
    return known, np.clip(away / FADE, 0, 1)
