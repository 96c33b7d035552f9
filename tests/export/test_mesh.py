"""Meshes and points on disk, each read back by libraries that did not write them."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
import trimesh

from fieldfuse.camera import Array, Similarity
from fieldfuse.errors import InputError, OutputError
from fieldfuse.export.mesh import FORMATS, mesh_facts, write_mesh
from fieldfuse.export.ply import single_precision, write_points
from fieldfuse.tone import encode, shares
from fieldfuse.tsdf.mesh import Mesh
from tests.export.samples import coloured_ball, turned


def with_open3d(path: Path) -> tuple[Array, Array, Array]:
    mesh = o3d.io.read_triangle_mesh(str(path))
    assert mesh.has_vertex_colors()
    return np.asarray(mesh.vertices), np.asarray(mesh.triangles), as_srgb(path, np.asarray(mesh.vertex_colors))


def with_trimesh(path: Path) -> tuple[Array, Array, Array]:
    if path.suffix == ".glb":  # has a material, and colours beside it, which trimesh loses where it makes one mesh of a scene
        scene = trimesh.load_scene(path, process=False)
        place, name = scene.graph[scene.graph.nodes_geometry[0]]
        mesh = scene.geometry[name]
        colours = mesh.visual.vertex_attributes["color"]
        return mesh.vertices @ place[:3, :3].T + place[:3, 3], np.asarray(mesh.faces), as_srgb(path, shares(np.asarray(colours)[:, :3]))
    mesh = trimesh.load(path, force="mesh", process=False)
    assert isinstance(mesh, trimesh.Trimesh)
    assert mesh.visual.kind == "vertex"
    return np.asarray(mesh.vertices), np.asarray(mesh.faces), np.asarray(mesh.visual.vertex_colors)[:, :3].astype(int)


def as_srgb(path: Path, colours: Array) -> Array:
    """Colours in [0, 1] as the file has them → sRGB, whole numbers up to 255; glTF's are linear."""
    return np.round((encode(colours) if path.suffix == ".glb" else colours) * 255).astype(int)


READERS = {"open3d": with_open3d, "trimesh": with_trimesh}


