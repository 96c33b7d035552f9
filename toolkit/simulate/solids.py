"""Convex solids that a procedural scene is made of: boxes, rooms (a box seen from inside), ellipsoids and cylinders."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike

from fieldfuse.camera import Array

Tensor = torch.Tensor

BOX, ROOM, BALL, CYLINDER = "box", "room", "ball", "cylinder"
KINDS = (BOX, ROOM, BALL, CYLINDER)
THINNEST = 5e-4  # metres: half sizes below this lose the face that was hit in float32


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
        self.ranges: dict[str, tuple[int, int]] = {}  # kind → first and past-the-last number
        first = 0
        for kind in KINDS:
            count = sum(solid.kind == kind for solid in self.items)
            self.ranges[kind] = (first, first + count)
            first += count

        def stack(rows: list[Array], *shape: int) -> Tensor:
            return torch.tensor(np.array(rows, dtype=np.float32).reshape(-1, *shape), device=device)

        self.centre = stack([solid.centre for solid in self.items], 3)  # (P, 3)
        self.half = stack([np.maximum(solid.half, THINNEST) for solid in self.items], 3)  # (P, 3)
        self.rotation = stack([solid.rotation for solid in self.items], 3, 3)  # (P, 3, 3)
        faces = [_faces(solid.materials) for solid in self.items]
        self.materials = torch.tensor(faces, dtype=torch.int64, device=device).reshape(-1, 6)  # (P, 6)

    def __len__(self) -> int:
        return len(self.items)

    def to(self, device: torch.device | str) -> Solids:
        return Solids(self.items, device)

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


def _faces(materials: tuple[int, ...]) -> list[int]:
    return [materials[min(face, len(materials) - 1)] for face in range(6)]
