"""Working frame, region and depth range on captures whose truth is known."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldfuse.camera import (
    Intrinsics,
    Similarity,
    project,
    world_from_opengl,
)
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.errors import InputError, PoseError
from fieldfuse.poses.cloud import cloud_of_depth, cloud_of_points
from fieldfuse.poses.points import intersect, tracks, triangulate
from fieldfuse.poses.region import (
    FORWARD,
    OBJECT,
    ROOM,
    box,
    camera_frame,
    layout,
    tight_turn,
    turn_about_z,
    up_direction,
    weighted_percentiles,
)
from fieldfuse.poses.scene import Scene, describe_scene
from tests.conftest import shared_data
from tests.poses.textured import CAMERA, arc, look_at, render


@pytest.fixture(scope="module")
def corner(tmp_path_factory) -> Capture:
    """Ten posed pictures of the textured corner, with depth maps in millimetres beside them."""
    folder = tmp_path_factory.mktemp("posed")
    frames = []
    for n, pose in enumerate(arc(10)):
        picture, depth = render(pose)
        cv2.imwrite(str(folder / f"{n}.png"), picture)
        cv2.imwrite(str(folder / f"{n}.depth.png"), np.round(depth * 1000).astype(np.uint16))
        frames.append(Frame(str(n), folder / f"{n}.png", CAMERA, pose, depth=folder / f"{n}.depth.png"))
    return Capture("transforms", folder, tuple(frames))


def without_depth(capture: Capture) -> Capture:
    return capture.with_frames([replace(frame, depth=None) for frame in capture.frames])


@pytest.fixture(scope="module")
def scene(corner) -> Scene:
    return describe_scene(without_depth(corner))


def moved(capture: Capture, similarity: Similarity) -> Capture:
    points = None if capture.points is None else similarity.points(capture.points)
    frames = [replace(f, world_from_camera=similarity.poses(f.world_from_camera)) for f in capture.frames]
    return replace(capture, frames=tuple(frames), points=points)


# --------------------------------------------------------------------------------------------------- points


def test_triangulated_points_lie_on_the_surfaces_and_reproject(corner):
    cloud = triangulate(without_depth(corner))
    assert len(cloud.points) > 300 and cloud.views.min() >= 2
    for i, frame in enumerate(corner.frames):
        mine = cloud.frame == i
        pixels, depth = project(frame.intrinsics, frame.world_from_camera, cloud.points[cloud.point[mine]])
        np.testing.assert_allclose(depth, cloud.depth[mine], rtol=1e-9)
        true = cv2.imread(str(frame.depth), cv2.IMREAD_UNCHANGED) / 1000
        inside = (pixels > 1).all(axis=1) & (pixels[:, 0] < 319) & (pixels[:, 1] < 239)
        seen = true[pixels[inside, 1].astype(int), pixels[inside, 0].astype(int)]
        assert np.median(np.abs(seen - depth[inside]) / depth[inside]) < 0.01


def test_wrong_axes_are_noticed(corner):
    """OpenGL poses taken for OpenCV ones leave no consistent points: said so, not fitted to fog."""
    wrong = without_depth(corner).with_frames(
        [replace(f, world_from_camera=world_from_opengl(f.world_from_camera)) for f in without_depth(corner).frames]
    )
    with pytest.raises(PoseError, match="axis convention"):
        describe_scene(wrong)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.integers(2, 6))
def test_intersect_recovers_exact_points(seed, views):
    random = np.random.default_rng(seed)
    poses = arc(views, 60.0)
    world = random.uniform([-1, -1.5, 1], [1, 0, 3], (20, 3))
    frame, track, flat = [], [], []
    for i, pose in enumerate(poses):
        local = (world - pose[:3, 3]) @ pose[:3, :3]
        frame += [i] * 20
        track += list(range(20))
        flat.append(local[:, :2] / local[:, 2:])
    tolerance = np.full(20 * views, 1e-3)
    points, _, kept, depth = intersect(poses, np.array(frame), np.concatenate(flat), np.array(track), tolerance)
    np.testing.assert_allclose(points, world, atol=1e-7)
    assert len(kept) == 20 * views and (depth > 0).all()


def test_intersect_drops_narrow_behind_and_inconsistent():
    poses = np.array([look_at(np.array([x, 0.0, 0.0]), np.array([x, 0.0, 5.0])) for x in (0.0, 0.01, 1.0)])
    world = np.array([[0.2, 0.1, 5.0]])
    flat = np.array([((world - pose[:3, 3]) @ pose[:3, :3])[0, :2] / 5.0 for pose in poses])
    frame = np.array([0, 1, 0, 2, 0, 2, 0, 2])
    track = np.array([0, 0, 1, 1, 2, 2, 3, 3])
    observed = np.concatenate([flat[[0, 1]], flat[[0, 2]], flat[[0, 2]] + [[0, 0], [0, 0.1]], flat[[0, 2]] * [[1, 1], [-9, 1]]])
    points, _, kept, _ = intersect(poses, frame, observed, track, np.full(8, 2e-3))
    np.testing.assert_allclose(points, world, atol=1e-9)
    assert sorted(kept) == [2, 3]


def test_tracks_join_through_frames_and_drop_contradictions():
    owner = np.array([0, 0, 1, 1, 2, 2])
    track, keypoint = tracks(np.array([[0, 2], [2, 4]]), owner)
    assert track.tolist() == [0, 0, 0] and keypoint.tolist() == [0, 2, 4]
    track, keypoint = tracks(np.array([[0, 2], [2, 4], [4, 1], [3, 5]]), owner)  # 0 and 1 are one frame
    assert keypoint.tolist() == [3, 5] and track.tolist() == [0, 0]
    assert len(tracks(np.zeros((0, 2), np.int64), owner)[0]) == 0


def test_fox_points_reproject_within_two_pixels():
    from fieldfuse.capture import open_capture

    fox = open_capture(shared_data("fox_540x960"))
    fox = fox.with_frames(fox.frames[:12])
    cloud = triangulate(fox)
    assert len(cloud.points) > 500
    off = []
    for i in np.unique(cloud.frame):
        frame = fox.frames[i]
        pixels, depth = project(frame.intrinsics, frame.world_from_camera, cloud.points[cloud.point[cloud.frame == i]])
        assert (depth > 0).all()
        grey = cv2.resize(cv2.cvtColor(cv2.imread(str(frame.image)), cv2.COLOR_BGR2GRAY), (360, 640), interpolation=cv2.INTER_AREA)
        keypoints = np.array([k.pt for k in cv2.SIFT.create(nfeatures=1500, contrastThreshold=0.02).detect(grey, None)]) + 0.5
        scaled = pixels * [360 / frame.intrinsics.width, 640 / frame.intrinsics.height]
        off.append(np.linalg.norm(scaled[:, None] - keypoints[None], axis=-1).min(axis=1))
    assert np.concatenate(off).max() < 2.0  # by chance, few would lie so close to a keypoint
    assert describe_scene(fox).median_depth == pytest.approx(1.5)


# ---------------------------------------------------------------------------------------------- working frame


def test_working_frame_has_z_up_depth_one_and_a_half_and_the_region_at_its_centre(corner, scene):
    np.testing.assert_allclose(scene.working_from_input.directions(np.array([0.0, -1.0, 0.0])), [0, 0, 1], atol=0.15)
    assert scene.median_depth == pytest.approx(1.5)
    assert not scene.metric and scene.layout == OBJECT and scene.points_source == "triangulated"
    np.testing.assert_array_equal(scene.centre, 0)
    box_corner = scene.working_from_input.points(np.array([0.7, -0.9, 1.2]))
    assert np.all(np.abs(box_corner - scene.centre) < scene.half_size)
    assert 0 < scene.near < 1.5 < scene.far and scene.has_background


@pytest.mark.parametrize(("layout", "grown"), [("object", 1.2), ("forward", 1.2), ("room", 1.0)])
def test_surfaces_may_stand_out_of_the_region_but_in_rooms(layout, grown, scene):
    low, high = replace(scene, layout=layout).surface_box()
    np.testing.assert_allclose((low + high) / 2, scene.centre, atol=1e-12)
    np.testing.assert_allclose((high - low) / 2, grown * scene.half_size)


def test_the_scene_does_not_depend_on_where_and_how_large_the_input_is(corner, scene):
    move = Similarity(37.0, cv2.Rodrigues(np.array([0.4, -1.0, 0.3]))[0], np.array([6.3e6, -1e6, 2e6]))
    far = describe_scene(moved(without_depth(corner), move))
    # Up is told by the pictures, so heights agree and nothing is lost to the large numbers; the turn about z is free.
    assert far.half_size[2] == pytest.approx(scene.half_size[2], rel=1e-3)
    assert np.prod(far.half_size) == pytest.approx(np.prod(scene.half_size), rel=0.2)
    assert far.working_from_input.scale * 37 == pytest.approx(scene.working_from_input.scale, rel=1e-3)
    poses = np.array([f.world_from_camera for f in moved(corner, move).frames])
    back = far.working_from_input.inverse().poses(far.working_from_input.poses(poses))
    assert np.abs(back[:, :3, 3] - poses[:, :3, 3]).max() < 1e-7  # 6000 km: float64 itself steps by 1e-9
    near = np.array([f.world_from_camera for f in corner.frames])
    back = scene.working_from_input.inverse().poses(scene.working_from_input.poses(near))
    np.testing.assert_allclose(back, near, atol=1e-9)


def test_metric_captures_keep_their_metres_and_use_depth(corner):
    told = describe_scene(replace(corner, metric=True))
    assert told.metric and told.working_from_input.scale == 1.0 and told.points_source == "depth"
    true = np.median([np.median(cv2.imread(str(f.depth), cv2.IMREAD_UNCHANGED) / 1000) for f in corner.frames])
    assert told.median_depth == pytest.approx(true, rel=0.03)
    cloud = cloud_of_depth(corner)
    inside = np.abs(told.working_from_input.points(cloud.points)) <= told.half_size
    assert inside.all(axis=1).mean() > 0.95 and told.background_share < 0.05 and not told.has_background


def test_points_of_the_source_are_used_and_given_up_wins(corner):
    points = cloud_of_depth(corner).points[::20]
    told = describe_scene(replace(without_depth(corner), points=points, up=(0.0, 0.0, 2.0)))
    assert told.points_source == "source" and told.up_reason == "given by the source"
    np.testing.assert_allclose(told.working_from_input.directions(np.array([0.0, 0.0, 1.0])), [0, 0, 1], atol=1e-12)


def test_silhouettes_bound_the_object(tmp_path):
    """A ball of radius 0.4 at (0.3, 0.2, 0.1), seen all around with alpha and no texture at all."""
    centre, radius = np.array([0.3, 0.2, 0.1]), 0.4
    frames = []
    for n in range(16):
        a = 2 * np.pi * n / 16
        eye = np.array([3 * np.cos(a), -1.0 + 0.5 * np.sin(3 * a), 3 * np.sin(a)])
        pose = look_at(eye, np.zeros(3))
        v, u = np.mgrid[0:120, 0:160] + 0.5
        camera = Intrinsics(160, 120, 170.0, 170.0, 80.0, 60.0)
        rays = np.stack([(u - 80) / 170, (v - 60) / 170, np.ones_like(u)], axis=-1) @ pose[:3, :3].T
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        along = rays @ (centre - eye)
        hit = np.linalg.norm(centre - eye) ** 2 - along**2 < radius**2
        picture = np.zeros((120, 160, 4), np.uint8)
        picture[hit] = (120, 60, 30, 255)
        cv2.imwrite(str(tmp_path / f"{n:02d}.png"), picture)
        frames.append(Frame(f"{n:02d}", tmp_path / f"{n:02d}.png", camera, pose))
    told = describe_scene(Capture("blender", tmp_path, tuple(frames), alpha=True, up=(0.0, -1.0, 0.0)))
    scale = told.working_from_input.scale
    assert told.points_source == "silhouettes" and not told.has_background and told.background_share == 0.0
    np.testing.assert_allclose(told.working_from_input.inverse().points(told.centre), centre, atol=0.08)
    assert np.all(told.half_size / scale >= 0.95 * radius) and np.all(told.half_size / scale < 1.35 * radius)


def test_scene_round_trip_and_damage(scene):
    back = Scene.from_dict(json.loads(json.dumps(scene.to_dict(), allow_nan=False)))
    assert back.to_dict() == scene.to_dict()
    with pytest.raises(InputError, match=r"scene\.json"):
        Scene.from_dict({**scene.to_dict(), "half_size": [1, 2]})


def test_an_unposed_capture_is_refused():
    with pytest.raises(PoseError, match="poses stage"):
        describe_scene(Capture("photos", Path("/nowhere"), (Frame("a", Path("/nowhere/a.png")),)))


# ----------------------------------------------------------------------------------------- gravity and region


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.floats(-80, 20))
def test_up_is_found_for_level_cameras_that_look_around_however_the_world_lies(seed, pitch):
    random = np.random.default_rng(seed)
    eyes = random.uniform(-2, 2, (30, 3))
    yaw = random.uniform(0, 2 * np.pi, 30)
    tilt = np.radians(pitch)
    ahead = np.stack([np.cos(yaw) * np.cos(tilt), np.full(30, -np.sin(tilt)), np.sin(yaw) * np.cos(tilt)], axis=1)
    poses = np.array([look_at(eye, eye + a) for eye, a in zip(eyes, ahead, strict=True)])
    lie = Similarity(1.0, cv2.Rodrigues(random.standard_normal(3))[0], np.zeros(3))
    up, reason = up_direction(lie.poses(poses))
    assert np.degrees(np.arccos(np.clip(up @ lie.directions(np.array([0, -1.0, 0])), -1, 1))) < 3 and reason


def test_up_of_cameras_that_look_straight_down_is_where_they_stand():
    poses = np.array(
        [
            look_at(np.array([0.1 * n, -2.0, 0.02 * n]), np.array([0.1 * n + 0.1 * np.cos(n), 0.0, 0.02 * n + 0.1 * np.sin(n)]))
            for n in range(24)
        ]
    )
    up, _ = up_direction(poses)
    assert up @ [0, -1, 0] > 0.99


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000))
def test_the_frame_of_the_cameras_is_the_same_however_the_world_lies(seed):
    random = np.random.default_rng(seed)
    poses = np.array([look_at(eye, random.uniform(-1, 1, 3)) for eye in random.uniform(-3, 3, (12, 3))])
    if seed % 3 == 0:  # the first camera lies on its side
        poses[0, :3, :3] = poses[0, :3, :3] @ cv2.Rodrigues(np.array([0, 0, np.pi / 2]))[0]
    lie = Similarity(1.0, cv2.Rodrigues(random.standard_normal(3))[0], random.standard_normal(3))
    frame, reason = camera_frame(poses)
    turned, again = camera_frame(lie.poses(poses))
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(frame) > 0 and reason == again
    if "kept as it is" not in reason:
        np.testing.assert_allclose(turned @ lie.poses(poses)[:, :3, :3], frame @ poses[:, :3, :3], atol=1e-9)


@given(st.floats(-44, 44))
def test_tight_turn_squares_a_turned_room(angle):
    grid = np.stack(np.meshgrid(np.linspace(-3, 3, 30), np.linspace(-1, 1, 12), [0.0], indexing="ij"), axis=-1).reshape(-1, 3)
    turned = grid @ turn_about_z(angle).T
    np.testing.assert_allclose(turn_about_z(90) @ [1.0, 0, 0], [0, 1, 0], atol=1e-12)  # counter-clockwise, seen from above
    back = turned @ turn_about_z(tight_turn(turned)).T
    assert np.prod(np.ptp(back[:, :2], axis=0)) <= 12 * 1.02  # to a tenth of a degree


def test_layouts():
    assert layout(arc(12, 120.0)).kind == OBJECT
    np.testing.assert_allclose(layout(arc(12, 120.0)).focus, [-0.1, -0.7, 2.0], atol=1e-3)
    ahead = np.array([look_at(np.array([x, y, 0.0]), np.array([x, y, 9.0])) for x in (-1, 0, 1) for y in (-1, 0.5, 1)])
    assert layout(ahead).kind == FORWARD
    around = np.array(
        [
            look_at(np.zeros(3) + 0.1 * np.array([np.sin(3 * a), 0, np.cos(5 * a)]), np.array([np.cos(a), 0.1, np.sin(a)]))
            for a in np.linspace(0, 6, 20)
        ]
    )
    assert layout(around).kind == ROOM


def test_boxes_ignore_strays_and_have_depth():
    random = np.random.default_rng(0)
    points = np.concatenate([random.uniform(-1, 1, (2000, 3)) * [1, 2, 0.001], [[500.0, 0, 0]] * 5])
    centre, half = box(points, np.ones(len(points)), (1.0, 99.0))
    np.testing.assert_allclose(centre, 0, atol=0.1)
    assert 1.0 < half[0] < 1.2 and 2.0 < half[1] < 2.3 and half[2] > 0.19
    low, high = weighted_percentiles(np.array([0.0, 1.0, 2.0]), np.array([1.0, 1.0, 1e6]), (25, 75))
    assert low > 1.0 and high <= 2.0


def test_points_without_tracks_count_as_seen_where_they_are_in_view(corner):
    points = np.array([[0.0, -0.5, 1.2], [0.0, -0.5, -50.0]])
    cloud = cloud_of_points(corner, points, "source")
    assert cloud.views.tolist() == [10, 0]
