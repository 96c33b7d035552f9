"""Scale and place: similarities, pictures and exported files, from 1e-3 to 1e3 times the size and 6,000 km away."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from fieldfuse.camera import (
    FISHEYE,
    OPENCV,
    Array,
    Intrinsics,
    Similarity,
    invert,
    pixel_grid,
    rays,
    world_from_opengl,
)
from fieldfuse.export.cameras import quaternion, write_cameras
from fieldfuse.export.mesh import write_mesh
from fieldfuse.export.ply import write_points
from fieldfuse.files import read_json
from fieldfuse.render.image import render_view
from fieldfuse.render.paths import look_at
from fieldfuse.tsdf.mesh import Mesh
from fieldfuse.volume.space import Space
from tests.stability.hard.errors import absolute, largest, not_finite, relative
from tests.stability.hard.fields import small_field
from tests.stability.hard.places import EARTH, SCALES, ball, rotation, similarity
from tests.stability.hard.ranges import QUICK
from tests.stability.hard.within import Within

GROUP = "scale and place"
PSNR = 0.05  # dB


def similarity_errors(input_from_working: Similarity, points: Array) -> dict[str, float]:
    """Errors of a similarity against sums written out with `math.fsum`, and of going there and back, by the model's size.

    Far from the origin a place is known to its last float64 digit, which limits the precision.
    """
    digit = float(np.spacing(np.abs(input_from_working.translation).max())) / (input_from_working.scale * float(np.ptp(points)))
    there = input_from_working.points(points)
    written = np.array(
        [
            [
                math.fsum([*(input_from_working.scale * r * p for r, p in zip(row, point, strict=True)), move])
                for row, move in zip(input_from_working.rotation, input_from_working.translation, strict=True)
            ]
            for point in points
        ]
    )
    size = float(np.ptp(points))
    back = input_from_working.inverse().points(there)
    both = input_from_working.inverse().after(input_from_working)
    poses = np.tile(np.eye(4), (len(points), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotation(5), points
    returned = input_from_working.inverse().poses(input_from_working.poses(poses))
    moved = input_from_working.poses(poses)
    return {
        "points there": absolute(there, written) / (input_from_working.scale * size) / (1e-15 + 4 * digit),
        "points there and back": absolute(back, points) / size / (1e-14 + 8 * digit),
        "composed with its inverse": absolute(both.points(points), points) / size / (1e-14 + 8 * digit),
        "poses there and back": absolute(returned, poses) / size / (1e-14 + 8 * digit),
        "poses no longer rigid": absolute(moved[:, :3, :3] @ np.swapaxes(moved[:, :3, :3], 1, 2), np.tile(np.eye(3), (len(points), 1, 1)))
        / 1e-14,
        "stored and read": absolute(Similarity.from_dict(input_from_working.to_dict()).points(points), there),
    }


def test_similarities(within: Within) -> None:
    """Similarities ×1e-3 to ×1e3, turned, up to 6,000 km away."""
    points = np.random.default_rng(3).uniform(-2, 2, (50, 3))
    cases = enumerate((scale, away) for scale in SCALES for away in (0.0, 1.0, EARTH))
    for name, error in largest(similarity_errors(similarity(scale, away, seed), points) for seed, (scale, away) in cases).items():
        within(f"{name}, in what float64 can hold", error, 0.0 if name == "stored and read" else 4.0)


def test_working_unit(within: Within) -> None:
    """A field's picture does not depend on the unit of its working frame."""
    from dataclasses import replace

    field = small_field(6)
    camera = Intrinsics(40, 30, 45.0, 45.0, 20.0, 15.0)
    eye, target = np.array([2.5, -1.8, 1.6]), np.array([0.1, -0.2, 0.3])
    before = render_view(field, camera, look_at(eye[None], target, np.array([0.0, 0, 1]))[0])
    for factor in (1e-3, 1 / 3, 1e3):
        x, y, z = (factor * c for c in field.space.centre)
        space = Space((x, y, z), factor * field.space.half, field.space.shell, field.space.box)
        scaled = replace(field, space=space)
        after = render_view(scaled, camera, look_at(factor * eye[None], factor * target, np.array([0.0, 0, 1]))[0])
        both = (before.depth > 0) & (after.depth > 0)
        within(f"colour at ×{factor:.3g}, mean", float(np.abs(after.rgb - before.rgb).mean()), 1e-4)
        away = np.median(np.abs(after.depth[both] / factor / before.depth[both] - 1))
        within(f"depth at ×{factor:.3g}, median, relative", float(away), 1e-5)
        within(f"not finite at ×{factor:.3g}", not_finite(after.rgb, after.depth, after.opacity), 0.0)


RELATIVE = 1e-6  # of the model's size, in the input's coordinates
PLACES = tuple((scale, away) for scale in SCALES for away in (0.0, EARTH))


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


def test_meshes(within: Within, tmp_path: Path) -> None:
    """Meshes as PLY, OBJ and GLB in the input's coordinates."""
    mesh = ball()
    for scale, away in PLACES:
        placed = similarity(scale, away, 3)
        for suffix in ("ply", "obj", "glb"):
            error = mesh_error(tmp_path / f"mesh.{suffix}", mesh, placed)
            within(f"{suffix}, {_label(scale, away)}, by the model's size", error, RELATIVE)


