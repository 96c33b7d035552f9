"""Cameras: 1° to 170°, strong and folding lenses, and cameras that stand badly: on one spot, in a line, looking straight up."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldfuse.camera import (
    FISHEYE,
    OPENCV,
    PINHOLE,
    Array,
    Intrinsics,
    distort,
    lens_limit,
    pixel_grid,
    project,
    rays,
    resample_maps,
    undistort_maps,
    unproject,
)
from fieldfuse.capture.poses import checked_pose
from fieldfuse.capture.types import Capture, Frame, Views
from fieldfuse.errors import InputError, PoseError
from fieldfuse.evaluation.score import nearest_training
from fieldfuse.nerfusion.keyframes import select_keyframes
from fieldfuse.poses.points import intersect, undistorted
from fieldfuse.poses.region import up_direction
from fieldfuse.poses.result import given_poses
from fieldfuse.render.paths import look_at, orbit
from tests.stability.hard import reference
from tests.stability.hard.errors import absolute, largest, not_finite, refused, relative
from tests.stability.hard.ranges import QUICK
from tests.stability.hard.within import Within

GROUP = "cameras"
LENS = 1e-8  # image-plane units, after bending and unbending
BENT = 1e-12  # image-plane units, against the formula
PIXEL = 1e-8
POSE = look_at(np.array([[0.7, -1.1, 0.4]]), np.array([0.1, 0.2, 0.3]), np.array([0.0, 0, 1]))[0]
STRONG: dict[str, Intrinsics] = {
    "barrel": Intrinsics(640, 480, 420.0, 425.0, 330.0, 235.0, OPENCV, (-0.35, 0.12, 1e-3, -8e-4, -0.02)),
    "cushion": Intrinsics(640, 480, 420.0, 425.0, 310.0, 245.0, OPENCV, (0.35, 0.08, -1e-3, 2e-3)),
    "rational": Intrinsics(640, 480, 300.0, 300.0, 320.0, 240.0, OPENCV, (0.6, -0.05, 5e-4, -3e-4, 0.01, 0.95, 0.1, 0.02)),
    "fisheye": Intrinsics(640, 480, 210.0, 210.0, 322.0, 238.0, FISHEYE, (0.08, -0.02, 4e-3, -5e-4)),
}


def of_fov(degrees: float, width: int = 64, height: int = 48) -> Intrinsics:
    """A pinhole camera of so many degrees across."""
    focal = 0.5 * width / math.tan(math.radians(degrees) / 2)
    return Intrinsics(width, height, focal, focal, width / 2, height / 2)


def projection_errors(camera: Intrinsics, pose: Array, pixels: Array, depth: Array) -> dict[str, float]:
    """Pixels → points → pixels, and rays through the same pixels, by a pinhole camera."""
    points = unproject(camera, pose, pixels, depth)
    again, z = project(camera, pose, points)
    _, directions, cosine = (values.double().numpy() for values in rays(camera, pose, pixels))
    offset = points - pose[:3, 3]
    distance = np.linalg.norm(offset, axis=1)
    return {
        "pixels there and back, by the focal length": absolute(again, pixels) / max(camera.fx, camera.width),
        "depth there and back, relative": relative(z, depth),
        "ray beside its point, relative": float(np.linalg.norm(offset - directions * distance[:, None], axis=1).max() / distance.max()),
        "depth from distance, relative": relative(distance * cosine, depth),
        "values that are not finite": not_finite(points, again, directions, cosine),
    }


def lens_errors(camera: Intrinsics, points: Array) -> dict[str, float]:
    """Bending (N, 2) image-plane points against the model written out, and bending then unbending them."""
    bent = distort(camera, points)
    written = [reference.lens(camera.lens, camera.distortion, float(x), float(y)) for x, y in points]
    pixels = bent * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    back = undistorted(camera, pixels)
    return {
        "bent": absolute(bent, np.array(written)),
        "bent and unbent": absolute(back, points),
        "values that are not finite": not_finite(bent, back),
    }


def test_fields_of_view(within: Within) -> None:
    """Fields of view from 1° to 170°."""
    bounds = {
        "pixels there and back, by the focal length": PIXEL,
        "depth there and back, relative": 1e-12,
        "ray beside its point, relative": 2e-7,
        "depth from distance, relative": 2e-7,
        "values that are not finite": 0.0,
    }
    depth = np.random.default_rng(0).uniform(0.01, 100, 64 * 48)
    angles = (1.0, 5.0, 30.0, 90.0, 140.0, 170.0)
    within.each(largest(projection_errors(of_fov(angle), POSE, pixel_grid(64, 48), depth) for angle in angles), others=bounds)


def test_principal_points(within: Within) -> None:
    """Principal points far outside the picture."""
    for cx, cy in ((-500.0, 24.0), (32.0, 5000.0), (1e5, -1e5)):
        camera = Intrinsics(64, 48, 60.0, 60.0, cx, cy)
        errors = projection_errors(camera, POSE, pixel_grid(64, 48), np.full(64 * 48, 2.5))
        size = max(1.0, abs(cx) / 60)
        name = f"principal point ({cx:g}, {cy:g})"
        within(f"{name}: pixels there and back", errors["pixels there and back, by the focal length"], PIXEL * size)
        within(f"{name}: rays, relative", errors["ray beside its point, relative"], 2e-7)
        _, map_x, _, seen = undistort_maps(camera, 32, 24)
        within(f"{name}: pixels without source", float((~seen).sum()) + not_finite(map_x), 0.0)


def test_strong_lenses(within: Within) -> None:
    """Strong lenses and their inverse to 1e-8."""
    for name, camera in STRONG.items():
        most = 1.4 if camera.lens == FISHEYE else 0.75
        reach = min(most, lens_limit(camera, most) * 0.98)
        angle = np.linspace(0, 2 * np.pi, 37)
        points = np.concatenate([r * np.stack([np.cos(angle), np.sin(angle)], axis=1) for r in np.linspace(0, reach, 12)])
        for what, error in lens_errors(camera, points).items():
            within(f"{name}: {what}", error, {"bent": BENT, "bent and unbent": LENS}.get(what, 0.0))
    ahead = np.tan(np.radians(np.linspace(0, 80, 60)))[:, None] * [np.cos(0.3), np.sin(0.3)]  # 160° across
    errors = lens_errors(STRONG["fisheye"], ahead)
    within("wide fisheye: bent", errors["bent"] + errors["values that are not finite"], BENT)


def test_folding_lens(within: Within) -> None:
    """A lens that folds back claims no pixel twice."""
    camera = Intrinsics(400, 400, 180.0, 180.0, 200.0, 200.0, OPENCV, (-0.25, 0.0, 0.0, 0.0))
    exact = 1 / math.sqrt(0.75)  # where r (1 - r²/4) turns back
    _, map_x, map_y, seen = undistort_maps(camera, 400, 400)
    v, u = np.nonzero(seen)
    radius = np.hypot((u + 0.5 - 200) / 180, (v + 0.5 - 200) / 180)
    line = seen[200]
    within("radius where it folds, relative", abs(lens_limit(camera, 3.0) / exact - 1), 2e-3)
    within("pixels beyond the fold", float((radius > exact * 1.002).sum()), 0.0)
    within("columns out of order along the middle row", float((np.diff(map_x[200][line]) <= 0).sum()), 0.0)
    within("maps that are not finite", not_finite(map_x[seen], map_y[seen]), 0.0)


def test_behind(within: Within) -> None:
    """Points on, behind and almost in the camera."""
    camera = STRONG["barrel"]
    pose = np.eye(4)
    points = np.array([[0, 0, 0.0], [0.1, 0, 0], [0, 0, -1.0], [5, 5, -1e-9], [0, 0, 1e-13], [0, 0, 1e-9], [0.2, 0.1, 1.0]])
    pixels, depth = project(camera, pose, points)
    within("points not in front that get a pixel", float(np.isfinite(pixels[:5]).sum()), 0.0)
    within("points in front without one", not_finite(pixels[5:]), 0.0)
    within("depth", absolute(depth, points[:, 2]), 0.0)


CAMERA = Intrinsics(64, 48, 60.0, 60.0, 32.0, 24.0)
UP = np.array([0.0, 0.0, 1.0])


def on_one_spot(count: int = 12) -> Array:
    """Cameras at one place that look round it."""
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    out = np.stack([np.cos(angle), np.sin(angle), 0.1 * np.sin(3 * angle)], axis=1)
    return look_at(np.full((count, 3), 0.3), 0.3 + out, UP)


def in_a_line(count: int = 12) -> Array:
    at = np.stack([np.linspace(-1, 1, count), np.zeros(count), np.zeros(count)], axis=1)
    return look_at(at, at + np.array([0, 1.0, 0]), UP)


def all_the_same(count: int = 12) -> Array:
    return np.repeat(look_at(np.array([[1.0, 2.0, 3.0]]), np.zeros(3), UP), count, axis=0)


def nearly_turning(count: int = 12) -> Array:
    poses = on_one_spot(count)
    poses[:, :3, 3] += np.random.default_rng(0).normal(size=(count, 3)) * 1e-7
    return poses


def straight_up(count: int = 12) -> Array:
    at = np.random.default_rng(1).normal(size=(count, 3))
    return look_at(at, at + UP, UP)


SETS = {
    "one spot": on_one_spot,
    "in a line": in_a_line,
    "all the same": all_the_same,
    "turning, moved by 1e-7": nearly_turning,
    "looking straight up": straight_up,
}


def capture_of(poses: Array) -> Capture:
    frames = [Frame(f"{i:03d}", Path("nowhere.png"), CAMERA, pose) for i, pose in enumerate(poses)]
    return Capture("transforms", Path("nowhere"), tuple(frames))


@pytest.mark.parametrize("name", SETS)
def test_awkward_sets(name: str, within: Within) -> None:
    """Paths, up direction, nearest picture of cameras that stand badly."""
    poses, test = SETS[name](), np.arange(12) % 4 == 0
    path = orbit(poses, poses[:, :3, 3].mean(axis=0) + poses[0, :3, 2], 24)
    rigid = absolute(path[:, :3, :3] @ np.swapaxes(path[:, :3, :3], 1, 2), np.tile(np.eye(3), (24, 1, 1)))
    within("orbit, not rigid", rigid, 1e-9)
    direction, reason = up_direction(poses, None)
    within("length of up", abs(float(np.linalg.norm(direction)) - 1) + float(not reason), 1e-9)
    views = Views([str(i) for i in range(12)], [np.zeros((48, 64, 3), np.uint8)] * 12, [CAMERA] * 12, poses, test)
    chosen = [nearest_training(views, int(index)) for index in np.flatnonzero(test)]
    within("test views chosen as nearest, or none", float(sum(i is None or bool(test[i]) for i in chosen)), 0.0)


def test_keyframes(within: Within) -> None:
    """Key frames and neighbours of such cameras."""
    for name, make in SETS.items():
        poses = make()
        chosen = select_keyframes(poses, [CAMERA] * len(poses), 2.0)
        wrong = float(len(chosen.indices) == 0) + float(((chosen.neighbours < 0) | (chosen.neighbours >= len(poses))).sum())
        wrong += float((chosen.neighbours == chosen.indices[:, None]).sum())
        within(f"{name}: wrong key frames or neighbours", wrong, 0.0)
    bad = sum(refused(partial(select_keyframes, in_a_line(), [CAMERA] * 12, depth), InputError) for depth in (0.0, -1.0, np.nan, np.inf))
    within("depths of 0, -1, NaN and infinity that are taken", bad, 0.0)


def test_given(within: Within) -> None:
    """Given poses on one spot are refused, 1e-7 of motion 6,000 km away too."""
    far = nearly_turning()
    far[:, :3, 3] += 6e6
    few = capture_of(in_a_line(1))
    within("identical centres taken", refused(lambda: given_poses(capture_of(on_one_spot())), PoseError, "one spot"), 0.0)
    within("identical cameras taken", refused(lambda: given_poses(capture_of(all_the_same())), PoseError, "one spot"), 0.0)
    within("motion below what float64 holds taken", refused(lambda: given_poses(capture_of(far)), PoseError, "one spot"), 0.0)
    within("one camera taken", refused(lambda: given_poses(few), PoseError), 0.0)
    within("cameras in a line refused", abs(given_poses(capture_of(in_a_line())).registered - 12.0), 0.0)


def test_intersections(within: Within) -> None:
    """Intersecting parallel, identical and opposite rays.

    Rays that do not meet at an angle give no point; those that do give the point.
    """
    straight = np.zeros((12, 2))
    for name, make in SETS.items():
        poses = make()
        points, _, _, depth = intersect(poses, np.arange(12), straight, np.zeros(12, np.int64), np.full(12, 1e-3))
        within(f"{name}: not finite", not_finite(points, depth), 0.0)
        within(f"{name}: points of rays that do not meet", float(len(points)), 0.0)
    at = np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0.3]])
    meeting = look_at(at, np.array([0.1, 0.2, 0.3]), UP)
    points, _, _, _ = intersect(meeting, np.arange(3), np.zeros((3, 2)), np.zeros(3, np.int64), np.full(3, 1e-3))
    within("rays that meet", absolute(points, np.array([[0.1, 0.2, 0.3]])), 1e-9)
    nothing = intersect(meeting, np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0, np.int64), np.zeros(0))
    within("points of no rays", float(sum(len(values) for values in nothing)), 0.0)


@QUICK
@given(st.floats(1, 170), st.integers(0, 100))
def test_pinhole_cameras(degrees: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    errors = projection_errors(of_fov(degrees), POSE, rng.uniform([0, 0], [64, 48], (50, 2)), 10 ** rng.uniform(-3, 3, 50))
    assert errors["values that are not finite"] == 0
    assert errors["pixels there and back, by the focal length"] < 1e-8 and errors["ray beside its point, relative"] < 3e-7


@QUICK
@given(st.lists(st.floats(-0.4, 0.4), min_size=4, max_size=4), st.sampled_from([OPENCV, FISHEYE]), st.floats(0, 6.28))
def test_lenses(coefficients: list[float], lens: str, angle: float) -> None:
    small = [coefficients[0], coefficients[1] * 0.3, *(value * 0.01 for value in coefficients[2:])]
    camera = Intrinsics(640, 480, 400.0, 400.0, 320.0, 240.0, lens, tuple(small))
    reach = 0.6 * lens_limit(camera, 0.8)
    radius = np.linspace(0, reach, 20)
    errors = lens_errors(camera, np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1))
    assert errors["values that are not finite"] == 0 and errors["bent"] < BENT and errors["bent and unbent"] < LENS


def test_zero_lens(within: Within) -> None:
    """No lens written as a lens with zeros."""
    points = np.random.default_rng(1).uniform(-2, 2, (200, 2))
    for length in (0, 4, 5, 8, 14):
        camera = Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0, OPENCV if length else PINHOLE, (0.0,) * length)
        within(f"{length} zeros", absolute(distort(camera, points), points), 0.0)
    tiny = Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0, OPENCV, (1e-300, 0.0, 0.0, 0.0))
    within("a coefficient of 1e-300", absolute(distort(tiny, points), points), 1e-12)
    within("no points", float(len(distort(STRONG["barrel"], np.zeros((0, 2)))) + len(undistorted(tiny, np.zeros((0, 2))))), 0.0)


def test_sizes(within: Within) -> None:
    """Undistorting at another size is one and the same map."""
    for name, camera in STRONG.items():
        target, map_x, map_y, seen = undistort_maps(camera, 160, 120)
        pixels = pixel_grid(160, 120)
        ideal = (pixels - [target.cx, target.cy]) / [target.fx, target.fy]
        written = np.array([reference.lens(camera.lens, camera.distortion, float(x), float(y)) for x, y in ideal])
        u, v = (written * [camera.fx, camera.fy] + [camera.cx, camera.cy] - 0.5).T
        got = np.stack([map_x.ravel(), map_y.ravel()], axis=1)[seen.ravel()]
        within(f"{name}: map, pixels", absolute(got, np.stack([u, v], axis=1)[seen.ravel()]), 1e-4)
        same, _, whole = resample_maps(camera.pinhole(), target)
        within(f"{name}: without its lens, whole", float((~whole).sum()) + not_finite(same), 0.0)


def test_not_rigid(within: Within) -> None:
    """Poses that are not rigid."""
    good = look_at(np.array([[1.0, 2, 3]]), np.zeros(3), UP)[0]
    bad = {"zeros": np.zeros((4, 4)), "mirrored": good @ np.diag([1.0, 1, -1, 1]), "NaN": good * np.nan, "3×3": np.eye(3), "words": [["a"]]}
    bad["infinite place"] = good + np.pad([[np.inf]], ((0, 3), (3, 0)))
    bad["sheared by 2%"] = good @ np.diag([1.0, 1.02, 1, 1])
    bad["scaled ×1e-200"] = good * 1e-200
    for name, pose in bad.items():
        within(f"taken: {name}", refused(partial(checked_pose, pose, "here"), InputError), 0.0)
    noisy = good.copy()
    noisy[:3, :3] += 1e-4 * np.random.default_rng(0).normal(size=(3, 3))
    fixed = checked_pose(noisy, "here")
    within("slightly off: made rigid", absolute(fixed[:3, :3] @ fixed[:3, :3].T, np.eye(3)), 1e-14)
    within(
        "cameras with a focal length of 0, NaN or -1 taken",
        sum(refused(partial(replace(CAMERA, fx=f).checked, "here"), InputError) for f in (0.0, np.nan, -1.0, np.inf)),
        0.0,
    )
