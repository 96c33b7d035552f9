"""Mesh against mesh: known distances, scores and seen parts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from fieldfuse.camera import Array, Intrinsics, Similarity
from fieldfuse.errors import InputError
from fieldfuse.evaluation.geometry import distances, geometry_metrics, inside, read_mesh, seen_points, seen_surface, surface_points
from fieldfuse.evaluation.score import in_image
from fieldfuse.export.mesh import write_mesh
from fieldfuse.render.paths import look_at
from fieldfuse.tsdf.mesh import Mesh

CAMERA = Intrinsics(80, 60, 70.0, 70.0, 40.0, 30.0)
UP = np.array([0.0, 0.0, 1.0])


def ball(radius: float = 1.0, centre: Array | tuple[float, float, float] = (0, 0, 0), detail: int = 4) -> Mesh:
    made = trimesh.creation.icosphere(detail, radius)
    return Mesh.create(made.vertices + np.asarray(centre, float), made.faces)


def sheet(z: float = 0.0, half: float = 1.0, shift: float = 0.0) -> Mesh:
    corners = [[shift - half, -half, z], [shift + half, -half, z], [shift + half, half, z], [shift - half, half, z]]
    return Mesh.create(np.array(corners), np.array([[0, 1, 2], [0, 2, 3]]))


def test_points_are_spread_by_area() -> None:
    large, small = sheet(0.0, 2.0), sheet(5.0, 1.0)
    both = Mesh.create(np.concatenate([large.vertices, small.vertices]), np.concatenate([large.triangles, small.triangles + 4]))
    points = surface_points(both, 10_000)[0]
    assert (points[:, 2] == 0).mean() == pytest.approx(0.8, abs=0.001)
    counts, _, _ = np.histogram2d(*points[points[:, 2] == 0][:, :2].T, bins=4, range=[[-2, 2], [-2, 2]])
    assert counts.min() > 400 and counts.max() < 600
    assert np.array_equal(points, surface_points(both, 10_000)[0]) and not np.array_equal(points, surface_points(both, 10_000, seed=1)[0])
    assert surface_points(Mesh.empty(), 10)[0].shape == (0, 3)


@pytest.mark.parametrize("centre", [(0, 0, 0), (6e6, -1e6, 2e6)])
def test_distances_against_dense_points(centre: tuple[float, float, float]) -> None:
    mesh = ball(1.0, centre)
    rng = np.random.default_rng(0)
    points = rng.normal(0, 1, (300, 3)) + centre
    dense = cKDTree(surface_points(mesh, 400_000)[0]).query(points)[0]
    assert np.abs(distances(points, mesh)[0] - dense).max() < 0.006
    assert np.isinf(distances(points[:2], Mesh.empty())[0]).all()


def test_a_shifted_sheet_has_known_scores() -> None:
    truth, wanted = sheet(), surface_points(sheet(), 20_000)[0]
    near = geometry_metrics(sheet(0.03), truth, wanted, 0.02, samples=20_000)
    assert near["accuracy"] == pytest.approx(0.03, abs=1e-6) and near["completeness"] == pytest.approx(0.03, abs=1e-6)
    assert (near["f_score_1"], near["f_score_2"], near["f_score_4"]) == (0, 1, 1)
    half = geometry_metrics(sheet(0.0, shift=1.0), truth, wanted, 0.001, samples=20_000)
    assert half["precision_1"] == pytest.approx(0.5, abs=0.01) and half["recall_1"] == pytest.approx(0.5, abs=0.01)
    assert half["f_score_1"] == pytest.approx(0.5, abs=0.01)
    assert half["completeness"] == pytest.approx(0.25, abs=0.01)  # half is covered, the other half 0 to 1 away


def test_what_is_missing_costs_recall_and_what_is_too_much_costs_precision() -> None:
    truth, wanted = ball(), surface_points(ball(), 20_000)[0]
    some = Mesh(truth.vertices, truth.triangles[: len(truth.triangles) // 2], truth.colours).cleaned()
    less = geometry_metrics(some, truth, wanted, 0.01, samples=20_000)
    assert less["precision_1"] == 1 and less["recall_1"] < 0.8
    floater = ball(0.3, (3, 0, 0))
    both = Mesh.create(np.concatenate([truth.vertices, floater.vertices]), np.concatenate([truth.triangles, floater.triangles + 2562]))
    more = geometry_metrics(both, truth, wanted, 0.01, samples=20_000)
    assert more["recall_1"] == 1 and more["precision_1"] == pytest.approx(1 / 1.09, abs=0.005)
    boxed = geometry_metrics(both, truth, wanted, 0.01, region=(np.full(3, -1.5), np.full(3, 1.5)), samples=20_000)
    assert boxed["precision_1"] == 1


def test_a_sheet_that_is_tilted_has_that_angle() -> None:
    truth, wanted = sheet(), surface_points(sheet(), 20_000)[0]
    assert geometry_metrics(sheet(0.03), truth, wanted, 0.02, samples=5000)["normals"] == pytest.approx(0, abs=1e-5)
    turn = trimesh.transformations.rotation_matrix(np.deg2rad(20), [1, 0, 0])[:3, :3]
    tilted = sheet().transformed(Similarity(1.0, turn, np.zeros(3)))
    upside_down = Mesh(tilted.vertices, tilted.triangles[:, ::-1], tilted.colours)
    for mesh in (tilted, upside_down):
        assert geometry_metrics(mesh, truth, wanted, 0.02, samples=5000)["normals"] == pytest.approx(20, abs=1e-4)
    assert geometry_metrics(sheet(0.3), truth, wanted, 0.02, samples=5000)["normals"] is None  # nowhere near enough to tell


def test_no_surface_scores_nothing() -> None:
    none = geometry_metrics(Mesh.empty(), ball(), surface_points(ball(), 1000)[0], 0.02)
    assert none["accuracy"] is None and none["completeness"] is None and none["normals"] is None
    assert none["f_score_4"] == 0 and none["recall_4"] == 0


@settings(max_examples=25, deadline=None)
@given(shift=st.floats(-0.2, 0.2), voxel=st.floats(0.005, 0.1))
def test_scores_are_shares_and_grow_with_the_distance(shift: float, voxel: float) -> None:
    scores = geometry_metrics(ball(1 + shift, (shift, 0, 0), 2), ball(detail=2), surface_points(ball(detail=2), 500)[0], voxel, samples=500)
    for kind in ("precision", "recall", "f_score"):
        values = [scores[f"{kind}_{n}"] for n in (1, 2, 4)]
        assert all(0 <= value <= 1 for value in values) and values == sorted(values)


def test_cameras_see_the_side_that_faces_them() -> None:
    mesh = ball()
    points = surface_points(mesh, 4000)[0]
    pose = look_at(np.array([[4.0, 0, 0]]), np.zeros(3), UP)
    seen = seen_points(points, mesh, [CAMERA], pose, 0.01)
    # A sphere shows what lies beyond the tangent cone: x > r² / d.
    assert (seen == (points[:, 0] > 0.25)).mean() > 0.98
    ring = look_at(4 * np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]]), np.zeros(3), UP)
    assert seen_points(points, mesh, [CAMERA] * 4, ring, 0.01).mean() > 0.8
    narrow = Intrinsics(8, 6, 70.0, 70.0, 4.0, 3.0)  # the middle of the picture alone
    assert 0 < seen_points(points, mesh, [narrow], pose, 0.01).mean() < 0.05
    assert not seen_points(points, mesh, [CAMERA], look_at(np.array([[4.0, 0, 0]]), np.array([8.0, 0, 0]), UP), 0.01).any()
    assert not in_image(np.array([[5.0, 0, 0]]), CAMERA, pose[0])[0]


def test_something_before_it_hides_a_surface() -> None:
    wall, screen = sheet(0.0, 2.0), sheet(1.0, 0.5)
    both = Mesh.create(np.concatenate([wall.vertices, screen.vertices]), np.concatenate([wall.triangles, screen.triangles + 4]))
    pose = look_at(np.array([[0.0, 0, 3]]), np.zeros(3), np.array([0.0, 1, 0]))
    points = np.array([[0.0, 0, 0], [0.5, 0.5, 0], [0.9, 0.9, 0], [0.2, 0.2, 1.0]])
    assert seen_points(points, both, [CAMERA], pose, 0.01).tolist() == [False, False, True, True]


def test_only_what_was_seen_is_asked_for() -> None:
    truth = ball()
    pose = look_at(np.array([[4.0, 0, 0]]), np.zeros(3), UP)
    wanted, share = seen_surface(truth, [CAMERA], pose, 0.02, samples=5000)
    assert share == pytest.approx(0.375, abs=0.01)  # the cap's share: (1 − 1/4) / 2
    front = truth.vertices[:, 0] > 0.2
    cap = Mesh(truth.vertices, truth.triangles[front[truth.triangles].all(axis=1)], truth.colours).cleaned()
    assert geometry_metrics(cap, truth, wanted, 0.02, samples=5000)["f_score_1"] > 0.99
    half, _ = seen_surface(truth, [CAMERA], pose, 0.02, region=(np.array([-2.0, -2, 0]), np.full(3, 2.0)), samples=5000)
    assert len(half) == pytest.approx(len(wanted) / 2, rel=0.05) and inside(half, (np.array([-2.0, -2, 0]), np.full(3, 2.0))).all()
    with pytest.raises(InputError, match="same frame"):
        seen_surface(ball(1.0, (100, 0, 0)), [CAMERA], pose, 0.02, samples=1000)


def test_meshes_are_read_and_what_is_none_is_refused(tmp_path: Path) -> None:
    mesh = Mesh.create(ball().vertices, ball().triangles, np.random.default_rng(0).integers(0, 255, (2562, 3)))
    for suffix in (".ply", ".obj"):
        path = tmp_path / f"mesh{suffix}"
        write_mesh(path, mesh)
        back = read_mesh(path)
        assert np.allclose(np.sort(back.vertices, axis=0), np.sort(mesh.vertices, axis=0), atol=1e-6)
        assert len(back.triangles) == len(mesh.triangles)
    back = read_mesh(tmp_path / "mesh.ply")
    assert np.array_equal(back.colours[back.triangles], mesh.colours[mesh.triangles])
    write_mesh(tmp_path / "empty.ply", Mesh.empty())
    (tmp_path / "text.ply").write_text("no mesh at all")
    (tmp_path / "cut.ply").write_bytes((tmp_path / "mesh.ply").read_bytes()[:4000])
    with pytest.raises(InputError, match="no triangles"):
        read_mesh(tmp_path / "empty.ply")
    for name in ("text.ply", "cut.ply", "missing.ply"):
        with pytest.raises(InputError, match=name):
            read_mesh(tmp_path / name)
