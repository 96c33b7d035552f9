"""Convex solids that a procedural scene is made of: boxes, rooms (a box seen from inside), ellipsoids and cylinders; and their
triangles."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import ArrayLike

from fieldfuse.backends import dispatch
from fieldfuse.backends.numba import cast as compiled
from fieldfuse.camera import Array
from fieldfuse.threads import share, slices

Tensor = torch.Tensor

BOX, ROOM, BALL, CYLINDER = "box", "room", "ball", "cylinder"
KINDS = (BOX, ROOM, BALL, CYLINDER)
FAR = float(compiled.FAR)
FEW = 4096  # rays below which threads do not pay
THINNEST = 5e-4  # metres: half sizes below this lose the face that was hit in float32
ROUND = 48  # corners of a circle in triangles: its flat sides lie within 0.2% of the radius


@dataclass(frozen=True)
class Mesh:
    """Triangles of a scene's surfaces."""

    vertices: Array  # (V, 3) float64 metres
    triangles: Array  # (F, 3) int64, counter-clockwise from outside


@dataclass(frozen=True)
class Solid:
    """One convex solid, centred in its own axes.

    Attributes:
        kind: "box"; "room": the inner side of a box; "ball": an ellipsoid; "cylinder": elliptic, along its third axis, with both caps.
        centre: (3,) metres.
        half: (3,) half sizes along the own axes, metres.
        rotation: (3, 3), columns are the own axes in the world.
        materials: one number of the scene's materials for all faces, or one a face. Faces of boxes, rooms and balls (by the
            dominant axis): +x, −x, +y, −y, +z, −z. Faces of cylinders: the side, the cap at +z, the cap at −z.
    """

    kind: str
    centre: Array
    half: Array
    rotation: Array
    materials: tuple[int, ...]


def upright(kind: str, centre: ArrayLike, half: ArrayLike, materials: int | tuple[int, ...], degrees: float = 0.0) -> Solid:
    """A solid turned only about the vertical (z)."""
    angle = np.deg2rad(degrees)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    faces = (materials,) if isinstance(materials, int) else tuple(materials)
    return Solid(kind, np.asarray(centre, dtype=np.float64), np.asarray(half, dtype=np.float64), turn, faces)


def rod(start: ArrayLike, end: ArrayLike, radius: float, material: int) -> Solid:
    """A round cylinder between two points."""
    start, end = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    along = end - start
    length = float(np.linalg.norm(along))
    z = along / length
    x = np.cross([0.0, 0.0, 1.0] if abs(z[2]) < 0.9 else [1.0, 0.0, 0.0], z)
    x /= np.linalg.norm(x)
    return Solid(CYLINDER, (start + end) / 2, np.array([radius, radius, length / 2]), np.stack([x, np.cross(z, x), z], axis=1), (material,))


