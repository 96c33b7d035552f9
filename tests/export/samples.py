"""Things to export: a coloured closed mesh, a similarity that turns, shrinks and shifts, cameras."""

from __future__ import annotations

import numpy as np
import trimesh

from fieldfuse.camera import FISHEYE, OPENCV, Array, Intrinsics, Similarity
from fieldfuse.render.paths import look_at
from fieldfuse.tsdf.mesh import Mesh


def coloured_ball(subdivisions: int = 3) -> Mesh:
    """A stretched ball with a random colour at each vertex."""
    made = trimesh.creation.icosphere(subdivisions, 1.0)
    colours = np.random.default_rng(0).integers(0, 256, made.vertices.shape).astype(np.uint8)
    return Mesh.create(made.vertices * [2.0, 3.0, 4.0] + [10.0, -20.0, 30.0], made.faces, colours, made.vertices)


def turned() -> Similarity:
    """Working frame from the input's: a hundredth of the size, turned about all axes, shifted."""
    rotation = trimesh.transformations.euler_matrix(0.3, -1.1, 2.0)[:3, :3]
    return Similarity(0.01, rotation, np.array([0.5, -0.25, 4.0]))


def cameras(count: int = 7) -> tuple[list[str], list[Intrinsics], Array]:
    """Names, intrinsics with three kinds of lens, and (count, 4, 4) poses."""
    rng = np.random.default_rng(1)
    poses = look_at(rng.normal(size=(count, 3)) * 5, np.array([0.3, 0.2, 0.1]), np.array([0.0, 0, 1]))
    kinds = [
        Intrinsics(640, 480, 500.5, 510.25, 321.75, 238.5),
        Intrinsics(640, 480, 500.5, 510.25, 321.75, 238.5, OPENCV, (-0.1, 0.02, 1e-3, -2e-3)),
        Intrinsics(800, 600, 400.0, 401.0, 402.0, 299.0, OPENCV, (-0.1, 0.02, 1e-3, -2e-3, 0.004, 0.01, -0.003, 0.001)),
        Intrinsics(320, 240, 150.0, 150.0, 160.0, 120.0, FISHEYE, (0.01, -0.002, 0.0003, 0.0)),
    ]
    return [f"frame {i}.png" for i in range(count)], [kinds[i % len(kinds)] for i in range(count)], poses
