"""Pictures of meshes for people: in their own colours, as grey shape, and coloured by distance from the true surface."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.evaluation.geometry import distances
from fieldfuse.evaluation.pictures import ERROR_COLOURS, coloured
from fieldfuse.render.paths import look_at
from fieldfuse.tsdf.mesh import Mesh, SurfaceCaster

ERROR_VOXELS = 4.0  # distance from the truth that gets the brightest colour
NOTHING = (226, 230, 235)  # where no surface is
ELEVATION = np.deg2rad(40)
FIELD_OF_VIEW = np.deg2rad(42)
CLOSE = 0.8  # distance of the eye in the view from outside; at 1 the region's bounding sphere fits in, corners and all
BEYOND = 1.15  # what lies farther out than this times the region is cut off in the view from outside


@dataclass(frozen=True)
class MeshPictures:
    """One view of several meshes: kind → method → (H, W, 3) uint8. "truth" is among the methods where there is a true mesh."""

    title: str
    kinds: dict[str, dict[str, Array]]


def mesh_pictures(
    meshes: Mapping[str, Mesh],
    truth: Mesh | None,
    views: list[tuple[str, Intrinsics, Array]],
    voxel_size: float,
    cut: tuple[Array, Array] | None = None,
) -> list[MeshPictures]:
    """Pictures of all meshes (one frame and unit) from each of `views` (title, camera, pose).

    Args:
        voxel_size: unit of the colours of "distance", which go up to `ERROR_VOXELS` of it.
        cut: box (lowest and highest corner); when given, triangles outside it and those that face away are left out, so that one looks
            into a room from outside as into a doll's house.
    """
    out = [MeshPictures(title, {"coloured": {}, "shape": {}, "distance": {}}) for title, _, _ in views]
    for name, mesh in (("truth", truth), *meshes.items()):
        if mesh is None or not len(mesh.triangles):
            continue
        middle, normal = mesh.vertices[mesh.triangles].mean(axis=1), mesh.facing(np.arange(len(mesh.triangles)))
        gaps = None
        if name != "truth" and truth is not None:
            gap, _ = distances(middle, truth)
            gaps = coloured(gap[None] / (ERROR_VOXELS * voxel_size), ERROR_COLOURS)[0]
        for made, (_, camera, pose) in zip(out, views, strict=True):
            away = pose[:3, 3] - middle
            towards = (normal * away).sum(axis=1) / np.maximum(np.linalg.norm(away, axis=1), 1e-30)
            kept = np.ones(len(middle), bool)
            if cut is not None:
                kept = (towards > 0) & np.all((middle >= cut[0]) & (middle <= cut[1]), axis=1)
            part = replace(mesh, triangles=mesh.triangles[kept])
            # Grey, as lit from the eye and a little from above, either side alike.
            light = np.clip(0.25 + 0.6 * np.abs(towards[kept]) + 0.15 * np.abs(normal[kept, 2]), 0, 1)
            made.kinds["shape"][name] = picture(part, camera, pose, np.repeat(np.round(light * 235).astype(np.uint8)[:, None], 3, axis=1))
            if name != "truth":  # a true mesh has no colours of its own
                made.kinds["coloured"][name] = picture(part, camera, pose)
            if gaps is not None:
                made.kinds["distance"][name] = picture(part, camera, pose, gaps[kept])
    return [replace(made, kinds={kind: by_name for kind, by_name in made.kinds.items() if by_name}) for made in out]


def picture(mesh: Mesh, camera: Intrinsics, pose: Array, triangle_colours: Array | None = None) -> Array:
    """(H, W, 3) uint8: a mesh in its vertices' colours, or flat in those of its triangles (T, 3) uint8."""
    if triangle_colours is not None:
        corners = mesh.vertices[mesh.triangles].reshape(-1, 3)
        mesh = Mesh(corners, np.arange(len(corners), dtype=np.int32).reshape(-1, 3), np.repeat(triangle_colours, 3, axis=0))
    seen = SurfaceCaster(mesh).render(camera, pose)
    rgb = np.round(seen.rgb * 255).astype(np.uint8)
    rgb[~seen.mask] = NOTHING
    return rgb


def from_outside(
    centre: Array, half_size: Array, world_from_camera: Array, width: int = 640, height: int = 480
) -> tuple[Intrinsics, Array]:
    """A camera above the region (z up) that has nearly all of it in view, on the side where the captured cameras stand."""
    focal = 0.5 * height / np.tan(FIELD_OF_VIEW / 2)
    camera = Intrinsics(width, height, float(focal), float(focal), width / 2, height / 2)
    away = np.asarray(world_from_camera)[:, :2, 3].mean(axis=0) - centre[:2]
    azimuth = np.arctan2(away[1], away[0]) if np.linalg.norm(away) > 0.05 * np.linalg.norm(half_size) else np.deg2rad(-60)
    direction = np.array([np.cos(azimuth) * np.cos(ELEVATION), np.sin(azimuth) * np.cos(ELEVATION), np.sin(ELEVATION)])
    distance = CLOSE * float(np.linalg.norm(half_size)) / np.sin(FIELD_OF_VIEW / 2)
    return camera, look_at((centre + distance * direction)[None], centre, np.array([0.0, 0.0, 1.0]))[0]


def cut_box(centre: Array, half_size: Array) -> tuple[Array, Array]:
    """The box outside which nothing is shown from outside."""
    return centre - BEYOND * half_size, centre + BEYOND * half_size
