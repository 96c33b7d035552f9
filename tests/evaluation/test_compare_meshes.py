"""Pictures of meshes: who is seen, from where, in which colours."""

from __future__ import annotations

import numpy as np
import trimesh

from fieldfuse.camera import Intrinsics, project
from fieldfuse.evaluation.compare_meshes import NOTHING, cut_box, from_outside, mesh_pictures, picture
from fieldfuse.render.paths import look_at
from fieldfuse.tsdf.mesh import Mesh

CAMERA = Intrinsics(64, 48, 60.0, 60.0, 32.0, 24.0)
POSE = look_at(np.array([[0.0, -4, 0]]), np.zeros(3), np.array([0.0, 0, 1]))[0]


def ball(radius: float = 1.0, colour: tuple[int, int, int] = (200, 40, 40)) -> Mesh:
    made = trimesh.creation.icosphere(3, radius)
    return Mesh.create(made.vertices, made.faces, np.tile(np.array(colour, np.uint8), (len(made.vertices), 1)))


def test_colours_shape_and_distance() -> None:
    (view,) = mesh_pictures({"near": ball(1.0), "far": ball(1.05, (40, 200, 40))}, ball(), [("front", CAMERA, POSE)], 0.05)
    assert set(view.kinds) == {"coloured", "shape", "distance"}
    assert set(view.kinds["shape"]) == {"truth", "near", "far"} and set(view.kinds["coloured"]) == {"near", "far"}
    middle = (24, 32)
    assert view.kinds["coloured"]["near"][middle].tolist() == [200, 40, 40]
    assert view.kinds["coloured"]["far"][middle].tolist() == [40, 200, 40]
    assert tuple(view.kinds["shape"]["truth"][0, 0]) == NOTHING
    assert np.ptp(view.kinds["shape"]["near"][middle]) == 0  # grey
    # On the truth it is dark, a voxel off it is not.
    assert view.kinds["distance"]["near"][middle].max() < 30 < view.kinds["distance"]["far"][middle].max()


def test_without_truth_there_is_no_distance() -> None:
    (view,) = mesh_pictures({"near": ball(), "none": Mesh.empty()}, None, [("front", CAMERA, POSE)], 0.05)
    assert set(view.kinds) == {"coloured", "shape"} and set(view.kinds["shape"]) == {"near"}


def test_one_looks_into_a_room_from_outside() -> None:
    room = ball(3.0)
    inwards = Mesh(room.vertices, room.triangles[:, ::-1], room.colours)
    both = Mesh.create(
        np.concatenate([inwards.vertices, ball(0.5).vertices]),
        np.concatenate([inwards.triangles, ball(0.5).triangles + len(inwards.vertices)]),
        np.concatenate([inwards.colours, ball(0.5, (20, 20, 220)).colours]),
    )
    away = look_at(np.array([[0.0, -9, 0]]), np.zeros(3), np.array([0.0, 0, 1]))[0]
    (closed,) = mesh_pictures({"room": both}, None, [("outside", CAMERA, away)], 0.05)
    (opened,) = mesh_pictures({"room": both}, None, [("outside", CAMERA, away)], 0.05, (np.full(3, -4.0), np.full(3, 4.0)))
    assert closed.kinds["coloured"]["room"][24, 32].tolist() == [200, 40, 40]
    assert opened.kinds["coloured"]["room"][24, 32].tolist() == [20, 20, 220]
    (cut,) = mesh_pictures({"room": both}, None, [("outside", CAMERA, away)], 0.05, (np.full(3, -1.0), np.full(3, 1.0)))
    assert tuple(cut.kinds["coloured"]["room"][24, 44]) == NOTHING


def test_the_view_from_outside_has_the_region_in_it() -> None:
    centre, half = np.array([2.0, 1.0, 0.5]), np.array([2.0, 1.5, 1.0])
    poses = look_at(np.array([[6.0, 1.0, 1.0], [5.5, 2, 1]]), centre, np.array([0.0, 0, 1]))
    camera, pose = from_outside(centre, half, poses)
    assert pose[0, 3] > centre[0] + 2 and pose[2, 3] > centre[2] + 1  # where the cameras stand, and above
    pixels, depth = project(camera, pose, centre + np.array([[0, 0, 0], [0, 0, half[2]], [0, -half[1], 0]]))
    assert (depth > 0).all() and ((pixels > 0) & (pixels < [camera.width, camera.height])).all()
    low, high = cut_box(centre, half)
    assert (low < centre - half).all() and (high > centre + half).all()


def test_flat_colours_are_one_a_triangle() -> None:
    sheet = Mesh.create(np.array([[-1.0, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]]), np.array([[0, 1, 2], [0, 2, 3]]))
    shown = picture(sheet, CAMERA, POSE, np.array([[250, 0, 0], [0, 0, 250]], np.uint8))
    colours = {tuple(int(v) for v in value) for value in shown.reshape(-1, 3)}
    assert colours == {NOTHING, (250, 0, 0), (0, 0, 250)}
