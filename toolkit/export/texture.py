"""A texture for a mesh, from the pictures that it was made of: each texel is a mean over those that see it best.

Pictures are weighed at the vertices, by angle, resolution, and distance from their border and from what hides something behind it; of each
vertex the three best count, less what the fourth would, so that weights fade to zero where pictures take over from each other. Between
vertices weights are interpolated like anything else.

Pictures differ in brightness, and shiny things in each of them. So in the large the texture has the colours of the vertices, which are a
mean over all pictures, and only what is smaller is the best pictures' own.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numba
import numpy as np
import open3d as o3d

from toolkit.camera import Array, Intrinsics, invert
from toolkit.export.atlas import Atlas, make_atlas
from toolkit.progress import SILENT, Progress
from toolkit.tsdf.mesh import Mesh

BEST = 3  # pictures of a vertex
SIDE = 320  # pixels along the depth maps that tell what is hidden
BEHIND = 0.02  # of the depth: what lies so far behind what a picture shows is hidden
STEP = 0.05  # of the depth: a larger step between neighbours hides something
FADE = 4.0  # pixels of these maps over which a picture fades out towards such a step, and towards its border
LARGEST = 4096  # texels along a texture
FINE_SHARE = 0.75  # of the surface that has texels as small as its pixels; a little that is seen from very near does not decide for all
SHARP = 4.0  # exponent of a picture's resolution on the surface: the best one counts for most
EVENED = 20  # rounds of even mixing with the neighbours: differences in colour over less than some five triangles are the pictures' own
ALIKE = 1e-4  # of the weights: smaller differences between the best pictures do not tell which are better
F = np.float32


def textured(
    mesh: Mesh,
    images: Sequence[Array],
    intrinsics: Sequence[Intrinsics],
    world_from_camera: Array,
    valid: Sequence[Array | None] = (),
    worth: Sequence[float] = (),
    largest: int = LARGEST,
    progress: Progress = SILENT,
) -> tuple[Atlas, Array]:
    """An atlas of a mesh with normals, and its (S, S, 3) uint8 texture; what no picture sees has the colours of its vertices.

    Texels are as small as the pixels of the better pictures are on the surface.

    Args:
        mesh: in the frame of the cameras.
        images: (H, W, 3) uint8 RGB; intrinsics: pinhole, of the same sizes.
        world_from_camera: (N, 4, 4).
        valid: (H, W) bool pixels that may be looked at, None: all; empty: all of all pictures.
        worth: what a picture counts beside the others, as a blurred one counts less; empty: 1.
        largest: texels along the texture at most.

    Raises:
        InputError: the mesh has too many triangles for such a texture.
        Interrupted: the user asked to stop.
    """
    weights = picture_weights(mesh, intrinsics, world_from_camera, valid, progress)
    if len(worth):
        weights *= np.asarray(worth, np.float32)
    resolution = weights.max(axis=1, initial=0.0)[mesh.triangles].max(axis=1, initial=0.0) ** (1 / SHARP)
    atlas = make_atlas(mesh, _quantile(resolution, mesh.areas(), FINE_SHARE), largest)
    return atlas, bake_texture(mesh, atlas, strongest(weights), images, intrinsics, world_from_camera, progress)


def bake_texture(
    mesh: Mesh,
    atlas: Atlas,
    chosen: tuple[Array, Array],
    images: Sequence[Array],
    intrinsics: Sequence[Intrinsics],
    world_from_camera: Array,
    progress: Progress = SILENT,
) -> Array:
    """(S, S, 3) uint8 texture; `chosen` as `strongest` gives it, other arguments as in `textured`."""
    which, best = chosen
    texture = np.zeros((atlas.size, atlas.size, 3), np.float32)
    total = np.zeros((atlas.size, atlas.size), np.float32)
    corners = mesh.vertices[mesh.triangles].astype(np.float32)
    layout = (atlas.corner, atlas.length, atlas.way)
    for index, (image, camera, pose) in enumerate(zip(images, intrinsics, world_from_camera, strict=True)):
        progress.check()
        share = np.where(which == index, best, 0).sum(axis=1).astype(np.float32)[mesh.triangles]  # (T, 3)
        seen = np.flatnonzero(share.any(axis=1))
        matrix = (camera.matrix() @ invert(pose)[:3]).astype(np.float32)
        _add_picture(seen, corners, share, *layout, np.ascontiguousarray(image), matrix, texture, total)
        progress.update(len(images) + index + 1, 2 * len(images), "texture")
    means = np.zeros((len(corners), 3), np.float32)
    _finish(corners, mesh.colours[mesh.triangles].astype(np.float32), *layout, texture, total, means)
    _shift(_level(mesh, means)[mesh.triangles], *layout, texture)
    return np.round(np.clip(texture, 0, 255)).astype(np.uint8)


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


def _quantile(values: Array, weights: Array, share: float) -> float:
    """The value below which so large a share of the weights lies."""
    order = np.argsort(values)
    below = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(below, share * below[-1])]) if len(values) else 0.0


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


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_picture(
    seen: Array,
    corners: Array,
    share: Array,
    corner: Array,
    length: Array,
    way: Array,
    image: Array,
    matrix: Array,
    texture: Array,
    total: Array,
) -> None:
    """Add what a picture shows to the texels of the triangles `seen`, as much as `share` (T, 3) says of it at their vertices."""
    height, width = image.shape[0], image.shape[1]
    one = F(1)
    for t in seen:
        reach = length[t] + 3
        for j in range(reach):
            for i in range(reach - j if way[t] > 0 else reach - 1 - j):
                b, c = F(i) / F(length[t]), F(j) / F(length[t])
                a = one - b - c
                amount = a * share[t, 0] + b * share[t, 1] + c * share[t, 2]
                if amount <= F(0):
                    continue
                x = a * corners[t, 0, 0] + b * corners[t, 1, 0] + c * corners[t, 2, 0]
                y = a * corners[t, 0, 1] + b * corners[t, 1, 1] + c * corners[t, 2, 1]
                z = a * corners[t, 0, 2] + b * corners[t, 1, 2] + c * corners[t, 2, 2]
                w = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z + matrix[2, 3]
                if w <= F(0):
                    continue
                u = (matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z + matrix[0, 3]) / w - F(0.5)
                v = (matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z + matrix[1, 3]) / w - F(0.5)
                if not (u >= F(0) and v >= F(0) and u <= F(width - 1) and v <= F(height - 1)):
                    continue
                left, top = min(int(u), width - 2), min(int(v), height - 2)
                if left < 0 or top < 0:
                    continue
                right, down = u - F(left), v - F(top)
                row, column = corner[t, 1] + way[t] * j, corner[t, 0] + way[t] * i
                total[row, column] += amount
                for k in range(3):
                    upper = F(image[top, left, k]) * (one - right) + F(image[top, left + 1, k]) * right
                    lower = F(image[top + 1, left, k]) * (one - right) + F(image[top + 1, left + 1, k]) * right
                    texture[row, column, k] += amount * (upper * (one - down) + lower * down)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _finish(corners: Array, colours: Array, corner: Array, length: Array, way: Array, texture: Array, total: Array, means: Array) -> None:
    """Sums to means; texels that no picture shows get the colours (T, 3, 3) of their triangle's vertices. `means` (T, 3) of triangles."""
    zero, one = F(0), F(1)
    for t in range(len(corners)):
        reach, count = length[t] + 3, 0
        for j in range(reach):
            for i in range(reach - j if way[t] > 0 else reach - 1 - j):
                row, column = corner[t, 1] + way[t] * j, corner[t, 0] + way[t] * i
                b, c = min(F(i) / F(length[t]), one), min(F(j) / F(length[t]), one)
                a = max(one - b - c, zero)
                for k in range(3):
                    if total[row, column] > F(1e-6):
                        texture[row, column, k] /= total[row, column]
                    else:
                        texture[row, column, k] = (a * colours[t, 0, k] + b * colours[t, 1, k] + c * colours[t, 2, k]) / (a + b + c)
                if i + j <= length[t]:
                    count += 1
                    for k in range(3):
                        means[t, k] += texture[row, column, k]
        for k in range(3):
            means[t, k] /= F(count)


