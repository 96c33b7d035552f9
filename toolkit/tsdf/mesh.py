"""A triangle mesh in NumPy arrays: move it between frames, remove what is not surface, smooth it, thin it out; and views of it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import fast_simplification
import numpy as np
import open3d as o3d
import open3d.core as o3c
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from fieldfuse.camera import Array, Intrinsics, Similarity
from fieldfuse.errors import InputError

HASTE = (3, 5, 7, 10)  # of thinning out: the most careful that gets there is taken, each going on where the one before ended …
OVER = 0.05  # … when there are no more than so many triangles too many
RAYS_AT_ONCE = 1 << 20


@dataclass(frozen=True)
class Mesh:
    """A triangle soup with shared vertices. The frame and the unit of length are the caller's."""

    vertices: Array  # (V, 3) float64
    triangles: Array  # (T, 3) int32 indices into vertices, counter-clockwise seen from outside
    colours: Array  # (V, 3) uint8
    normals: Array | None = None  # (V, 3) float64 unit length, out of the surface

    @classmethod
    def create(cls, vertices: Array, triangles: Array, colours: Array | None = None, normals: Array | None = None) -> Mesh:
        """From arrays of any number type; a missing colour is mid grey, floating-point colours are taken as 0 to 1.

        Raises:
            InputError: shapes that do not fit each other, an index without a vertex, or a position that is not finite.
        """
        vertices = np.asarray(vertices, dtype=np.float64).reshape(-1, 3)
        triangles = np.asarray(triangles, dtype=np.int32).reshape(-1, 3)
        if colours is None:
            colours = np.full((len(vertices), 3), 128, np.uint8)
        mesh = cls(vertices, triangles, as_bytes(colours), None if normals is None else np.asarray(normals, dtype=np.float64))
        for name, array in (("colours", mesh.colours), ("normals", mesh.normals)):
            if array is not None and array.shape != vertices.shape:
                raise InputError(f"a mesh of {len(vertices)} vertices has {name} of shape {array.shape}; one row a vertex is needed")
        if len(triangles) and not 0 <= triangles.min() <= triangles.max() < len(vertices):
            raise InputError(f"a mesh of {len(vertices)} vertices has a triangle that points to vertex {triangles.max()}; it is damaged")
        if not np.isfinite(vertices).all():
            raise InputError("a mesh has vertices that are not finite; the mesh is damaged")
        return mesh

    @classmethod
    def empty(cls) -> Mesh:
        return cls(np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.uint8), np.zeros((0, 3)))

    def transformed(self, similarity: Similarity) -> Mesh:
        """The same mesh in the frame that `similarity` leads to (its inverse undoes it)."""
        normals = None if self.normals is None else similarity.directions(self.normals)
        return replace(self, vertices=similarity.points(self.vertices), normals=normals)

    def bounds(self) -> Array:
        """(2, 3) smallest and largest corner; zeros for an empty mesh."""
        if len(self.vertices) == 0:
            return np.zeros((2, 3))
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    def areas(self) -> Array:
        """(T,) area of each triangle."""
        a, b, c = (self.vertices[self.triangles[:, i]] for i in range(3))
        return np.asarray(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1))

    def facing(self, triangles: Array) -> Array:
        """(N, 3) unit normals of the triangles (N,); zero where one has no area."""
        a, b, c = (self.vertices[self.triangles[triangles, corner]] for corner in range(3))
        across = np.cross(b - a, c - a)
        return np.asarray(across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), np.finfo(np.float64).tiny))

    def components(self) -> Array:
        """(T,) int32: the connected component of each triangle (triangles that share an edge are connected), largest number unknown."""
        from_, to = self.triangles.reshape(-1).astype(np.int64), np.roll(self.triangles, -1, axis=1).reshape(-1)
        edges = np.minimum(from_, to) * len(self.vertices) + np.maximum(from_, to)  # the same number for the same two vertices
        order = np.argsort(edges)
        shared = np.flatnonzero(np.diff(edges[order]) == 0)
        pairs = order[shared] // 3, order[shared + 1] // 3
        graph = coo_array((np.ones(len(shared), bool), pairs), shape=(len(self.triangles),) * 2)
        return np.asarray(connected_components(graph, directed=False)[1])

    def cleaned(self, min_area_share: float = 0.0) -> Mesh:
        """Without degenerate and repeated triangles, small components, and vertices that nothing uses.

        Args:
            min_area_share: components with less than this share of the whole area go; the largest one always stays.
        """
        degenerate = (self.triangles[:, [0, 1, 2]] == self.triangles[:, [1, 2, 0]]).any(axis=1) | (self.areas() <= 0)
        triangles = self.triangles[~degenerate]
        rows = np.sort(triangles, axis=1)
        order, new = np.lexsort(rows.T), np.ones(len(rows), bool)  # stable, so that of equal rows the first comes first
        new[1:] = (np.diff(rows[order], axis=0) != 0).any(axis=1)
        mesh = replace(self, triangles=triangles[np.sort(order[new])])
        if min_area_share > 0 and len(mesh.triangles):
            label = mesh.components()
            area = np.bincount(label, weights=mesh.areas())
            keep = area >= min_area_share * area.sum()
            keep[np.argmax(area)] = True
            mesh = replace(mesh, triangles=mesh.triangles[keep[label]])
        used = np.zeros(len(mesh.vertices), bool)
        used[mesh.triangles.reshape(-1)] = True
        number = np.cumsum(used, dtype=np.int32) - np.int32(1)
        normals = None if mesh.normals is None else mesh.normals[used]
        return Mesh(mesh.vertices[used], number[mesh.triangles].astype(np.int32), mesh.colours[used], normals)

    def ordered(self) -> Mesh:
        """The same mesh, vertices and triangles in an order that only their values decide.

        Open3D's threads number vertices and triangles as they come to them, so that one volume gives its mesh in another order each time,
        and with it other sums, other files and another decimation.
        """
        order = places(self.vertices, self.colours, self.normals)
        number = np.empty(len(order), np.int32)
        number[order] = np.arange(len(order), dtype=np.int32)
        triangles = number[self.triangles]
        first = np.argmin(triangles, axis=1)[:, None] if len(triangles) else np.zeros((0, 1), np.int64)
        triangles = np.take_along_axis(triangles, (first + np.arange(3)) % 3, axis=1)
        triangles = triangles[np.lexsort(triangles.T[::-1])]
        normals = None if self.normals is None else self.normals[order]
        return Mesh(self.vertices[order], triangles, self.colours[order], normals)

    def smoothed(self, rounds: int) -> Mesh:
        """Without the ripples that a lattice and noise leave: each vertex goes to the mean of its neighbours, `rounds` times.

        Vertices of open borders stay where they are, so that what was seen in part does not shrink. Colours stay with their vertices.
        """
        count = len(self.vertices)
        if rounds == 0 or len(self.triangles) == 0:
            return self
        sides = self.triangles.reshape(-1), np.roll(self.triangles, -1, axis=1).reshape(-1)
        once = coo_array((np.ones(len(sides[0])), sides), shape=(count, count)).tocsr()
        beside = once + once.T  # of two vertices: how many triangles have the edge between them
        share = beside.sum(axis=1)
        each = beside.tocoo()
        moves = share > 0
        moves[each.row[each.data == 1]] = False  # an edge of one triangle is a border
        vertices = self.vertices
        for _ in range(rounds):
            vertices = np.where(moves[:, None], (beside @ vertices) / np.maximum(share, 1)[:, None], self.vertices)
        normals = None if self.normals is None else replace(self, vertices=vertices, normals=None).with_normals().normals
        return replace(self, vertices=vertices, normals=normals)

    def decimated(self, max_triangles: int) -> Mesh:
        """At most about `max_triangles` triangles, by quadric edge collapse (Garland and Heckbert 1997); as it is when it has no more.

        Colours are those of the nearest places of this mesh, normals those of the triangles that are left.
        """
        if len(self.triangles) <= max_triangles:
            return self
        points, triangles = self.vertices, self.triangles
        for haste in HASTE:
            points, triangles = fast_simplification.simplify(points, triangles.astype(np.int32), target_count=max_triangles, agg=haste)
            if len(triangles) <= (1 + OVER) * max_triangles:
                break
        thin = Mesh.create(points, triangles).cleaned()
        middle = self.bounds().mean(axis=0)
        found = ray_scene(self, middle).compute_closest_points(o3c.Tensor.from_numpy((thin.vertices - middle).astype(np.float32)))
        share = found["primitive_uvs"].numpy()
        share = np.concatenate([1 - share.sum(axis=1, keepdims=True), share], axis=1)
        corners = self.colours[self.triangles[found["primitive_ids"].numpy().astype(np.int64)]]
        thin = replace(thin, colours=np.round(np.einsum("nck,nc->nk", corners, share)).clip(0, 255).astype(np.uint8))
        return thin if self.normals is None else thin.with_normals()

    def with_normals(self) -> Mesh:
        """As it is if it has normals, else with those of the triangles around each vertex, by area."""
        if self.normals is not None:
            return self
        legacy = self.to_open3d()
        legacy.compute_vertex_normals()
        return replace(self, normals=np.asarray(legacy.vertex_normals, dtype=np.float64))

    def to_open3d(self) -> o3d.geometry.TriangleMesh:
        """As Open3D's (legacy, float64) triangle mesh."""
        out = o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(self.vertices), o3d.utility.Vector3iVector(self.triangles))
        out.vertex_colors = o3d.utility.Vector3dVector(self.colours / 255.0)
        if self.normals is not None:
            out.vertex_normals = o3d.utility.Vector3dVector(self.normals)
        return out


