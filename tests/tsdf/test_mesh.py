"""The mesh type: frames, cleaning, thinning."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from fieldfuse.camera import Similarity
from fieldfuse.errors import InputError
from fieldfuse.export.mesh import to_trimesh
from fieldfuse.tsdf.mesh import Mesh, as_bytes


def ball(radius: float = 1.0, centre: tuple[float, float, float] = (0, 0, 0), subdivisions: int = 3) -> Mesh:
    made = trimesh.creation.icosphere(subdivisions, radius)
    colours = np.random.default_rng(0).integers(0, 256, made.vertices.shape).astype(np.uint8)
    return Mesh.create(made.vertices + np.array(centre), made.faces, colours, made.vertices / radius)


def joined(*parts: Mesh) -> Mesh:
    starts = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
    return Mesh.create(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.triangles + start for part, start in zip(parts, starts, strict=True)]),
        np.concatenate([part.colours for part in parts]),
    )


def some_similarity(scale: float = 0.01) -> Similarity:
    rotation = trimesh.transformations.random_rotation_matrix(np.array([0.1, 0.7, 0.4]))[:3, :3]
    return Similarity(scale, rotation, np.array([3.0, -2.0, 5.0]))


def test_a_similarity_and_its_inverse_bring_a_mesh_back() -> None:
    mesh, similarity = ball(2.0, (10, 20, 30)), some_similarity()
    moved = mesh.transformed(similarity)
    assert np.allclose(moved.bounds()[1] - moved.bounds()[0], 0.04, rtol=0.02)
    back = moved.transformed(similarity.inverse())
    assert np.abs(back.vertices - mesh.vertices).max() < 1e-12 * 40
    assert np.allclose(np.linalg.norm(moved.normals, axis=1), 1)
    assert np.allclose(back.normals, mesh.normals)


def test_cleaning_removes_exactly_what_is_not_surface() -> None:
    big, small = ball(1.0), ball(0.01, (3, 0, 0), subdivisions=0)
    dirty = joined(big, small)
    triangles = np.concatenate([dirty.triangles, dirty.triangles[5:7, [1, 2, 0]], [[4, 4, 9]]])  # two repeated, one degenerate
    vertices = np.concatenate([dirty.vertices, [[9.0, 9, 9]]])  # used by nothing
    dirty = Mesh.create(vertices, triangles, np.zeros(vertices.shape, np.uint8))
    kept = dirty.cleaned()
    assert len(kept.triangles) == len(big.triangles) + len(small.triangles)
    assert len(kept.vertices) == len(vertices) - 1
    without_small = dirty.cleaned(min_area_share=1e-3)
    assert len(without_small.triangles) == len(big.triangles)
    assert without_small.bounds()[1, 0] <= 1 + 1e-9
    assert to_trimesh(without_small).is_watertight


def test_the_largest_component_stays_whatever_the_share() -> None:
    parts = joined(ball(1.0), ball(0.9, (5, 0, 0)), ball(0.8, (-5, 0, 0)))
    assert len(parts.cleaned(min_area_share=0.9).triangles) == len(parts.triangles) // 3


def test_colours_follow_their_vertices_through_cleaning() -> None:
    dirty = joined(ball(0.01, (3, 0, 0), subdivisions=0), ball(1.0))
    cleaned = dirty.cleaned(min_area_share=0.01)
    expected = ball(1.0)
    assert np.array_equal(cleaned.vertices, expected.vertices)
    assert np.array_equal(cleaned.colours, expected.colours)


def test_smoothing_is_means_of_neighbours_and_borders_stay() -> None:
    """Against a loop over neighbours; a closed surface, an open one, a vertex that nothing uses."""
    rng = np.random.default_rng(0)
    closed, half = ball(), ball()
    half = Mesh(half.vertices, half.triangles[: len(half.triangles) // 2], half.colours)
    for mesh in (closed, half):
        mesh = replace(mesh, vertices=np.concatenate([mesh.vertices + rng.normal(0, 0.01, mesh.vertices.shape), np.full((1, 3), 9.0)]))
        mesh = replace(mesh, colours=rng.integers(0, 255, mesh.vertices.shape, dtype=np.uint8), normals=None)
        sides: dict[tuple[int, int], int] = {}
        for triangle in mesh.triangles.tolist():
            for a, b in zip(triangle, triangle[1:] + triangle[:1], strict=True):
                sides[min(a, b), max(a, b)] = sides.get((min(a, b), max(a, b)), 0) + 1
        beside: dict[int, set[int]] = {number: set() for number in range(len(mesh.vertices))}
        for a, b in sides:
            beside[a].add(b)
            beside[b].add(a)
        border = {vertex for side, count in sides.items() if count == 1 for vertex in side}
        assert bool(border) == (len(mesh.triangles) < len(closed.triangles))
        border |= {vertex for vertex, others in beside.items() if not others}
        expected = mesh.vertices
        for rounds in (1, 2):
            old = expected
            means = {vertex: np.mean([old[n] for n in others], axis=0) for vertex, others in beside.items() if others}
            expected = np.array([old[vertex] if vertex in border else means[vertex] for vertex in range(len(old))])
            got = mesh.smoothed(rounds)
            np.testing.assert_allclose(got.vertices, expected, atol=1e-12)
            assert got.colours is mesh.colours and got.triangles is mesh.triangles
        assert mesh.smoothed(0) is mesh


def test_smoothing_takes_ripples_and_leaves_the_shape() -> None:
    """A ball with a ripple on each vertex: nearer to the ball, and normals nearer to its own; far from the origin likewise."""
    plain = ball(subdivisions=5)
    noise = np.random.default_rng(1).normal(0, 0.01, plain.vertices.shape)
    for shift in (0.0, 6e6):
        rough = replace(plain, vertices=plain.vertices + noise + shift, normals=None).with_normals()
        smooth = rough.smoothed(2)
        assert smooth.normals is not None and rough.normals is not None
        apart = [np.abs(np.linalg.norm(mesh.vertices - shift, axis=1) - 1).mean() for mesh in (rough, smooth)]
        assert apart[1] < 0.5 * apart[0]
        off = [1 - (mesh.normals * plain.vertices).sum(axis=1).mean() for mesh in (rough, smooth)]
        assert off[1] < 0.2 * off[0]


def test_thinning_keeps_shape_and_colour() -> None:
    made = ball(1.0, subdivisions=5)
    red_above = np.where(made.vertices[:, 2:] > 0, [[255, 0, 0]], [[0, 0, 255]]).astype(np.uint8)
    mesh = Mesh.create(made.vertices, made.triangles, red_above, made.normals)
    thin = mesh.decimated(2000)
    assert 1500 < len(thin.triangles) <= 2000
    assert np.abs(np.linalg.norm(thin.vertices, axis=1) - 1).max() < 0.01
    far = np.abs(thin.vertices[:, 2]) > 0.1
    assert np.array_equal(thin.colours[far, 0] > 128, thin.vertices[far, 2] > 0)
    assert np.einsum("ij,ij->i", thin.normals, thin.vertices).min() > 0.9
    assert mesh.decimated(len(mesh.triangles)) is mesh
    again = mesh.decimated(2000)
    assert np.array_equal(again.vertices, thin.vertices) and np.array_equal(again.triangles, thin.triangles)


def test_thinning_far_from_the_origin_is_thinning_at_it() -> None:
    """Coordinates of a map: a million units away, of which float32 knows a sixteenth."""
    away = np.array([1e6, -2e6, 5e5])
    mesh = ball(1.0, subdivisions=4)
    thin = Mesh.create(mesh.vertices + away, mesh.triangles, mesh.colours, mesh.normals).decimated(500)
    assert 400 < len(thin.triangles) <= 525
    assert np.abs(np.linalg.norm(thin.vertices - away, axis=1) - 1).max() < 0.05
    assert np.einsum("ij,ij->i", thin.normals, thin.vertices - away).min() > 0.9


def test_components_are_counted_as_open3d_and_trimesh_do() -> None:
    parts = joined(ball(1.0), ball(0.5, (5, 0, 0)), ball(0.2, (-5, 0, 0)))
    assert len(np.unique(parts.components())) == 3 == to_trimesh(parts).body_count
    # What touches in a vertex alone, and an edge that three triangles share.
    touching = Mesh.create(np.random.default_rng(0).normal(size=(8, 3)), [[0, 1, 2], [2, 3, 4], [3, 4, 5], [4, 3, 6], [7, 0, 1]])
    for mesh in (parts, touching):
        theirs = np.asarray(mesh.to_open3d().cluster_connected_triangles()[0])
        both = np.unique(np.stack([mesh.components(), theirs]), axis=1)
        assert both.shape[1] == len(np.unique(theirs)) == len(np.unique(mesh.components()))
    assert len(np.unique(touching.components())) == 2


def test_damaged_meshes_are_refused() -> None:
    with pytest.raises(InputError, match="points to vertex 7"):
        Mesh.create(np.zeros((3, 3)), [[0, 1, 7]])
    with pytest.raises(InputError, match="not finite"):
        Mesh.create([[0, 0, np.nan]], np.zeros((0, 3)))
    with pytest.raises(InputError, match="colours"):
        Mesh.create(np.zeros((3, 3)), [[0, 1, 2]], np.zeros((2, 3)))


def test_empty_meshes_pass_through_everything() -> None:
    empty = Mesh.empty()
    assert len(empty.cleaned(0.1).decimated(10).transformed(some_similarity()).triangles) == 0
    assert len(empty.components()) == 0
    assert empty.bounds().tolist() == [[0, 0, 0], [0, 0, 0]]


def test_colours_as_bytes() -> None:
    assert as_bytes(np.array([[0.0, 0.5, 1.2], [np.nan, -1, 1 / 255]])).tolist() == [[0, 128, 255], [0, 0, 1]]
    assert as_bytes(np.array([[7, 300, -4]])).tolist() == [[7, 255, 0]]
