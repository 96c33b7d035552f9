"""Textures: triangles have places of their own, show what the pictures show, and nothing that is hidden; the file says the same."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from fieldfuse.camera import Array, Intrinsics, project
from fieldfuse.errors import InputError
from fieldfuse.export.atlas import GUTTER, Atlas, make_atlas
from fieldfuse.export.mesh import write_textured
from fieldfuse.export.texture import BEST, Photos, strongest, textured, vertex_visibility
from fieldfuse.render.paths import look_at
from fieldfuse.tsdf.mesh import Mesh
from tests.export.samples import coloured_ball, turned

FRONT = look_at(np.array([[0.3, -0.2, 3.0]]), np.zeros(3), np.array([0.0, 1, 0]))
CAMERA = Intrinsics(96, 72, 90.0, 90.0, 48.0, 36.0)


def board(depth: float = 0.0, half: float = 1.0, cells: int = 12) -> Mesh:
    """A square in the plane z = −depth that looks towards +z, grey."""
    line = np.linspace(-half, half, cells + 1)
    y, x = np.meshgrid(line, line, indexing="ij")
    vertices = np.stack([x.ravel(), y.ravel(), np.full(x.size, -depth)], axis=1)
    at = np.arange(cells * (cells + 1)).reshape(cells, cells + 1)[:, :-1].ravel()
    triangles = np.concatenate([np.stack([at, at + 1, at + cells + 1], 1), np.stack([at + 1, at + cells + 2, at + cells + 1], 1)])
    return Mesh.create(vertices, triangles, np.full(vertices.shape, 128, np.uint8), np.tile([0.0, 0.0, 1.0], (len(vertices), 1)))


def painted(mesh: Mesh, picture: Array, pose: Array) -> Mesh:
    """The mesh with the colours that a picture shows at its vertices."""
    place, _ = project(CAMERA, pose, mesh.vertices)
    colours = cv2.remap(picture, *(place.T[:, None].astype(np.float32) - 0.5), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[0]
    return replace(mesh, colours=colours)


def texels(atlas: Atlas, index: int) -> set[tuple[int, int]]:
    """What belongs to a triangle: itself, and a gutter beyond its long side."""
    reach = int(atlas.length[index]) + GUTTER - (1 if atlas.way[index] > 0 else 2)
    column, row = (int(value) for value in atlas.corner[index])
    way = int(atlas.way[index])
    return {(row + way * j, column + way * i) for j in range(reach + 1) for i in range(reach + 1 - j)}


def painted_texels(texture: Array, atlas: Atlas, indices: Array) -> Array:
    """(N, 3) float the texels of some triangles."""
    return np.concatenate([texture[tuple(np.array(sorted(texels(atlas, int(index)))).T)] for index in indices]).astype(float)


def looked_up(texture: Array, atlas: Atlas, shares: Array) -> Array:
    """(T, 3) colours of the texture at one place of each triangle, by its shares (3,) of the vertices."""
    place = np.einsum("tki,k->ti", atlas.coordinates(), shares)
    x, y = place[:, 0] * atlas.size - 0.5, (1 - place[:, 1]) * atlas.size - 0.5
    return np.asarray(cv2.remap(texture, x[None].astype(np.float32), y[None].astype(np.float32), cv2.INTER_LINEAR)[0])


def waves(camera: Intrinsics, phase: float) -> Array:
    """A picture that changes slowly."""
    v, u = np.mgrid[: camera.height, : camera.width]
    parts = [128 + 100 * np.sin(u / 11 + phase), 128 + 100 * np.cos(v / 9 + phase), 128 + 60 * np.sin((u + v) / 13)]
    return np.round(np.stack(parts, axis=-1)).astype(np.uint8)


@pytest.mark.parametrize("density", [0.5, 4.0, 40.0])
def test_triangles_do_not_share_texels(density: float) -> None:
    mesh = coloured_ball(2)
    atlas = make_atlas(mesh, density, 1024)
    seen: set[tuple[int, int]] = set()
    for index in range(len(mesh.triangles)):
        own = texels(atlas, index)
        assert not seen & own
        assert all(0 <= row < atlas.size and 0 <= column < atlas.size for row, column in own)
        seen |= own
    # A triangle is as long in texels as it is to be, or longer: squares are powers of two, and share what room there is.
    side = np.sqrt(2 * mesh.areas())
    assert atlas.size == 1024 or (atlas.length >= np.minimum(density * side, 1000)).all()
    inside = atlas.coordinates()
    assert inside.min() > 0 and inside.max() < 1


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(InputError, match=r"20480 triangles do not fit into a texture of 256×256 texels"):
        make_atlas(coloured_ball(5), 10.0, 256)
    assert len(make_atlas(Mesh.empty(), 1.0, 1024).corner) == 0


def test_a_texture_shows_what_the_picture_shows() -> None:
    picture = waves(CAMERA, 0.0)
    mesh = painted(board(), picture, FRONT[0])
    atlas, texture = textured(mesh, Photos([picture], [CAMERA], FRONT))
    whole = (vertex_visibility(mesh, Photos([], [CAMERA], FRONT))[mesh.triangles, 0] > 0).all(axis=1)
    for shares in ([1 / 3, 1 / 3, 1 / 3], [0.5, 0.5, 0.0], [0.0, 0.5, 0.5], [0.9, 0.05, 0.05]):
        points = np.einsum("tki,k->ti", mesh.vertices[mesh.triangles], np.array(shares))
        place, _ = project(CAMERA, FRONT[0], points)
        expected = cv2.remap(picture, *(place.T[:, None].astype(np.float32) - 0.5), cv2.INTER_LINEAR)[0]
        off = np.abs(looked_up(texture, atlas, np.array(shares)).astype(int) - expected)[whole]
        assert whole.sum() > 100 and off.max() <= 6


def test_colours_are_the_vertices_in_the_large_and_the_pictures_in_the_small() -> None:
    """A picture that is too light by 40, of dots that are too small for the vertices."""
    v, u = np.mgrid[:72, :96]
    dots = np.repeat((100 + 40 + 50 * ((u // 2 + v // 2) % 2 * 2.0 - 1))[..., None], 3, axis=2).astype(np.uint8)
    mesh = replace(board(), colours=np.full((169, 3), 100, np.uint8))
    atlas, texture = textured(mesh, Photos([dots], [CAMERA], FRONT))
    whole = (vertex_visibility(mesh, Photos([], [CAMERA], FRONT))[mesh.triangles, 0] > 0).all(axis=1)
    seen = painted_texels(texture, atlas, np.flatnonzero(whole))
    assert seen.mean() == pytest.approx(100, abs=6)
    assert seen.std() > 25


def test_pictures_take_over_from_each_other_smoothly() -> None:
    """Of two pictures, one all dark and one all light, the nearer one counts for more, and neighbours in space differ little."""
    poses = look_at(np.array([[-1.0, 0, 2.0], [1.0, 0, 2.0], [0.0, 5.0, 9.0], [0.0, -5.0, 9.0]]), np.zeros(3), np.array([0.0, 1, 0]))
    pictures = [np.full((72, 96, 3), value, np.uint8) for value in (40, 220, 128, 128)]
    mesh = board(cells=40)
    mesh = replace(mesh, colours=np.repeat(130 + 90 * np.tanh(3 * mesh.vertices[:, :1]), 3, axis=1).astype(np.uint8))
    atlas, texture = textured(mesh, Photos(pictures, [CAMERA] * 4, poses))
    middle = mesh.vertices[mesh.triangles].mean(axis=1)
    colour = looked_up(texture, atlas, np.full(3, 1 / 3))[:, 0].astype(float)
    near = np.abs(middle[:, 1]) < 0.2
    left, right = colour[near & (middle[:, 0] < -0.35)], colour[near & (middle[:, 0] > 0.35)]
    assert left.mean() < 100 < 160 < right.mean()
    order = np.argsort(middle[near, 0])
    assert np.abs(np.diff(colour[near][order])).max() < 40


def test_what_is_hidden_is_not_painted_on_what_is_behind() -> None:
    front, back = board(0.0, 0.3, 4), board(1.0, 1.0, 20)
    both = Mesh.create(
        np.concatenate([front.vertices, back.vertices]),
        np.concatenate([front.triangles, back.triangles + len(front.vertices)]),
        np.concatenate([front.colours, back.colours]),
        np.concatenate([np.tile([0.0, 0, 1], (len(front.vertices), 1)), np.tile([0.0, 0, 1], (len(back.vertices), 1))]),
    )
    pose = look_at(np.array([[0.0, 0.0, 3.0]]), np.zeros(3), np.array([0.0, 1, 0]))
    weight = vertex_visibility(both, Photos([], [CAMERA], pose))[:, 0]
    own, behind = weight[: len(front.vertices)], weight[len(front.vertices) :]
    shade = np.abs(back.vertices[:, :2]).max(axis=1)
    assert (behind[shade < 0.35] == 0).all()  # a third wider than what hides it, seen from three units away
    assert (behind[(shade > 0.6) & (shade < 0.8)] > 0).all()
    assert own[(np.abs(front.vertices[:, :2]) < 0.2).all(axis=1)].min() > 0
    away = look_at(np.array([[0.0, 0.0, -3.0]]), np.zeros(3), np.array([0.0, 1, 0]))
    assert (vertex_visibility(both, Photos([], [CAMERA], away))[:, 0] == 0).all()  # from behind nothing is seen


def test_what_is_masked_is_not_looked_at_and_blurred_pictures_count_less() -> None:
    mesh = replace(board(), colours=np.full((169, 3), 50, np.uint8))
    left = np.arange(96)[None] < 48 + np.zeros((72, 1), int)
    weight = vertex_visibility(mesh, Photos([], [CAMERA], FRONT, [left]))[:, 0]
    place, _ = project(CAMERA, FRONT[0], mesh.vertices)
    assert (weight[place[:, 0] > 48] == 0).all() and weight[(place[:, 0] > 20) & (place[:, 0] < 40)].max() > 0
    # The same camera twice, once blurred (all grey): lines stay lines.
    lines = np.where(np.arange(96)[None, :, None] // 2 % 2 > 0, np.uint8(100), np.uint8(0)) + np.zeros((72, 1, 3), np.uint8)
    blurred = np.full((72, 96, 3), 50, np.uint8)
    poses = np.concatenate([FRONT, FRONT])
    spread = []
    for worth in ((1.0, 1.0), (1.0, 0.05)):
        atlas, texture = textured(mesh, Photos([lines, blurred], [CAMERA] * 2, poses, worth=worth))
        spread.append(painted_texels(texture, atlas, np.arange(len(mesh.triangles))).std())
    assert spread[1] > 1.5 * spread[0]


def test_the_best_pictures_count() -> None:
    weights = np.array([[5.0, 1, 4, 3, 2], [0, 0, 0, 0, 0], [2, 2, 2, 2, 2], [0, 5, 0, 0, 0]], np.float32)
    which, best = strongest(weights)
    assert which[0].tolist() == [0, 2, 3, 4] and np.allclose(best[0], [0.4, 0.3, 0.2, 0.1])
    assert (best[1] == 0).all()
    assert np.allclose(best[2], 1 / BEST)  # the same picture five times is as good as once
    assert which[3, 0] == 1 and np.allclose(best[3], [1, 0, 0, 0])
    assert np.allclose(strongest(weights[:, :2])[1].sum(axis=1), [1, 0, 1, 1])


def test_the_file_shows_it_in_the_inputs_frame(tmp_path: Path) -> None:
    mesh, similarity = board(), turned()
    atlas, texture = textured(mesh, Photos([waves(CAMERA, 1.0)], [CAMERA], FRONT))
    path = tmp_path / "textured.glb"
    write_textured(path, mesh, atlas, texture, similarity)
    assert [item.name for item in tmp_path.iterdir()] == [path.name]
    read = trimesh.load(path, force="mesh", process=False)
    assert isinstance(read, trimesh.Trimesh) and read.visual.kind == "texture"
    expected = similarity.inverse().points(mesh.vertices)[mesh.triangles]
    assert np.abs(read.vertices[read.faces] - expected).max() < 1e-4 * np.ptp(expected)
    assert np.abs(np.asarray(read.visual.uv)[read.faces] - atlas.coordinates()).max() < 1e-6
    stored = np.asarray(read.visual.material.baseColorTexture.convert("RGB")).astype(int)
    assert stored.shape == texture.shape
    used = np.zeros(texture.shape[:2], bool)
    for index in range(len(mesh.triangles)):
        used[tuple(np.array(sorted(texels(atlas, index))).T)] = True
    assert np.abs(stored - texture)[used].mean() < 3  # JPEG
    data = path.read_bytes()
    head = json.loads(data[20 : 20 + struct.unpack("<I", data[12:16])[0]])
    assert head["extensionsUsed"] == ["KHR_materials_unlit"] and head["materials"][0]["extensions"] == {"KHR_materials_unlit": {}}
    with pytest.raises(InputError, match="no triangles"):
        write_textured(path, Mesh.empty(), make_atlas(Mesh.empty(), 1.0, 1024), texture)
