"""Exports in the input's own frame: meshes, points and cameras of models 6,000 km away and of 1e-3 to 1e3 the usual size."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh

from fieldfuse.camera import FISHEYE, OPENCV, Array, Intrinsics, Similarity, invert, world_from_opengl
from fieldfuse.evaluation.selftest.case import Measure, absolute, case
from fieldfuse.evaluation.selftest.place import EARTH, SCALES, similarity
from fieldfuse.export.cameras import quaternion, write_cameras
from fieldfuse.export.mesh import write_mesh
from fieldfuse.export.ply import write_points
from fieldfuse.files import read_json
from fieldfuse.render.paths import look_at
from fieldfuse.tsdf.mesh import Mesh

GROUP = "scale and place"
RELATIVE = 1e-6  # of the model's size, in the input's coordinates
PLACES = tuple((scale, away) for scale in SCALES for away in (0.0, EARTH))


def ball() -> Mesh:
    """A closed surface of radius about 1 with a dent, in the working frame."""
    shape = trimesh.creation.icosphere(subdivisions=2)
    vertices = np.asarray(shape.vertices) * (1 + 0.2 * np.sin(5 * shape.vertices[:, :1]))
    normals = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    colours = (127.5 + 127 * normals).astype(np.uint8)
    return Mesh.create(vertices + np.array([0.3, -0.1, 0.5]), np.asarray(shape.faces), colours, normals)


def mesh_error(path: Path, mesh: Mesh, input_from_working: Similarity) -> float:
    """Largest distance of a vertex in the file from its place in the input's frame, by the model's size."""
    write_mesh(path, mesh, input_from_working.inverse())
    loaded = trimesh.load(path, process=False, maintain_order=True)
    read = _vertices(loaded)
    wanted = input_from_working.points(mesh.vertices)
    size = input_from_working.scale * float(np.ptp(mesh.vertices, axis=0).max())
    return absolute(read, wanted) / size


def _vertices(loaded: object) -> Array:
    if isinstance(loaded, trimesh.Scene):  # the place of a far model stands in its node's matrix
        (name,) = loaded.graph.nodes_geometry
        matrix, geometry = loaded.graph[name]
        return np.asarray(trimesh.transform_points(loaded.geometry[geometry].vertices, matrix))
    assert isinstance(loaded, trimesh.Trimesh | trimesh.PointCloud)
    return np.asarray(loaded.vertices)


def _label(scale: float, away: float) -> str:
    return f"×{scale:g}, {away / 1000:g} km away"


@case(GROUP, "meshes as PLY, OBJ and GLB in the input's coordinates")
def meshes(folder: Path) -> list[Measure]:
    mesh, out = ball(), []
    for scale, away in PLACES:
        placed = similarity(scale, away, 3)
        for suffix in ("ply", "obj", "glb"):
            error = mesh_error(folder / f"mesh.{suffix}", mesh, placed)
            out.append(Measure(f"{suffix}, {_label(scale, away)}, by the model's size", error, RELATIVE))
    return out


@case(GROUP, "points in the input's coordinates")
def points(folder: Path) -> list[Measure]:
    mesh, out = ball(), []
    for scale, away in PLACES:
        placed = similarity(scale, away, 4)
        path = folder / "points.ply"
        write_points(path, mesh.vertices, mesh.colours, mesh.normals, placed.inverse())
        read = _vertices(trimesh.load(path, process=False))
        size = scale * float(np.ptp(mesh.vertices, axis=0).max())
        error = absolute(read, placed.points(mesh.vertices)) / size
        out.append(Measure(f"{_label(scale, away)}, by the model's size", error, RELATIVE))
    return out


@case(GROUP, "cameras as transforms.json and COLMAP text in the input's coordinates")
def cameras(folder: Path) -> list[Measure]:
    poses = look_at(np.random.default_rng(0).normal(size=(6, 3)) * 2, np.zeros(3), np.array([0.0, 0, 1]))
    lenses = [
        Intrinsics(64, 48, 50.0, 51.0, 32.5, 23.5, OPENCV, (0.1, -0.02, 1e-3, -2e-3)),
        Intrinsics(64, 48, 1e-3, 1e7, -1e4, 1e4),
        Intrinsics(64, 48, 40.0, 40.0, 32.0, 24.0, FISHEYE, (0.1, 0.01, -0.003, 1e-4)),
    ] * 2
    out = []
    for scale, away in PLACES:
        placed = similarity(scale, away, 5)
        wanted = placed.poses(poses)
        names = [f"{index}.png" for index in range(6)]
        write_cameras(folder, names, lenses, poses, working_from_input=placed.inverse())
        frames = read_json(folder / "transforms.json")["frames"]
        read = np.array([world_from_opengl(np.array(frame["transform_matrix"])) for frame in frames])
        lines = [line.split() for line in (folder / "colmap" / "images.txt").read_text().splitlines() if line.endswith(".png")]
        centres = []
        for line in lines:
            w, x, y, z, *move = (float(word) for word in line[1:8])
            turn = np.array(
                [
                    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
                ]
            )
            centres.append(-turn.T @ np.array(move))
        size = scale * 4.0
        place = absolute(read[:, :3, 3], wanted[:, :3, 3]) / size
        out.append(Measure(f"transforms.json, {_label(scale, away)}, by the model's size", place, RELATIVE))
        out.append(Measure(f"rotations in transforms.json, {_label(scale, away)}", absolute(read[:, :3, :3], wanted[:, :3, :3]), 1e-12))
        bound = RELATIVE + 4e-15 * away / size  # the model stores -R·C, whose rounding 6,000 km away is some 1e-9 m
        out.append(
            Measure(f"COLMAP, {_label(scale, away)}, by the model's size", absolute(np.array(centres), wanted[:, :3, 3]) / size, bound)
        )
    return out


@case(GROUP, "quaternions of half turns, tiny turns and everything between")
def quaternions(folder: Path) -> list[Measure]:
    worst = 0.0
    for axis in ([1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0], [1.0, 1.0, 0], [1.0, -2.0, 3.0]):
        unit = np.array(axis) / np.linalg.norm(axis)
        cross = np.array([[0, -unit[2], unit[1]], [unit[2], 0, -unit[0]], [-unit[1], unit[0], 0]])
        for angle in (0.0, 1e-12, 1e-8, 1e-4, 1.0, np.pi - 1e-8, np.pi, np.pi + 1e-8):
            turn = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
            w, *rest = quaternion(turn)
            wanted = np.array([np.cos(angle / 2), *(np.sin(angle / 2) * unit)])
            got = np.array([w, *rest])
            worst = max(worst, min(absolute(got, wanted), absolute(got, -wanted)))
    return [
        Measure("quaternion of a rotation", worst, 1e-7),
        Measure("inverse of the inverse", absolute(invert(invert(np.eye(4))), np.eye(4)), 0.0),
    ]
