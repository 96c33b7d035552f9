"""Solids as triangles: the ground truth's mesh."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from fieldfuse.camera import Array
from fieldfuse.simulate.seen import Mesh
from fieldfuse.simulate.solids import BALL, CYLINDER, ROOM, Solid

ROUND = 48  # corners of a circle: its flat sides lie within 0.2% of the radius


def tessellate(solids: list[Solid]) -> Mesh:
    """Each solid on its own, counter-clockwise from the visible side. Round ones are inscribed polyhedra."""
    vertices, triangles, count = [], [], 0
    for solid in solids:
        unit, faces = _unit(solid.kind)
        vertices.append((unit * solid.half) @ solid.rotation.T + solid.centre)
        triangles.append((faces[:, ::-1] if solid.kind == ROOM else faces) + count)
        count += len(unit)
    if not vertices:
        return Mesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))
    return Mesh(np.concatenate(vertices), np.concatenate(triangles))


@lru_cache(maxsize=8)
def _unit(kind: str) -> tuple[Array, Array]:
    """Vertices and triangles of the solid with half sizes of 1."""
    if kind == BALL:
        return _rings(np.cos(np.linspace(0, np.pi, ROUND // 2 + 1)), np.sin(np.linspace(0, np.pi, ROUND // 2 + 1)))
    if kind == CYLINDER:
        return _rings(np.array([1.0, 1, -1, -1]), np.array([0.0, 1, 1, 0]))
    corners = np.array([[x, y, z] for x in (-1.0, 1) for y in (-1.0, 1) for z in (-1.0, 1)])
    quads = np.array([[4, 6, 7, 5], [0, 1, 3, 2], [2, 3, 7, 6], [0, 4, 5, 1], [1, 5, 7, 3], [0, 2, 6, 4]])
    return corners, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def _rings(heights: Array, radii: Array) -> tuple[Array, Array]:
    """A body of rotation from its top to its bottom; rings of radius 0 are points."""
    angle = np.arange(ROUND) * 2 * np.pi / ROUND
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    vertices: list[Array] = []
    triangles: list[Array] = []
    starts = []
    for height, radius in zip(heights, radii, strict=True):
        starts.append(len(vertices))
        ring = circle * radius if radius > 1e-9 else np.zeros((1, 2))
        vertices += list(np.column_stack([ring, np.full(len(ring), height)]))
    here = np.arange(ROUND)
    following = (here + 1) % ROUND
    for upper, lower, above, below in zip(starts[:-1], starts[1:], radii[:-1], radii[1:], strict=True):
        if below > 1e-9:
            triangles.append(np.stack([upper + here * (above > 1e-9), lower + here, lower + following], axis=1))
        if above > 1e-9:
            triangles.append(np.stack([upper + here, lower + following * (below > 1e-9), upper + following], axis=1))
    return np.array(vertices), np.concatenate(triangles)
