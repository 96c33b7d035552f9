"""Similarities and shapes for tests of models of any size, 6,000 km away."""

from __future__ import annotations

import numpy as np
import trimesh

from fieldfuse.camera import Array, Similarity
from fieldfuse.tsdf.mesh import Mesh

EARTH = 6.0e6  # metres from an earth-centred frame's origin
SCALES = (1e-3, 1.0, 1e3)


def rotation(seed: int) -> Array:
    """(3, 3) random rotation."""
    matrix = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    return matrix * np.sign(np.linalg.det(matrix))


def similarity(scale: float, away: float, seed: int) -> Similarity:
    direction = np.random.default_rng(seed + 1).normal(size=3)
    return Similarity(scale, rotation(seed), away * direction / np.linalg.norm(direction))


def ball() -> Mesh:
    """A closed surface of radius about 1 with a dent, in the working frame."""
    shape = trimesh.creation.icosphere(subdivisions=2)
    vertices = np.asarray(shape.vertices) * (1 + 0.2 * np.sin(5 * shape.vertices[:, :1]))
    normals = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    colours = (127.5 + 127 * normals).astype(np.uint8)
    return Mesh.create(vertices + np.array([0.3, -0.1, 0.5]), np.asarray(shape.faces), colours, normals)