class Solids:
    """All solids of a scene as tensors, sorted by kind."""

    def __init__(self, solids: list[Solid], device: torch.device | str = "cpu") -> None:
        self.items = sorted(solids, key=lambda solid: KINDS.index(solid.kind))
        ends = np.cumsum([sum(solid.kind == kind for solid in self.items) for kind in KINDS]).tolist()
        self.ranges = dict(zip(KINDS, pairwise([0, *ends]), strict=True))  # kind → first and past-the-last number
        half = np.array([np.maximum(solid.half, THINNEST) for solid in self.items]).reshape(-1, 3)
        # Of a sphere around each, a little more: a ball's is its largest half size, and a room is met by every ray.
        balls, rooms = slice(*self.ranges[BALL]), slice(*self.ranges[ROOM])
        radius = np.linalg.norm(half, axis=1)
        radius[balls], radius[rooms] = half[balls].max(axis=1, initial=0), np.inf
        radius = 1.001 * radius + 1e-4

        def stack(rows: object, *shape: int) -> Tensor:
            return torch.tensor(np.array(rows, dtype=np.float32).reshape(-1, *shape), device=device)

        self.centre = stack([solid.centre for solid in self.items], 3)  # (P, 3)
        self.half, self.radius, self.ends = stack(half, 3), stack(radius), torch.tensor(ends, device=device)  # (P, 3), (P,), (4,)
        self.rotation = stack([solid.rotation for solid in self.items], 3, 3)  # (P, 3, 3)
        faces = [[solid.materials[min(face, len(solid.materials) - 1)] for face in range(6)] for solid in self.items]
        self.materials = torch.tensor(faces, dtype=torch.int64, device=device).reshape(-1, 6)  # (P, 6)

    def __len__(self) -> int:
        return len(self.items)

    def to(self, device: torch.device | str) -> Solids:
        return Solids(self.items, device)

    def cast(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """First hits of rays, exact: compiled on CPUs, by Triton on CUDA.

        Args:
            origins: (N, 3), or (1, 3) for rays from one place.
            directions: (N, 3) unit vectors.

        Returns:
            distance (N,), `FAR` where nothing is hit, and the number of the solid (N,) int64, −1 where nothing is hit. A solid that
            the ray starts in is not seen (rooms are seen from inside).
        """
        if dispatch.can_use_triton(origins, directions):
            from fieldfuse.backends.triton import cast as cast_gpu

            return cast_gpu.cast(self, origins, directions, FAR, float(compiled.NEAREST))
        starts, rays = (values.contiguous().cpu().numpy() for values in (origins, directions))
        distance, number = torch.empty(len(rays)), torch.empty(len(rays), dtype=torch.int64)
        shapes = [values.cpu().numpy() for values in (self.centre, self.half, self.rotation, self.radius, self.ends)]

        def part(some: slice) -> None:
            own = starts if len(starts) == 1 else starts[some]
            compiled.cast(own, rays[some], *shapes, distance[some].numpy(), number[some].numpy())

        threads = torch.get_num_threads() if len(rays) > FEW else 1
        share(part, slices(len(rays), 4 * threads if threads > 1 else 1), threads)
        return distance.to(directions.device), number.to(directions.device)

    def surface(self, numbers: Tensor, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Where points on the surface of solids lie, in the solids' own terms.

        Args:
            numbers: (N,) which solid.
            points: (N, 3) on its surface.

        Returns:
            face (N,) int64, texture place (N, 2) in metres along the face, and the visible side's unit normal (N, 3) in the world.
        """
        turn, half = self.rotation[numbers], self.half[numbers]
        local = (turn * (points - self.centre[numbers])[:, :, None]).sum(1)  # (N, 3)
        unit = local / half
        axis = unit.abs().argmax(1)
        positive = unit.gather(1, axis[:, None])[:, 0] > 0
        face = 2 * axis + (~positive).long()
        # The two other axes; the vertical one, where there is one, is the texture's downward direction.
        across = torch.where(axis == 0, 1, 0)[:, None]
        down = torch.where(axis == 2, 1, 2)[:, None]
        side = torch.where((axis == 1) == positive, -1.0, 1.0)
        first, last = self.ranges[ROOM]
        inside = (numbers >= first) & (numbers < last)
        side = torch.where(inside, -side, side)  # seen from the other side, left and right change places
        place = torch.stack([local.gather(1, across)[:, 0] * side, -local.gather(1, down)[:, 0]], dim=1)
        normal = torch.zeros_like(local).scatter_(1, axis[:, None], torch.where(positive, 1.0, -1.0)[:, None])
        normal = torch.where(inside[:, None], -normal, normal)
        round_ones = (numbers >= self.ranges[BALL][0]).nonzero()[:, 0]
        if len(round_ones):
            place[round_ones], normal[round_ones], face[round_ones] = self._round(
                numbers[round_ones], local[round_ones], half[round_ones], face[round_ones], place[round_ones]
            )
        return face, place, (turn * normal[:, None, :]).sum(2)

    def _round(self, numbers: Tensor, local: Tensor, half: Tensor, face: Tensor, place: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Place, own normal and face on balls and cylinders."""
        unit = local / half
        cylinder = numbers >= self.ranges[CYLINDER][0]
        radial = unit[:, :2].norm(dim=1)
        cap = cylinder & (unit[:, 2].abs() > radial)
        side = cylinder & ~cap
        normal = unit / half  # gradient of the ellipsoid's |unit|²
        normal[cylinder, 2] = 0
        normal[cap] = unit[cap] * normal.new_tensor([0.0, 0.0, 1.0])
        normal = torch.nn.functional.normalize(normal, dim=1)
        angle = torch.atan2(unit[side, 1], unit[side, 0])
        place[side] = torch.stack([angle * half[side, :2].mean(1), -local[side, 2]], dim=1)
        place[cap] = local[cap, :2]
        face = torch.where(side, 0, torch.where(cap, 1 + (unit[:, 2] < 0).long(), face))
        return place, normal, face

    def clearance(self, points: Tensor) -> Tensor:
        """(N,) distance from (N, 3) points to the nearest surface; negative inside a solid or outside a room. Ellipsoids: a bound."""
        local = torch.einsum("pij,npi->npj", self.rotation, points[:, None] - self.centre[None])  # (N, P, 3)
        out = []
        excess = local.abs() - self.half
        boxes = excess.clamp(min=0).norm(dim=2) + excess.amax(2).clamp(max=0)
        for kind, (first, last) in self.ranges.items():
            part = slice(first, last)
            if kind == BOX:
                out.append(boxes[:, part])
            elif kind == ROOM:
                out.append(-boxes[:, part])
            elif kind == BALL:
                unit = local[:, part] / self.half[part]
                size, slope = unit.norm(dim=2), (unit / self.half[part]).norm(dim=2)
                out.append(size * (size - 1) / slope.clamp(min=1e-9))
            else:
                radial = (local[:, part, :2].norm(dim=2) - self.half[part, :2].amin(1))[..., None]
                both = torch.cat([radial, excess[:, part, 2:]], dim=2)
                out.append(both.clamp(min=0).norm(dim=2) + both.amax(2).clamp(max=0))
        return torch.cat(out, dim=1).amin(1)


def tessellate(solids: list[Solid]) -> Mesh:
    """Each solid on its own, counter-clockwise from the visible side. Round ones are inscribed polyhedra."""
    vertices, triangles, count = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)], 0
    for solid in solids:
        unit, faces = _unit(solid.kind)
        vertices.append((unit * solid.half) @ solid.rotation.T + solid.centre)
        triangles.append((faces[:, ::-1] if solid.kind == ROOM else faces) + count)
        count += len(unit)
    return Mesh(np.concatenate(vertices), np.concatenate(triangles))


