"""A texture for a mesh, from the images that it was made of: each texel is a mean over those that show it best.

Images are weighted by angle, resolution, and distance from their border and from what hides something behind it; of each vertex the four
best count, less what the fifth would, so that weights fade to zero where images take over from each other. Images differ in brightness,
and shiny things in each of them: so in the large the texture has the colours of the vertices, which are a mean over all images, and only
what is smaller is the best images' own.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import open3d as o3d

from fieldfuse.backends.numba.texels import add_image, finish, shift
from fieldfuse.camera import Array, Intrinsics, invert
from fieldfuse.export.atlas import Atlas, make_atlas
from fieldfuse.progress import SILENT, Progress
from fieldfuse.threads import ahead
from fieldfuse.tsdf.mesh import Mesh

LARGEST = 4096  # texels along a texture
FINE_SHARE = 0.75  # of the surface that has texels as small as its pixels; a little that is seen from very near does not decide for all
EVENED = 8  # rounds of even mixing with the neighbours: differences in colour over less than some three triangles are the images' own
BEST = 4  # images of a vertex
SIDE = 320  # pixels along the depth maps that show what is hidden
BEHIND = 0.02  # of the depth: what lies so far behind what an image shows is hidden
STEP = 0.05  # of the depth: a larger step between neighbours hides something
FADE = 8.0  # pixels of these maps over which an image fades out towards such a step, and towards its border
SHARP = 2.0  # exponent of an image's resolution on the surface: the better ones count for more
ALIKE = 1e-4  # of the weights: smaller differences between the best images do not show which are better


@dataclass(frozen=True)
class Photos:
    """What a texture is made of.

    Attributes:
        images: (H, W, 3) uint8 RGB, read once, one after the other. intrinsics: pinhole, of the same sizes.
        world_from_camera: (N, 4, 4), in the frame of the mesh.
        valid: (H, W) bool pixels that may be looked at, in whatever size, None: all; empty: all of all images.
        worth: what an image counts beside the others, as a blurred one counts less; empty: 1.
    """

    images: Iterable[Array]
    intrinsics: Sequence[Intrinsics]
    world_from_camera: Array
    valid: Sequence[Array | None] = ()
    worth: Sequence[float] = ()


def textured(mesh: Mesh, photos: Photos, largest: int = LARGEST, progress: Progress = SILENT) -> tuple[Atlas, Array]:
    """An atlas of a mesh with normals, and its (S, S, 3) uint8 texture; what no image shows has the colours of its vertices.

    Texels are as small as the pixels of the better images are on the surface.

    Args:
        largest: texels along the texture at most.

    Raises:
        InputError: the mesh has too many triangles for such a texture.
        Interrupted: the user asked to stop.
    """
    weights = vertex_visibility(mesh, photos, progress)
    resolution = weights.max(axis=1, initial=0.0)[mesh.triangles].max(axis=1, initial=0.0) ** (1 / SHARP)
    order = np.argsort(resolution)
    below = np.cumsum(mesh.areas()[order])
    density = float(resolution[order][np.searchsorted(below, FINE_SHARE * below[-1])]) if len(order) else 0.0
    atlas = make_atlas(mesh, density, largest)
    which, best = strongest(weights)
    texture = np.zeros((atlas.size, atlas.size, 3), np.float32)
    total = np.zeros((atlas.size, atlas.size), np.float32)
    corners = mesh.vertices[mesh.triangles].astype(np.float32)
    layout = (atlas.corner, atlas.length, atlas.way)
    count = len(photos.intrinsics)
    with closing(ahead(photos.images)) as images:
        for index, (image, camera, pose) in enumerate(zip(images, photos.intrinsics, photos.world_from_camera, strict=True)):
            progress.check()
            share = np.where(which == index, best, 0).sum(axis=1).astype(np.float32)[mesh.triangles]  # (T, 3)
            matrix = (camera.matrix() @ invert(pose)[:3]).astype(np.float32)
            add_image(np.flatnonzero(share.any(axis=1)), corners, share, *layout, np.ascontiguousarray(image), matrix, texture, total)
            progress.update(count + index + 1, 2 * count, "texture")
    means = np.zeros((len(corners), 3), np.float32)
    finish(corners, mesh.colours[mesh.triangles].astype(np.float32), *layout, texture, total, means)
    shift(_level(mesh, means)[mesh.triangles], *layout, texture)
    return atlas, np.rint(np.clip(texture, 0, 255, out=texture), out=texture).astype(np.uint8)  # a large one takes 200 MB: not once more


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


def vertex_visibility(mesh: Mesh, photos: Photos, progress: Progress = SILENT) -> Array:
    """(V, N) float32 how well each image shows each vertex: the power `SHARP` of its pixels per unit of length there, less towards what
    hides something, times its worth; 0: not at all."""
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(mesh.to_open3d()))
    normals = mesh.normals if mesh.normals is not None else np.zeros_like(mesh.vertices)
    out = np.zeros((len(mesh.vertices), len(photos.intrinsics)), np.float32)
    for index, (camera, pose) in enumerate(zip(photos.intrinsics, photos.world_from_camera, strict=True)):
        progress.check()
        factor = min(1.0, SIDE / max(camera.width, camera.height))
        small = camera.scaled(max(1, round(camera.width * factor)), max(1, round(camera.height * factor)))
        depth, clear = _seen_depth(scene, small, pose, photos.valid[index] if len(photos.valid) else None)
        local = (mesh.vertices - pose[:3, 3]) @ pose[:3, :3]
        z = np.maximum(local[:, 2], 1e-9)
        u, v = local[:, 0] / z * small.fx + small.cx, local[:, 1] / z * small.fy + small.cy
        inside = (local[:, 2] > 0) & (u >= 0) & (u < small.width) & (v >= 0) & (v < small.height)
        column, row = np.where(inside, u, 0).astype(int), np.where(inside, v, 0).astype(int)
        cosine = -np.einsum("ij,ij->i", normals @ pose[:3, :3], local) / np.maximum(np.linalg.norm(local, axis=1), 1e-9)
        seen = inside & (local[:, 2] <= depth[row, column] * (1 + BEHIND)) & (cosine > 0)
        resolution = np.maximum(cosine, 0) * camera.fx / z
        out[:, index] = np.where(seen, clear[row, column] * resolution**SHARP, 0)
        progress.update(index + 1, 2 * len(photos.intrinsics), "texture")
    return out * np.asarray(photos.worth, np.float32) if len(photos.worth) else out


def strongest(weights: Array) -> tuple[Array, Array]:
    """(V, N) weights → (V, K ≤ BEST) images and (V, K) what they count, less what the next one would; sums are 1, or 0 where nothing is
    seen."""
    count = min(BEST, weights.shape[1])
    order = np.argsort(-weights, axis=1, kind="stable")
    which = order[:, :count]
    best = whole = np.take_along_axis(weights, which, axis=1)
    if weights.shape[1] > count:
        best = whole - np.take_along_axis(weights, order[:, count : count + 1], axis=1)
        alike = best.sum(axis=1) <= ALIKE * whole.sum(axis=1)  # the same image several times: any of them will do
        best[alike] = whole[alike]
    total = best.sum(axis=1, keepdims=True)
    return which, np.where(total > 0, best / np.maximum(total, 1e-30), 0).astype(np.float32)


def _seen_depth(scene: Any, camera: Intrinsics, pose: Array, valid: Array | None) -> tuple[Array, Array]:
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
