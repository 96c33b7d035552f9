"""Conventions and geometry: lens round trips against formulas written a second time, poses, similarities, projection."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldfuse.camera import (
    FISHEYE,
    OPENCV,
    PINHOLE,
    Array,
    Intrinsics,
    Similarity,
    distort,
    invert,
    lens_limit,
    opengl_from_world,
    pixel_grid,
    project,
    rays,
    resample_maps,
    undistort_maps,
    unproject,
    world_from_llff,
    world_from_opengl,
)
from fieldfuse.capture.poses import checked_pose
from fieldfuse.errors import InputError
from tests.capture.board import bend

CAMERA = Intrinsics(64, 48, 50.0, 52.0, 31.0, 25.5)
near = st.floats(-1, 1, allow_nan=False)


@st.composite
def rotations(draw: st.DrawFn) -> Array:
    axis = np.array([draw(near), draw(near), draw(near)])
    return cv2.Rodrigues(axis * draw(st.floats(0, 3)))[0]


@st.composite
def poses(draw: st.DrawFn) -> Array:
    out = np.eye(4)
    out[:3, :3] = draw(rotations())
    out[:3, 3] = [draw(st.floats(-100, 100)) for _ in range(3)]
    return out


@st.composite
def similarities(draw: st.DrawFn) -> Similarity:
    return Similarity(draw(st.floats(0.01, 100)), draw(rotations()), np.array([draw(st.floats(-50, 50)) for _ in range(3)]))


@st.composite
def lenses(draw: st.DrawFn) -> Intrinsics:
    """Cameras with any usual lens, one-to-one over the picture."""
    if draw(st.booleans()):
        values = (
            draw(st.floats(-0.05, 0.05)),
            draw(st.floats(-0.02, 0.02)),
            draw(st.floats(-0.005, 0.005)),
            draw(st.floats(-0.002, 0.002)),
        )
        return replace(CAMERA, lens=FISHEYE, distortion=values)
    values5 = (
        draw(st.floats(-0.15, 0.15)),
        draw(st.floats(-0.05, 0.05)),
        draw(st.floats(-0.005, 0.005)),
        draw(st.floats(-0.005, 0.005)),
        draw(st.floats(-0.01, 0.01)),
    )
    return replace(CAMERA, lens=OPENCV, distortion=values5[: draw(st.integers(4, 5))])


# ---------------------------------------------------------------------------------------------------- lens


@pytest.mark.parametrize("lens", [OPENCV, FISHEYE])
@pytest.mark.parametrize("count", range(9))
def test_any_number_of_coefficients(lens: str, count: int) -> None:
    values = (0.05, -0.02, 0.001, 0.002, 0.01, 0.0, 0.0, 0.0)[:count]
    if lens == FISHEYE and count > 4:
        with pytest.raises(InputError, match="at most 4"):
            replace(CAMERA, lens=lens, distortion=values).checked("here")
        return
    camera = replace(CAMERA, lens=lens, distortion=values).checked("here")
    padded = replace(camera, distortion=(values + (0.0,) * 8)[: 4 if lens == FISHEYE else 8])
    points = np.array([[0.2, -0.1], [0.0, 0.0], [-0.4, 0.3]])
    np.testing.assert_allclose(distort(camera, points), distort(padded, points), atol=1e-12)


def test_no_points_and_no_lens() -> None:
    assert distort(replace(CAMERA, lens=OPENCV, distortion=(0.1,)), np.zeros((0, 2))).shape == (0, 2)
    points = np.array([[0.3, 0.4]])
    assert distort(CAMERA, points) is not points
    np.testing.assert_array_equal(distort(CAMERA, points), points)
    assert not replace(CAMERA, lens=OPENCV, distortion=(0.0, 0.0)).distorted
    assert replace(CAMERA, lens=FISHEYE).distorted  # equidistant without coefficients is still no pinhole


@pytest.mark.parametrize("k1", [-0.1, -0.25, -0.4])
def test_lens_limit_is_where_the_polynomial_turns(k1: float) -> None:
    camera = replace(CAMERA, lens=OPENCV, distortion=(k1, 0.0, 0.003, 0.003))
    turn = (1 / (3 * -k1)) ** 0.5  # d/dr (r + k1 r³) = 0
    assert lens_limit(camera, 3.0) == pytest.approx(turn, abs=0.003)
    assert lens_limit(camera, 0.5 * turn) == 0.5 * turn
    assert lens_limit(CAMERA, 3.0) == 3.0


def test_undistort_maps_point_to_the_bent_place() -> None:
    camera = replace(CAMERA, lens=OPENCV, distortion=(-0.2, 0.05, 0.002, -0.001))
    target, map_x, map_y, valid = undistort_maps(camera, 32, 24)
    assert target == CAMERA.scaled(32, 24) and map_x.shape == map_y.shape == valid.shape == (24, 32) and map_x.dtype == np.float32
    for row, column in ((0, 0), (12, 16), (23, 31), (5, 29)):
        x, y = (column + 0.5 - target.cx) / target.fx, (row + 0.5 - target.cy) / target.fy
        bent_x, bent_y = bend(camera, np.array(x), np.array(y))
        assert map_x[row, column] == pytest.approx(float(bent_x) * camera.fx + camera.cx - 0.5, abs=1e-4)
        assert map_y[row, column] == pytest.approx(float(bent_y) * camera.fy + camera.cy - 0.5, abs=1e-4)


def test_without_a_lens_every_pixel_is_valid_and_its_own() -> None:
    for width, height in ((64, 48), (640, 480), (16, 12)):
        _, map_x, map_y, valid = undistort_maps(CAMERA, width, height)
        assert valid.all()
        np.testing.assert_allclose(map_x[0], (np.arange(width) + 0.5) * 64 / width - 0.5, atol=1e-4)
        np.testing.assert_allclose(map_y[:, 0], (np.arange(height) + 0.5) * 48 / height - 0.5, atol=1e-4)


def test_maps_between_two_cameras() -> None:
    other = Intrinsics(100, 80, 90.0, 91.0, 48.0, 41.0, OPENCV, (0.1, -0.02))
    map_x, map_y, valid = resample_maps(other, CAMERA)
    pixel = np.array([[40.5, 20.5]])
    point = unproject(CAMERA, np.eye(4), pixel, np.array([7.0]))
    expected, _ = project(other, np.eye(4), point)
    np.testing.assert_allclose([map_x[20, 40] + 0.5, map_y[20, 40] + 0.5], expected[0], atol=1e-4)
    assert valid[20, 40]


# ---------------------------------------------------------------------------------------------------- intrinsics


@given(st.integers(1, 4000), st.integers(1, 4000))
def test_scaling_keeps_rays(width: int, height: int) -> None:
    scaled = CAMERA.scaled(width, height)
    pixel = np.array([[10.0, 20.0]])
    moved = pixel * [width / 64, height / 48]
    np.testing.assert_allclose(unproject(CAMERA, np.eye(4), pixel, np.ones(1)), unproject(scaled, np.eye(4), moved, np.ones(1)), atol=1e-9)
    assert scaled.scaled(64, 48).fx == pytest.approx(50.0)


def test_matrices() -> None:
    np.testing.assert_array_equal(CAMERA.matrix(), [[50, 0, 31], [0, 52, 25.5], [0, 0, 1]])
    np.testing.assert_array_equal(CAMERA.matrix_integer_centres(), [[50, 0, 30.5], [0, 52, 25], [0, 0, 1]])
    projected = CAMERA.matrix() @ [0.2, 0.1, 2.0]
    np.testing.assert_allclose(projected[:2] / projected[2], project(CAMERA, np.eye(4), np.array([[0.2, 0.1, 2.0]]))[0][0])


@given(lenses())
def test_intrinsics_survive_json(camera: Intrinsics) -> None:
    assert Intrinsics.from_dict(json.loads(json.dumps(camera.to_dict()))) == camera


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"fx": -5.0}, "focal length is -5"),
        ({"fy": 0.0}, "focal length is 0"),
        ({"cx": float("nan")}, "not finite"),
        ({"distortion": (float("inf"),)}, "not finite"),
        ({"width": 0}, "size"),
        ({"lens": "magic"}, "magic"),
        ({"lens": PINHOLE, "distortion": (0.1,)}, "at most 0"),
    ],
)
def test_unusable_intrinsics(change: dict, text: str) -> None:
    with pytest.raises(InputError, match=rf"somewhere.*{text}"):
        replace(CAMERA, **change).checked("somewhere")


# ---------------------------------------------------------------------------------------------------- poses


@given(poses())
def test_invert(pose: Array) -> None:
    np.testing.assert_allclose(invert(pose) @ pose, np.eye(4), atol=1e-9)
    stack = np.stack([pose, np.eye(4)])
    np.testing.assert_allclose(invert(invert(stack)), stack, atol=1e-9)


@given(poses())
def test_opengl_axes_there_and_back(pose: Array) -> None:
    np.testing.assert_array_equal(opengl_from_world(world_from_opengl(pose)), pose)
    assert np.linalg.det(world_from_opengl(pose)[:3, :3]) == pytest.approx(1)
    np.testing.assert_allclose(world_from_opengl(pose)[:3, 2], -pose[:3, 2])  # it looks where the other looks


def test_llff_axes() -> None:
    down, right, back = np.array([0.0, -1, 0]), np.array([1.0, 0, 0]), np.array([0.0, 0, 1])
    out = world_from_llff(np.stack([down, right, back, [1, 2, 3]], axis=1))
    np.testing.assert_array_equal(out[:3, 0], right)
    np.testing.assert_array_equal(out[:3, 1], down)
    np.testing.assert_array_equal(out[:3, 2], -back)
    np.testing.assert_array_equal(out[:3, 3], [1, 2, 3])
    assert np.linalg.det(out[:3, :3]) == pytest.approx(1)


@given(poses(), st.floats(-1e-3, 1e-3))
def test_checked_pose_repairs_rounding(pose: Array, error: float) -> None:
    worn = pose.copy()
    worn[:3, :3] *= 1 + error
    out = checked_pose(worn, "here")
    np.testing.assert_allclose(out, pose, atol=1e-6)
    np.testing.assert_allclose(out[:3, :3].T @ out[:3, :3], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(checked_pose(pose[:3], "here"), pose, atol=1e-6)


def changed(place: tuple[int, int], value: float) -> Array:
    pose = np.eye(4)
    pose[place] = value
    return pose


@pytest.mark.parametrize(
    ("pose", "text"),
    [
        (changed((0, 0), np.nan), "not finite"),
        (changed((1, 3), np.inf), "not finite"),
        (changed((0, 0), 0.0), "singular"),
        (np.zeros((4, 4)), "singular"),
        (changed((2, 2), -1.0), "mirrors"),
        (changed((0, 0), 1.1), "not rigid"),
        (changed((0, 1), 0.3), "not rigid"),
        (2.0 * np.eye(4), "not rigid"),
        ([[1e160, 1e160, 0, 0], [-1e160, 1e160, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], "not rigid"),  # its square is ∞ − ∞
        (np.eye(3), "shape"),
        ([[1, 2], [3]], "not a matrix"),
        ([["a", "b", "c", "d"]] * 4, "not a matrix"),
        (None, "not a matrix|shape|not finite"),
    ],
)
def test_unusable_poses(pose: Array, text: str) -> None:
    with pytest.raises(InputError, match=f"frame 7.*({text})"):
        checked_pose(pose, "frame 7")


@pytest.mark.parametrize("far", [1e200, -1e13])
def test_a_pose_astronomically_far_away_is_refused(far: float) -> None:
    pose = np.eye(4)
    pose[1, 3] = far
    with pytest.raises(InputError, match=r"frame 7: the pose's translation is .*further than 1e\+12"):
        checked_pose(pose, "frame 7")
    pose[1, 3] = -6.4e9  # millimetres from the middle of the earth
    np.testing.assert_array_equal(checked_pose(pose, "frame 7"), pose)


# ---------------------------------------------------------------------------------------------------- similarities


@given(similarities(), similarities(), similarities(), st.lists(st.tuples(near, near, near), min_size=1, max_size=5))
def test_similarities_are_a_group(a: Similarity, b: Similarity, c: Similarity, values: list[tuple[float, float, float]]) -> None:
    points = np.array(values)
    size = 1e-9 * 100**3 * 60  # largest coordinates that three scales of 100 can make
    np.testing.assert_allclose(a.after(b).points(points), a.points(b.points(points)), atol=size, rtol=1e-9)
    np.testing.assert_allclose(a.after(b).after(c).points(points), a.after(b.after(c)).points(points), atol=size, rtol=1e-9)
    np.testing.assert_allclose(a.after(Similarity.identity()).points(points), a.points(points))
    np.testing.assert_allclose(a.inverse().points(a.points(points)), points, atol=1e-6)
    np.testing.assert_allclose(a.points(a.inverse().points(points)), points, atol=1e-6)
    np.testing.assert_allclose(a.after(a.inverse()).points(points), points, atol=1e-6)


@given(similarities(), poses(), st.tuples(near, near, st.floats(0.5, 5)))
def test_a_similarity_moves_cameras_with_their_points(similarity: Similarity, pose: Array, place: tuple[float, float, float]) -> None:
    """The same pixel, and depth times the scale."""
    point = np.array([place]) @ pose[:3, :3].T + pose[:3, 3]
    pixel, depth = project(CAMERA, pose, point)
    moved = similarity.poses(pose)
    new_pixel, new_depth = project(CAMERA, moved, similarity.points(point))
    np.testing.assert_allclose(new_pixel, pixel, atol=1e-5)
    np.testing.assert_allclose(new_depth, depth * similarity.scale, rtol=1e-6)
    np.testing.assert_allclose(moved[:3, :3].T @ moved[:3, :3], np.eye(3), atol=1e-9)  # still rigid
    np.testing.assert_allclose(similarity.inverse().poses(moved), pose, atol=1e-6)
    np.testing.assert_allclose(similarity.directions(pose[:3, 2]), moved[:3, 2], atol=1e-9)


# ---------------------------------------------------------------------------------------------------- projection, rays


@given(poses(), st.lists(st.tuples(st.floats(0, 64), st.floats(0, 48), st.floats(0.1, 1000)), min_size=1, max_size=20))
def test_project_after_unproject_is_identity(pose: Array, values: list[tuple[float, float, float]]) -> None:
    pixels, depth = np.array(values)[:, :2], np.array(values)[:, 2]
    got, z = project(CAMERA, pose, unproject(CAMERA, pose, pixels, depth))
    np.testing.assert_allclose(got, pixels, atol=1e-6)
    np.testing.assert_allclose(z, depth, rtol=1e-9, atol=1e-9)


@settings(deadline=None)
@given(poses())
def test_rays_go_through_their_pixels(pose: Array) -> None:
    pose[:3, 3] /= 50  # rays are float32
    pixels = pixel_grid(8, 6) * 8
    origins, directions, cosine = rays(CAMERA, pose, pixels)
    assert origins.dtype == directions.dtype == cosine.dtype == torch.float32
    np.testing.assert_allclose(directions.norm(dim=1).numpy(), 1, atol=1e-5)
    along = (origins + 3.0 * directions).double().numpy()
    got, depth = project(CAMERA, pose, along)
    np.testing.assert_allclose(got, pixels, atol=2e-3)
    np.testing.assert_allclose(depth, 3.0 * cosine.numpy(), rtol=1e-4)


def test_pixel_grid_runs_row_by_row() -> None:
    np.testing.assert_array_equal(pixel_grid(3, 2), [[0.5, 0.5], [1.5, 0.5], [2.5, 0.5], [0.5, 1.5], [1.5, 1.5], [2.5, 1.5]])
