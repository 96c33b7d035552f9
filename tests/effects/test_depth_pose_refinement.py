"""Refined poses held to a sensor's depth, on walls whose depth is known: better where it agrees, left alone where it does not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fieldfuse.camera import Array, invert, pixel_grid
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.effects.adjust import POSES, Belief, Problem, _slopes, _with, adjust, depth_residuals, predict, residuals, scatter
from fieldfuse.effects.depth_pose_refinement import MARGIN, refine_by_depth, scaled
from fieldfuse.effects.effect_specs import preset
from fieldfuse.effects.refine import believed
from tests.effects.test_depth_camera import CAMERA, walls

FRAMES, POINTS = 12, 160
UNKNOWN = frozenset({POSES})
OFFSET = preset("depth_offset", "medium").forward()


def walk(seed: int) -> tuple[Array, Problem]:
    """True poses of a short walk before three walls, and what is seen from them with poses that drift; half a pixel of noise."""
    rng = np.random.default_rng(seed)
    true = np.tile(np.eye(4), (FRAMES, 1, 1))
    true[:, :3, 3] = np.stack([np.linspace(-0.15, 0.15, FRAMES), 0.05 * np.sin(np.arange(FRAMES)), np.linspace(0, 0.05, FRAMES)], axis=1)
    true[:, :3, :3] = Rotation.from_rotvec(rng.normal(0, 0.05, (FRAMES, 3))).as_matrix()
    first = invert(true[FRAMES // 2])
    at = rng.uniform(4, [CAMERA.width - 4, CAMERA.height - 4], (POINTS, 2))
    rays = np.concatenate([(at - [CAMERA.cx, CAMERA.cy]) / [CAMERA.fx, CAMERA.fy], np.ones((POINTS, 1))], axis=1)
    cloud = (rays * walls(at, first)[:, None]) @ true[FRAMES // 2, :3, :3].T + true[FRAMES // 2, :3, 3]
    point, frame = (index.ravel() for index in np.meshgrid(np.arange(POINTS), np.arange(FRAMES), indexing="ij"))
    still, focal = np.zeros((FRAMES, 6)), np.full(FRAMES, CAMERA.fx)
    exact = Problem(true, cloud, frame, point, np.zeros((len(frame), 2)), focal, np.zeros(len(frame)), still)
    places = predict(exact)[1] + rng.normal(0, 0.5 / CAMERA.fx, (len(frame), 2))
    t = np.linspace(0, 1, FRAMES)[:, None]
    drift = np.sin(np.pi * t * rng.uniform(1, 3, 6) + rng.uniform(0, 6, 6)) * ([0.006] * 3 + [0.03] * 3)
    given = true.copy()
    given[:, :3, :3] = true[:, :3, :3] @ Rotation.from_rotvec(drift[:, :3]).as_matrix()
    given[:, :3, 3] += drift[:, 3:]
    return true, replace(exact, poses=given, place=places)


def refined(problem: Problem) -> tuple[Problem, Belief]:
    belief = believed(problem, adjust(problem).scatter, adjust(problem, UNKNOWN, 30).scatter)
    return adjust(problem, UNKNOWN, 60, belief).problem, belief


def filmed(folder: Path, true: Array, noise: float = 0.004, unit: float = 1.0, offset: Array | None = None, mixed: bool = False) -> Capture:
    """A capture whose depth maps are of a camera that stands at `offset` from the pictures'."""
    rng = np.random.default_rng(5)
    frames = []
    for number in rng.permutation(FRAMES) if mixed else range(FRAMES):
        depth = walls(pixel_grid(CAMERA.width, CAMERA.height), (np.eye(4) if offset is None else offset) @ invert(true[number]))
        depth = depth.reshape(CAMERA.height, CAMERA.width)
        path = folder / f"{number:02d}.npy"
        np.save(path, (unit * depth * (1 + rng.normal(0, noise, depth.shape))).astype(np.float32))
        frames.append(Frame(path.stem, path.with_suffix(".png"), CAMERA, true[number], depth=path))
    return Capture("scannet", folder, tuple(frames), depth_scale=1.0)