def test_cameras(within: Within, tmp_path: Path) -> None:
    """Cameras as transforms.json and COLMAP text in the input's coordinates."""
    poses = look_at(np.random.default_rng(0).normal(size=(6, 3)) * 2, np.zeros(3), np.array([0.0, 0, 1]))
    lenses = [
        Intrinsics(64, 48, 50.0, 51.0, 32.5, 23.5, OPENCV, (0.1, -0.02, 1e-3, -2e-3)),
        Intrinsics(64, 48, 1e-3, 1e7, -1e4, 1e4),
        Intrinsics(64, 48, 40.0, 40.0, 32.0, 24.0, FISHEYE, (0.1, 0.01, -0.003, 1e-4)),
    ] * 2
    for scale, away in PLACES:
        placed = similarity(scale, away, 5)
        wanted = placed.poses(poses)
        names = [f"{index}.png" for index in range(6)]
        write_cameras(tmp_path, names, lenses, wanted)
        frames = read_json(tmp_path / "transforms.json")["frames"]
        read = np.array([world_from_opengl(np.array(frame["transform_matrix"])) for frame in frames])
        lines = [line.split() for line in (tmp_path / "colmap" / "images.txt").read_text().splitlines() if line.endswith(".png")]
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
        within(f"transforms.json, {_label(scale, away)}, by the model's size", place, RELATIVE)
        within(f"rotations in transforms.json, {_label(scale, away)}", absolute(read[:, :3, :3], wanted[:, :3, :3]), 1e-12)
        bound = RELATIVE + 4e-15 * away / size  # the model stores -R·C, whose rounding 6,000 km away is some 1e-9 m
        within(f"COLMAP, {_label(scale, away)}, by the model's size", absolute(np.array(centres), wanted[:, :3, 3]) / size, bound)


@QUICK
@given(st.floats(-3, 3), st.floats(0, 6.8), st.integers(0, 1000))
def test_any_similarity(power: float, far: float, seed: int) -> None:
    points = np.random.default_rng(seed).uniform(-2, 2, (10, 3))
    errors = similarity_errors(similarity(10.0**power, 10.0**far, seed), points)
    assert max(errors.values()) <= 4, errors


def placed_pictures(input_from_working: Similarity) -> tuple[Array, Array, Array]:
    """Two pictures and a depth map of one field: its camera as it is, and through a camera that came from the input's frame."""
    field = small_field(6)
    camera = Intrinsics(40, 30, 45.0, 45.0, 20.0, 15.0)
    pose = look_at(np.array([[2.5, -1.8, 1.6]]), np.array([0.1, -0.2, 0.3]), np.array([0.0, 0, 1]))[0]
    again = input_from_working.inverse().poses(input_from_working.poses(pose))
    before, after = render_view(field, camera, pose), render_view(field, camera, again)
    return before.rgb, after.rgb, np.abs(after.depth - before.depth)


def test_same_picture(within: Within) -> None:
    """The same picture wherever the input lies."""
    for seed, (scale, away) in enumerate(((1e-3, 1.0), (1e3, 1.0), (1.0, EARTH), (1e3, EARTH))):
        before, after, _ = placed_pictures(similarity(scale, away, seed))
        truth = np.clip(before + 0.05 * np.sin(np.arange(before.size)).reshape(before.shape), 0, 1)
        change = abs(_psnr(after, truth) - _psnr(before, truth))
        within(f"PSNR against one truth, ×{scale:g} and {away:g} away, dB", change, PSNR)


def _psnr(picture: Array, truth: Array) -> float:
    return float(-10 * np.log10(np.mean((picture.astype(np.float64) - truth) ** 2)))


def test_ray_directions(within: Within) -> None:
    """Rays of the working frame against float64."""
    camera = Intrinsics(64, 48, 50.0, 55.0, 30.0, 26.0)
    pose = look_at(np.array([[1.5, -0.3, 0.8]]), np.zeros(3), np.array([0.0, 0, 1]))[0]
    pixels = pixel_grid(64, 48)
    origins, directions, cosine = rays(camera, pose, pixels)
    local = np.stack([(pixels[:, 0] - 30.0) / 50.0, (pixels[:, 1] - 26.0) / 55.0, np.ones(len(pixels))], axis=1)
    length = np.linalg.norm(local, axis=1)
    within("directions", absolute(directions, (local / length[:, None]) @ pose[:3, :3].T), 1e-7)
    within("length of directions", absolute(directions.double().norm(dim=1), torch.ones(len(pixels))), 2e-7)
    within("cosines, relative", relative(cosine, 1 / length), 1e-7)
    within("origins", absolute(origins, np.tile(pose[:3, 3], (len(pixels), 1))), 1e-7)


def test_points(within: Within, tmp_path: Path) -> None:
    """Points in the input's coordinates."""
    mesh = ball()
    for scale, away in PLACES:
        placed = similarity(scale, away, 4)
        path = tmp_path / "points.ply"
        write_points(path, mesh.vertices, mesh.colours, mesh.normals, placed.inverse())
        read = _vertices(trimesh.load(path, process=False))
        size = scale * float(np.ptp(mesh.vertices, axis=0).max())
        error = absolute(read, placed.points(mesh.vertices)) / size
        within(f"{_label(scale, away)}, by the model's size", error, RELATIVE)


def test_quaternions(within: Within) -> None:
    """Quaternions of half turns, tiny turns and everything between."""
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
    within("quaternion of a rotation", worst, 1e-7)
    within("inverse of the inverse", absolute(invert(invert(np.eye(4))), np.eye(4)), 0.0)
