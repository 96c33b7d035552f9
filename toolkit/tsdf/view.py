"""Views of a mesh: colour, depth and mask by ray casting, colours interpolated between vertices."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import open3d as o3d
import open3d.core as o3c

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.tsdf.mesh import Mesh

RAYS_AT_ONCE = 1 << 20


@dataclass(frozen=True)
class MeshView:
    """What a camera sees of a mesh."""

    rgb: Array  # (H, W, 3) float32 in [0, 1]; 0 where there is no surface
    depth: Array  # (H, W) float32 along z; 0 where there is no surface
    mask: Array  # (H, W) bool: there is surface

    @property
    def opacity(self) -> Array:
        """(H, W) float32: 1 where there is surface, as a rendered field has it."""
        return self.mask.astype(np.float32)


class SurfaceCaster:
    """A mesh prepared for ray casting (on the CPU, with Open3D's Embree scene)."""

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self.scene = o3d.t.geometry.RaycastingScene()
        if len(mesh.triangles):
            vertices, triangles = mesh.vertices.astype(np.float32), mesh.triangles.astype(np.uint32)
            self.scene.add_triangles(o3c.Tensor.from_numpy(vertices), o3c.Tensor.from_numpy(triangles))

    def render(self, intrinsics: Intrinsics, world_from_camera: Array) -> MeshView:
        """The view of a camera without lens distortion (its pinhole is used)."""
        height, width = intrinsics.height, intrinsics.width
        rgb = np.zeros((height, width, 3), np.float32)
        depth = np.zeros((height, width), np.float32)
        if len(self.mesh.triangles) == 0:
            return MeshView(rgb, depth, depth > 0)
        step = max(1, RAYS_AT_ONCE // width)
        for top in range(0, height, step):
            rows = slice(top, min(top + step, height))
            rgb[rows], depth[rows] = self._rows(intrinsics, np.asarray(world_from_camera, dtype=np.float64), rows)
        return MeshView(rgb, depth, depth > 0)

    def _rows(self, intrinsics: Intrinsics, pose: Array, rows: slice) -> tuple[Array, Array]:
        v, u = np.mgrid[rows, 0 : intrinsics.width].astype(np.float64)
        # Directions with z = 1 in the camera's frame, so that the ray's parameter is depth along z.
        camera = np.stack([(u + 0.5 - intrinsics.cx) / intrinsics.fx, (v + 0.5 - intrinsics.cy) / intrinsics.fy, np.ones_like(u)], axis=-1)
        directions = camera @ pose[:3, :3].T
        rays = np.concatenate([np.broadcast_to(pose[:3, 3], directions.shape), directions], axis=-1).astype(np.float32)
        hits = self.scene.cast_rays(o3c.Tensor.from_numpy(rays))
        distance = hits["t_hit"].numpy()
        hit = np.isfinite(distance) & (distance > 0)
        corner = self.mesh.triangles[hits["primitive_ids"].numpy()[hit]]  # (hits, 3)
        second, third = np.moveaxis(hits["primitive_uvs"].numpy()[hit], -1, 0)
        share = np.stack([1 - second - third, second, third], axis=-1).astype(np.float32)
        rgb = np.zeros((*hit.shape, 3), np.float32)
        rgb[hit] = np.einsum("nk,nkc->nc", share, self.mesh.colours[corner].astype(np.float32) / 255)
        return np.clip(rgb, 0, 1), np.where(hit, distance, 0).astype(np.float32)