def apart(poses: Array, true: Array) -> float:
    """Root mean square distance of cameras from where they are, once all were turned and moved as one."""
    one, other = (each[:, :3, 3] - each[:, :3, 3].mean(axis=0) for each in (poses, true))
    u, _, vt = np.linalg.svd(one.T @ other)
    turn = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    return float(np.sqrt(((one @ turn - other) ** 2).sum(axis=1).mean()))


@pytest.mark.parametrize("offset", [None, OFFSET], ids=["registered", "beside"])
def test_depth_makes_refined_poses_better(tmp_path: Path, offset: Array | None) -> None:
    true, given = walk(1)
    alone, belief = refined(given)
    found = refine_by_depth(filmed(tmp_path, true, offset=offset), alone, UNKNOWN, belief)
    assert found is not None
    assert found.after < (1 - MARGIN) * found.before
    assert "held to the sensor's depth" in found.note
    assert apart(found.problem.poses, true) < 0.5 * apart(alone.poses, true)
    assert scatter(residuals(found.problem)) < 1.1 * scatter(residuals(alone))
    assert found.problem.depth is None


@pytest.mark.parametrize("wrong", [{"unit": 1.3}, {"noise": 0.3}, {"mixed": True}], ids=["another unit", "noise", "other frames'"])
def test_depth_that_does_not_agree_takes_no_part(tmp_path: Path, wrong: dict[str, float]) -> None:
    true, given = walk(1)
    alone, belief = refined(given)
    capture = filmed(tmp_path, true, **wrong)
    if "mixed" in wrong:
        capture = capture.with_frames([replace(frame, name=f"{number:02d}") for number, frame in enumerate(capture.frames)])
    assert refine_by_depth(capture, alone, UNKNOWN, belief) is None


def test_frames_without_depth_need_none(tmp_path: Path) -> None:
    true, given = walk(1)
    alone, belief = refined(given)
    capture = filmed(tmp_path, true)
    some = capture.with_frames([replace(frame, depth=frame.depth if k % 2 else None) for k, frame in enumerate(capture.frames)])
    found = refine_by_depth(some, alone, UNKNOWN, belief)
    assert found is not None
    assert apart(found.problem.poses, true) < 0.7 * apart(alone.poses, true)
    none = capture.with_frames([replace(frame, depth=None) for frame in capture.frames])
    assert refine_by_depth(none, alone, UNKNOWN, belief) is None


def test_growing_changes_no_place_and_no_belief() -> None:
    _, given = walk(3)
    belief = Belief(given.poses, np.ones(6))
    larger, held = scaled(given, belief, 1.04)
    np.testing.assert_allclose(predict(larger)[1], predict(given)[1], atol=1e-12)
    np.testing.assert_allclose(predict(larger)[0], 1.04 * predict(given)[0], atol=1e-9)
    np.testing.assert_allclose(held.off(larger.poses), 0, atol=1e-12)


def test_slopes_of_depth_are_those_of_differences() -> None:
    given = walk(4)[1]
    told = replace(given, depth=np.where(np.arange(len(given.frame)) % 5, predict(given)[0][:, 2] * 1.01, np.nan), depth_weight=50.0)
    by_point, by_camera, _, count = _slopes(told, UNKNOWN)
    assert by_point.shape == (len(given.frame), 3, 3) and count == 6 * FRAMES
    step, off = 1e-6, depth_residuals(told)
    assert (off[::5] == 0).all() and (off[1::5] != 0).all()
    for axis in range(3):
        moved = depth_residuals(replace(told, points=told.points + step * np.eye(3)[axis]))
        np.testing.assert_allclose((moved - off) / step, by_point[:, 2, axis], atol=1e-4)
    for number in range(6):
        moved = depth_residuals(_with(told, step * (np.arange(count) % 6 == number), UNKNOWN))
        np.testing.assert_allclose((moved - off) / step, by_camera[:, 2, number], atol=1e-4)