def places(positions: Array, *others: Array | None) -> Array:
    """(N,) int64 indices that sort (N, 3) `positions` by x, then y, then z; `others` (N, C) decide between equal ones."""
    order = np.lexsort(positions.T[::-1])
    there = positions[order]
    if len(there) > 1 and (there[1:] == there[:-1]).all(axis=1).any():
        columns = np.concatenate([positions, *(np.asarray(other, np.float64) for other in others if other is not None)], axis=1)
        order = np.lexsort(columns.T[::-1])
    return np.asarray(order)


def as_bytes(colours: Array) -> Array:
    """Colours as uint8: whole numbers are kept, floating-point ones are taken as 0 to 1 and rounded."""
    colours = np.asarray(colours)
    if colours.dtype.kind == "f":
        return np.round(np.clip(np.nan_to_num(colours), 0, 1) * 255).astype(np.uint8)
    return np.clip(colours, 0, 255).astype(np.uint8)


def ray_scene(mesh: Mesh, origin: Array) -> o3d.t.geometry.RaycastingScene:
    """The mesh, shifted by −`origin`, ready for rays and distances."""
    scene = o3d.t.geometry.RaycastingScene()
    if len(mesh.triangles):
        vertices = np.ascontiguousarray(mesh.vertices - origin, dtype=np.float32)
        scene.add_triangles(o3c.Tensor.from_numpy(vertices), o3c.Tensor.from_numpy(mesh.triangles.astype(np.uint32)))
    return scene


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
        self.mesh, self.scene = mesh, ray_scene(mesh, np.zeros(3))

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
