"""A texture for a mesh, from the pictures that it was made of: each texel is a mean over those that see it best (`sighted.py`).

Pictures differ in brightness, and shiny things in each of them. So in the large the texture has the colours of the vertices, which are a
mean over all pictures, and only what is smaller is the best pictures' own.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from fieldfuse.camera import Array, Intrinsics, invert
from fieldfuse.export.atlas import Atlas, make_atlas
from fieldfuse.export.sighted import SHARP, picture_weights, strongest
from fieldfuse.export.texels import add_picture, finish, shift
from fieldfuse.progress import SILENT, Progress
from fieldfuse.tsdf.mesh import Mesh

LARGEST = 4096  # texels along a texture
FINE_SHARE = 0.75  # of the surface that has texels as small as its pixels; a little that is seen from very near does not decide for all
EVENED = 8  # rounds of even mixing with the neighbours: differences in colour over less than some three triangles are the pictures' own


def textured(
    mesh: Mesh,
    images: Iterable[Array],
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
        images: (H, W, 3) uint8 RGB, asked for once, one after the other; intrinsics: pinhole, of the same sizes.
        world_from_camera: (N, 4, 4).
        valid: (H, W) bool pixels that may be looked at, in whatever size, None: all; empty: all of all pictures.
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
    images: Iterable[Array],
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
        add_picture(seen, corners, share, *layout, np.ascontiguousarray(image), matrix, texture, total)
        progress.update(len(intrinsics) + index + 1, 2 * len(intrinsics), "texture")
    means = np.zeros((len(corners), 3), np.float32)
    finish(corners, mesh.colours[mesh.triangles].astype(np.float32), *layout, texture, total, means)
    shift(_level(mesh, means)[mesh.triangles], *layout, texture)
    return np.rint(np.clip(texture, 0, 255, out=texture), out=texture).astype(np.uint8)  # a large one takes 200 MB: not once more


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


def _quantile(values: Array, weights: Array, share: float) -> float:
    """The value below which so large a share of the weights lies."""
    order = np.argsort(values)
    below = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(below, share * below[-1])]) if len(values) else 0.0
