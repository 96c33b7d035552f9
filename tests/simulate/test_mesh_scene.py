"""Mesh scenes: geometry, texture, tint and orientation of GLB, OBJ and PLY files; the furnished house where it is there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from fieldfuse.camera import Intrinsics
from fieldfuse.effects.scenery import Background, Highlights
from fieldfuse.errors import InputError
from fieldfuse.export.mesh import write_mesh
from fieldfuse.simulate.eye import eye_of, take
from fieldfuse.simulate.mesh_scene import MeshScene, load_mesh_scene
from fieldfuse.simulate.settings import scene_file
from fieldfuse.simulate.simulate import simulate
from fieldfuse.tsdf.mesh import Mesh

trimesh = pytest.importorskip("trimesh")
pytest.importorskip("open3d")

CAMERA = Intrinsics(80, 60, 70.0, 70.0, 40.0, 30.0)
FRONT = np.array([[1, 0, 0, 0], [0, 0, 1, -3], [0, -1, 0, 0.5], [0, 0, 0, 1]], dtype=float)  # at y = −3, looking along y; z is up


def quadrants() -> Image.Image:
    image = np.zeros((64, 64, 3), dtype=np.uint8)
    image[:32, :32], image[:32, 32:], image[32:, :32], image[32:, 32:] = (255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 255)
    return Image.fromarray(image)


def wall(up: str = "z") -> trimesh.Trimesh:
    """2 × 1 m in the plane y = 0, its lower edge on z = 0, a texture that is upright from the front."""
    vertices = np.array([[-1.0, 0, 0], [1, 0, 0], [1, 0, 1], [-1, 0, 1]])
    if up == "y":
        vertices = vertices[:, [0, 2, 1]] * [1, 1, -1]
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=quadrants())
    visual = trimesh.visual.TextureVisuals(uv=np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]]), material=material)
    return trimesh.Trimesh(vertices, [[0, 1, 2], [0, 2, 3]], visual=visual, process=False)


def picture(scene: MeshScene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    taken = take(scene, eye_of(CAMERA, 2, scene.device), FRONT[None])
    return taken.linear.numpy(), taken.depth.numpy(), taken.normals.numpy()


@pytest.mark.parametrize("name", ["wall.glb", "wall.obj"])
def test_texture_depth_and_normals(tmp_path: Path, name: str) -> None:
    """Seen from its front, the first row of the texture is up and its first column left."""
    wall().export(tmp_path / name)
    rgb, depth, normals = picture(load_mesh_scene(tmp_path / name))
    assert rgb[25, 30].argmax() == 0 and rgb[25, 50].argmax() == 1 and rgb[35, 30].argmax() == 2
    assert rgb[35, 50].min() > 0.9 * rgb[35, 50].max() > 0.1
    hit = depth > 0
    np.testing.assert_allclose(depth[hit], 3.0, atol=1e-5)
    np.testing.assert_allclose(normals[hit], np.broadcast_to([0, -1.0, 0], normals[hit].shape), atol=1e-5)
    v, u = np.nonzero(hit)
    assert (u.min(), u.max() + 1) == (40 - 23, 40 + 23) and (v.min(), v.max() + 1) == (30 - 12, 30 + 12)  # 70 px · 1 m / 3 m = 23.3
    assert (rgb[~hit].max(axis=1) == 0)[:100].all()


def test_files_with_y_up_and_other_units(tmp_path: Path) -> None:
    mesh = wall("y")
    mesh.apply_scale(100)
    mesh.export(tmp_path / "wall.glb")
    rgb, depth, _ = picture(load_mesh_scene(tmp_path / "wall.glb", up="y", scale=0.01))
    assert rgb[25, 30].argmax() == 0 and rgb[25, 50].argmax() == 1
    np.testing.assert_allclose(depth[depth > 0], 3.0, atol=1e-4)


def test_colours_of_vertices(tmp_path: Path) -> None:
    box = trimesh.creation.box((1, 1, 1))
    box.visual.vertex_colors = np.tile([0, 255, 0, 255], (8, 1))
    box.export(tmp_path / "box.ply")
    rgb, depth, _ = picture(load_mesh_scene(tmp_path / "box.ply"))
    assert depth[30, 40] == pytest.approx(2.5)
    assert rgb[30, 40, 1] > 0.2 and rgb[30, 40, 0] == rgb[30, 40, 2] == 0


def test_an_exported_mesh_has_its_colours_in_every_format(tmp_path: Path) -> None:
    """sRGB in PLY, linear and beside a material in GLB."""
    box = trimesh.creation.box((1, 1, 1))
    mesh = Mesh.create(box.vertices, box.faces, np.tile([200, 100, 20], (8, 1)))
    shown = []
    for suffix in (".ply", ".glb"):
        write_mesh(tmp_path / f"box{suffix}", mesh)
        shown.append(picture(load_mesh_scene(tmp_path / f"box{suffix}"))[0][30, 40])
    np.testing.assert_allclose(shown[0], shown[1], atol=1e-3)
    assert shown[0][0] > 2 * shown[0][1] > 4 * shown[0][2] > 0


def test_parts_stand_where_the_file_puts_them(tmp_path: Path) -> None:
    """A GLB scene with one box used twice, each with a place of its own."""
    scene = trimesh.Scene()
    box = trimesh.creation.box((0.4, 0.4, 0.4))
    for name, x in (("a", -0.7), ("b", 0.7)):
        scene.add_geometry(box, node_name=name, geom_name="box", transform=trimesh.transformations.translation_matrix([x, 0, 0.5]))
    scene.export(tmp_path / "two.glb")
    _, depth, _ = picture(load_mesh_scene(tmp_path / "two.glb"))
    assert depth[30, 40] == 0 and depth[30, 24] > 0 and depth[30, 56] > 0


def test_background_highlights_and_clearance(tmp_path: Path) -> None:
    wall().export(tmp_path / "wall.glb")
    scene = load_mesh_scene(tmp_path / "wall.glb")
    _, depth, _ = picture(scene)
    scene.background = Background()
    sky, _, _ = picture(scene)
    inner = depth > 0
    assert sky[~inner].min() > 0
    scene.highlights = Highlights(3.0, 0.5)
    shiny, _, _ = picture(scene)
    assert (shiny[inner] >= sky[inner] - 1e-6).all()
    np.testing.assert_allclose(scene.clearance(torch.tensor([[0.0, 0.5, 0.5], [0, -2, 0.5], [0, 0, 1.25]])), [0.5, 2, 0.25], atol=1e-6)
    assert len(scene.mesh().triangles) == 2


def test_a_capture_of_a_mesh(tmp_path: Path) -> None:
    parts = [wall(), wall(), wall()]
    parts[1].apply_translation([0, 3, 0])
    parts[2].apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [0, 0, 1], [1, 0, 0]))
    trimesh.Scene(parts).export(tmp_path / "walls.glb")
    data = {
        "scene": "walls.glb",
        "camera": {"width": 48, "height": 36},
        "path": {"kind": "orbit", "frames": 3, "speed": 0.3},
        "mesh": {"free": [[-1, 0.4, 0.3], [0.6, 2.6, 0.9]], "focus": [0, 1.5, 0.5]},
    }
    for name in ("a", "b"):
        simulate(scene_file(data, "test"), tmp_path / name, tmp_path)
    assert (tmp_path / "a" / "images" / "000001.png").read_bytes() == (tmp_path / "b" / "images" / "000001.png").read_bytes()
    assert len((tmp_path / "a" / "ground_truth" / "mesh.ply").read_bytes()) > 6 * 13


def test_what_cannot_be_read_is_told(tmp_path: Path) -> None:
    (tmp_path / "broken.glb").write_bytes(b"glTF\x02\x00\x00\x00 not really")
    (tmp_path / "points.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n0 0 0\n"
    )
    for name, sentence in (("none.glb", "does not exist"), ("broken.glb", "cannot be read"), ("points.ply", "no triangles")):
        with pytest.raises(InputError, match=sentence):
            load_mesh_scene(tmp_path / name)
    with pytest.raises(InputError, match="no mesh that can be read"):
        load_mesh_scene(tmp_path / "mesh.stl")