def _level(mesh: Mesh, means: Array) -> Array:
    """(V, 3) float32 what the colours of the vertices are above those of the texture (`means` of triangles), in the large."""
    off = mesh.colours.astype(np.float32)[mesh.triangles].mean(axis=1) - means
    at, area = mesh.triangles.reshape(-1), np.repeat(mesh.areas(), 3)
    room = np.bincount(at, area, len(mesh.vertices))
    out = np.stack([np.bincount(at, area * np.repeat(off[:, k], 3), len(room)) / np.maximum(room, 1e-30) for k in range(3)], axis=1)
    links = np.concatenate([mesh.triangles[:, [0, 1]], mesh.triangles[:, [1, 2]], mesh.triangles[:, [2, 0]]])
    here, there = np.concatenate([links, links[:, ::-1]]).T
    count = np.maximum(np.bincount(here, minlength=len(room)), 1)
    for _ in range(EVENED):
        out = 0.5 * out + 0.5 * np.stack([np.bincount(here, out[there, k], len(room)) / count for k in range(3)], axis=1)
    return np.asarray(out, dtype=np.float32)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _shift(off: Array, corner: Array, length: Array, way: Array, texture: Array) -> None:
    """Add to the texels of each triangle what lies between `off` (T, 3, 3) of its vertices."""
    one = F(1)
    for t in range(len(off)):
        reach = length[t] + 3
        for j in range(reach):
            for i in range(reach - j if way[t] > 0 else reach - 1 - j):
                b, c = F(i) / F(length[t]), F(j) / F(length[t])
                row, column = corner[t, 1] + way[t] * j, corner[t, 0] + way[t] * i
                for k in range(3):
                    texture[row, column, k] += (one - b - c) * off[t, 0, k] + b * off[t, 1, k] + c * off[t, 2, k]