def same(mesh: Mesh, read: tuple[Array, Array, Array], tolerance: float) -> None:
    """The read mesh has the same coloured corners in the same triangles; readers may number vertices anew."""
    vertices, triangles, colours = read
    assert len(triangles) == len(mesh.triangles)
    # Most readers keep the order of triangles and their corners, so corners can be compared one by one.
    size = np.ptp(mesh.vertices, axis=0).max()
    expected, found = mesh.vertices[mesh.triangles], vertices[triangles]
    assert np.abs(expected - found).max() <= tolerance * max(size, 1e-300)
    assert np.array_equal(mesh.colours[mesh.triangles], colours[triangles])


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("reader", list(READERS))
def test_shape_and_colours_survive(tmp_path: Path, suffix: str, reader: str) -> None:
    mesh, path = coloured_ball(), tmp_path / f"mesh{suffix}"
    write_mesh(path, mesh)
    same(mesh, READERS[reader](path), 1e-6)
    assert [item.name for item in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("reader", list(READERS))
def test_exports_are_in_the_inputs_frame_and_scale(tmp_path: Path, suffix: str, reader: str) -> None:
    in_input, similarity = coloured_ball(), turned()
    working = in_input.transformed(similarity)
    assert np.ptp(working.vertices, axis=0).max() < 0.1
    path = tmp_path / f"mesh{suffix}"
    write_mesh(path, working, similarity)
    same(in_input, READERS[reader](path), 1e-6)


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("reader", ["trimesh"])
def test_a_mesh_far_from_the_origin_keeps_its_shape(tmp_path: Path, suffix: str, reader: str) -> None:
    # 6000 km away (metres from the centre of the earth) one float32 step is half a metre.
    far = coloured_ball().transformed(Similarity(1.0, np.eye(3), np.array([6e6, -1e6, 2e6])))
    assert not single_precision(far.vertices)
    path = tmp_path / f"mesh{suffix}"
    write_mesh(path, far)
    same(far, READERS[reader](path), 1e-6)


def test_normals_survive_in_ply_and_obj(tmp_path: Path) -> None:
    mesh, similarity = coloured_ball(), turned()
    for suffix in (".ply", ".obj"):
        path = tmp_path / f"mesh{suffix}"
        write_mesh(path, mesh.transformed(similarity), similarity)
        read = o3d.io.read_triangle_mesh(str(path))
        assert mesh.normals is not None
        assert np.allclose(np.asarray(read.vertex_normals)[np.asarray(read.triangles)], mesh.normals[mesh.triangles], atol=1e-4)


def test_glb_has_linear_colours_and_a_material_that_takes_no_light(tmp_path: Path) -> None:
    """Read by the specification alone (glTF 2.0, 3.7.2.1 and 3.9.2)."""
    mesh = coloured_ball()
    write_mesh(tmp_path / "mesh.glb", mesh)
    data = (tmp_path / "mesh.glb").read_bytes()
    length = struct.unpack("<I", data[12:16])[0]
    tree, chunk = json.loads(data[20 : 20 + length]), data[28 + length :]
    primitive = tree["meshes"][0]["primitives"][0]
    assert set(primitive["attributes"]) == {"POSITION", "NORMAL", "COLOR_0"}
    assert tree["materials"][primitive["material"]]["pbrMetallicRoughness"] == {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    assert tree["materials"][primitive["material"]]["extensions"] == {"KHR_materials_unlit": {}}
    assert tree["extensionsUsed"] == ["KHR_materials_unlit"]
    accessor = tree["accessors"][primitive["attributes"]["COLOR_0"]]
    assert (accessor["componentType"], accessor["type"], accessor["normalized"]) == (5123, "VEC4", True)  # unsigned short
    assert accessor["count"] == len(mesh.vertices)
    view = tree["bufferViews"][accessor["bufferView"]]
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    assert start % 4 == 0
    linear = np.frombuffer(chunk, "<u2", 4 * accessor["count"], start).reshape(-1, 4) / 65535
    assert (linear[:, 3] == 1).all()
    write_mesh(tmp_path / "mesh.ply", mesh)
    assert np.abs(encode(linear[:, :3]) - with_trimesh(tmp_path / "mesh.ply")[2] / 255).max() < 0.1 / 255  # far below a step, in the darks


def test_facts_agree_with_trimesh() -> None:
    ball = coloured_ball()
    facts = mesh_facts(ball)
    assert facts["watertight"] is True
    assert (facts["triangles"], facts["vertices"], facts["components"]) == (len(ball.triangles), len(ball.vertices), 1)
    assert facts["area"] == pytest.approx(trimesh.Trimesh(ball.vertices, ball.triangles).area)
    assert np.allclose(facts["bounds"], [[8, -23, 26], [12, -17, 34]], atol=0.05)
    open_ball = Mesh.create(ball.vertices, ball.triangles[:-1], ball.colours)
    assert mesh_facts(open_ball)["watertight"] is False
    empty = mesh_facts(Mesh.empty())
    assert (empty["watertight"], empty["triangles"], empty["components"]) == (False, 0, 0)


def test_names_and_contents_that_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"\.ply, \.obj, \.glb"):
        write_mesh(tmp_path / "mesh.stl", coloured_ball())
    with pytest.raises(InputError, match="has no triangles"):
        write_mesh(tmp_path / "mesh.glb", Mesh.empty())
    with pytest.raises(InputError, match=r"\.ply"):
        write_points(tmp_path / "points.xyz", np.zeros((1, 3)))
    with pytest.raises(InputError, match="colours"):
        write_points(tmp_path / "points.ply", np.zeros((4, 3)), np.zeros((3, 3), np.uint8))
    (tmp_path / "file").write_text("in the way")
    for suffix in FORMATS:
        with pytest.raises(OutputError, match="cannot write"):
            write_mesh(tmp_path / "file" / f"mesh{suffix}", coloured_ball())
    assert [item.name for item in tmp_path.iterdir()] == ["file"]


def test_an_empty_mesh_is_a_valid_file(tmp_path: Path) -> None:
    write_mesh(tmp_path / "mesh.ply", Mesh.empty())
    assert len(o3d.io.read_triangle_mesh(str(tmp_path / "mesh.ply")).vertices) == 0
    write_mesh(tmp_path / "mesh.obj", Mesh.empty())
    assert (tmp_path / "mesh.obj").read_text().startswith("#")


def test_points_come_back_with_colours_and_normals(tmp_path: Path) -> None:
    ball, similarity = coloured_ball(), turned()
    working = ball.transformed(similarity)
    path = tmp_path / "points.ply"
    write_points(path, working.vertices, working.colours, working.normals, similarity)
    cloud = o3d.io.read_point_cloud(str(path))
    assert np.abs(np.asarray(cloud.points) - ball.vertices).max() < 1e-6 * 34
    assert np.array_equal(np.round(np.asarray(cloud.colors) * 255), ball.colours)
    assert ball.normals is not None
    assert np.allclose(np.asarray(cloud.normals), ball.normals, atol=1e-6)
    again = trimesh.load(path)
    assert np.abs(np.asarray(again.vertices) - ball.vertices).max() < 1e-6 * 34
    assert np.array_equal(np.asarray(again.colors)[:, :3], ball.colours)


def test_points_with_floating_colours_far_away_and_none(tmp_path: Path) -> None:
    points = np.array([[6e6, 1.25, 0], [6e6 + 0.001, 2.5, 3]])
    write_points(tmp_path / "points.ply", points, np.array([[0.0, 0.5, 1], [1, 0, 0]]))
    cloud = o3d.io.read_point_cloud(str(tmp_path / "points.ply"))
    assert np.array_equal(np.asarray(cloud.points), points)
    assert np.round(np.asarray(cloud.colors) * 255).tolist() == [[0, 128, 255], [255, 0, 0]]
    write_points(tmp_path / "none.ply", np.zeros((0, 3)))
    assert "element vertex 0" in (tmp_path / "none.ply").read_bytes().decode("ascii")


@pytest.mark.parametrize("suffix", FORMATS)
def test_a_mesh_can_be_used_after_it_was_written(tmp_path: Path, suffix: str) -> None:
    """trimesh marks the arrays it is given as read-only; the mesh that was written must not be touched by that."""
    mesh = coloured_ball()
    for _ in range(2):
        write_mesh(tmp_path / f"mesh{suffix}", mesh)
        assert mesh_facts(mesh)["watertight"] is True
    for array in (mesh.vertices, mesh.triangles, mesh.colours, mesh.normals):
        assert array is not None and array.flags.writeable
    assert len(mesh.decimated(100).triangles) <= 100
