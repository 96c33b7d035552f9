"""Cameras that stand badly: all on one spot, in a line, hardly moving, looking straight up. A sentence or finite numbers, never NaN."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.capture.poses import checked_pose
from fieldfuse.capture.types import Capture, Frame, Views
from fieldfuse.errors import InputError, PoseError
from fieldfuse.evaluation.baseline import nearest_training
from fieldfuse.evaluation.selftest.case import Measure, absolute, case, not_finite, refused
from fieldfuse.nerfusion.keyframes import select_keyframes
from fieldfuse.poses.given import given_poses
from fieldfuse.poses.gravity import up_direction
from fieldfuse.poses.points import intersect
from fieldfuse.render.paths import focus, interpolate, look_at, orbit

GROUP = "cameras"
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


@case(GROUP, "camera paths of identical, collinear, turning and upward cameras")
def paths(folder: Path) -> list[Measure]:
    out = []
    for name, make in SETS.items():
        poses = make()
        for what, path in (("orbit", orbit(poses, None, 24)), ("interpolation", interpolate(poses, 24))):
            rigid = absolute(path[:, :3, :3] @ np.swapaxes(path[:, :3, :3], 1, 2), np.tile(np.eye(3), (24, 1, 1)))
            out.append(Measure(f"{name}: {what}, not rigid", rigid, 1e-9))
        out.append(Measure(f"{name}: point looked at, not finite", not_finite(focus(poses)), 0.0))
    return out


@case(GROUP, "key frames and neighbours of such cameras")
def keyframes(folder: Path) -> list[Measure]:
    out = []
    for name, make in SETS.items():
        poses = make()
        chosen = select_keyframes(poses, [CAMERA] * len(poses), 2.0)
        wrong = float(len(chosen.indices) == 0) + float(((chosen.neighbours < 0) | (chosen.neighbours >= len(poses))).sum())
        wrong += float((chosen.neighbours == chosen.indices[:, None]).sum())
        out.append(Measure(f"{name}: wrong key frames or neighbours", wrong, 0.0))
    bad = sum(refused(partial(select_keyframes, in_a_line(), [CAMERA] * 12, depth), InputError) for depth in (0.0, -1.0, np.nan, np.inf))
    out.append(Measure("depths of 0, -1, NaN and infinity that are taken", bad, 0.0))
    return out


@case(GROUP, "given poses on one spot are refused, 1e-7 of motion 6,000 km away too")
def given(folder: Path) -> list[Measure]:
    far = nearly_turning()
    far[:, :3, 3] += 6e6
    few = capture_of(in_a_line(1))
    return [
        Measure("identical centres taken", refused(lambda: given_poses(capture_of(on_one_spot())), PoseError, "one spot"), 0.0),
        Measure("identical cameras taken", refused(lambda: given_poses(capture_of(all_the_same())), PoseError, "one spot"), 0.0),
        Measure("motion below what float64 holds taken", refused(lambda: given_poses(capture_of(far)), PoseError, "one spot"), 0.0),
        Measure("one camera taken", refused(lambda: given_poses(few), PoseError), 0.0),
        Measure("cameras in a line refused", abs(given_poses(capture_of(in_a_line())).registered - 12.0), 0.0),
    ]


@case(GROUP, "up of cameras that look straight up, or all the same way")
def up(folder: Path) -> list[Measure]:
    out = []
    for name, make in SETS.items():
        direction, reason = up_direction(make(), None)
        out.append(Measure(f"{name}: length of up", abs(float(np.linalg.norm(direction)) - 1), 1e-9))
        out.append(Measure(f"{name}: no reason told", float(not reason), 0.0))
    return out


@case(GROUP, "intersecting parallel, identical and opposite rays")
def intersections(folder: Path) -> list[Measure]:
    """Rays that do not meet at an angle give no point; those that do give the point."""
    out = []
    straight = np.zeros((12, 2))
    for name, make in SETS.items():
        poses = make()
        points, _, _, depth = intersect(poses, np.arange(12), straight, np.zeros(12, np.int64), np.full(12, 1e-3))
        out.append(Measure(f"{name}: not finite", not_finite(points, depth), 0.0))
        out.append(Measure(f"{name}: points of rays that do not meet", float(len(points)), 0.0))
    at = np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0.3]])
    meeting = look_at(at, np.array([0.1, 0.2, 0.3]), UP)
    points, _, _, _ = intersect(meeting, np.arange(3), np.zeros((3, 2)), np.zeros(3, np.int64), np.full(3, 1e-3))
    out.append(Measure("rays that meet", absolute(points, np.array([[0.1, 0.2, 0.3]])), 1e-9))
    nothing = intersect(meeting, np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0, np.int64), np.zeros(0))
    out.append(Measure("points of no rays", float(sum(len(values) for values in nothing)), 0.0))
    return out


@case(GROUP, "the nearest picture among identical cameras")
def nearest(folder: Path) -> list[Measure]:
    picture = np.zeros((48, 64, 3), np.uint8)
    test = np.arange(12) % 4 == 0
    out = []
    for name, make in SETS.items():
        views = Views([str(i) for i in range(12)], [picture] * 12, [CAMERA] * 12, make(), test)
        chosen = [nearest_training(views, int(index)) for index in np.flatnonzero(test)]
        out.append(Measure(f"{name}: test views chosen or none", float(sum(i is None or bool(test[i]) for i in chosen)), 0.0))
    return out


@case(GROUP, "poses that are not rigid")
def not_rigid(folder: Path) -> list[Measure]:
    good = look_at(np.array([[1.0, 2, 3]]), np.zeros(3), UP)[0]
    bad = {"zeros": np.zeros((4, 4)), "mirrored": good @ np.diag([1.0, 1, -1, 1]), "NaN": good * np.nan, "3×3": np.eye(3), "words": [["a"]]}
    bad["infinite place"] = good + np.pad([[np.inf]], ((0, 3), (3, 0)))
    bad["sheared by 2%"] = good @ np.diag([1.0, 1.02, 1, 1])
    bad["scaled ×1e-200"] = good * 1e-200
    out = [Measure(f"taken: {name}", refused(partial(checked_pose, pose, "here"), InputError), 0.0) for name, pose in bad.items()]
    noisy = good.copy()
    noisy[:3, :3] += 1e-4 * np.random.default_rng(0).normal(size=(3, 3))
    fixed = checked_pose(noisy, "here")
    out.append(Measure("slightly off: made rigid", absolute(fixed[:3, :3] @ fixed[:3, :3].T, np.eye(3)), 1e-14))
    out.append(
        Measure(
            "cameras with a focal length of 0, NaN or -1 taken",
            sum(refused(partial(replace(CAMERA, fx=f).checked, "here"), InputError) for f in (0.0, np.nan, -1.0, np.inf)),
            0.0,
        )
    )
    return out