@lru_cache(maxsize=8)
def _unit(kind: str) -> tuple[Array, Array]:
    """Vertices and triangles of the solid with half sizes of 1; round ones are turned about z, ring by ring from the top."""
    if kind in (BOX, ROOM):
        corners = np.array([[x, y, z] for x in (-1.0, 1) for y in (-1.0, 1) for z in (-1.0, 1)])
        quads = np.array([[4, 6, 7, 5], [0, 1, 3, 2], [2, 3, 7, 6], [0, 4, 5, 1], [1, 5, 7, 3], [0, 2, 6, 4]])
        return corners, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    down = np.linspace(0, np.pi, ROUND // 2 + 1)
    heights, radii = (np.cos(down), np.sin(down)) if kind == BALL else (np.array([1.0, 1, -1, -1]), np.array([0.0, 1, 1, 0]))
    radii = np.where(radii > 1e-9, radii, 0)
    angle = 2 * np.pi * np.arange(ROUND) / ROUND
    rings = np.stack(np.broadcast_arrays(np.outer(radii, np.cos(angle)), np.outer(radii, np.sin(angle)), heights[:, None]), axis=-1)
    here = np.arange(len(radii) - 1)[:, None] * ROUND + np.arange(ROUND)
    following = np.roll(here, -1, axis=1)
    lower = np.stack([here, here + ROUND, following + ROUND], axis=-1)[radii[1:] > 0]  # a ring of radius 0 is a point
    upper = np.stack([here, following + ROUND, following], axis=-1)[radii[:-1] > 0]
    return rings.reshape(-1, 3), np.concatenate([lower, upper]).reshape(-1, 3)
