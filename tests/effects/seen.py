"""Shared points as a pinhole, a lens, rows one after the other and wrong poses make them see: made up, with noise, in no time."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.effects.adjust import Problem, predict
from fieldfuse.effects.tracks import Tracks

CAMERA = Intrinsics(320, 240, 260.0, 260.0, 160.0, 120.0)
FRAMES = 14


def made(
    seed: int = 0,
    lens: tuple[float, float] = (0.0, 0.0),
    rows: float = 0.0,
    pose_error: float = 0.0,
    noise: float = 0.1,
    points: int = 420,
    gain: Array | None = None,
    corner: float = 1.0,
) -> Tracks:
    """Cameras on a walk before a cloud of points, as a capture would give them: poses and lens as the capture believes they are.

    Args:
        rows: seconds of a step that reading takes; the hand turns some degrees a step.
        pose_error: radians, deviation of the given poses' turns.
        noise: pixels.
        gain: (FRAMES, 3). corner: of a vignetting.
    """
    rng = np.random.default_rng(seed)
    cloud = rng.uniform([-2.5, -1.6, 2.2], [2.5, 1.6, 6.0], (points, 3))
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, :3, 3] = np.stack([np.linspace(-0.6, 0.6, FRAMES), 0.1 * np.sin(np.arange(FRAMES)), 0.02 * np.arange(FRAMES)], axis=1)
    steps = np.concatenate([rng.normal(0, 0.05, (FRAMES, 3)), np.tile([0.09, 0.0, 0.0], (FRAMES, 1))], axis=1)
    poses[:, :3, :3] = Rotation.from_rotvec(np.cumsum(steps[:, :3], axis=0) * 0.3).as_matrix()
    frame, point = (index.ravel() for index in np.meshgrid(np.arange(FRAMES), np.arange(points)))
    focal = np.full(FRAMES, CAMERA.fx)
    problem = Problem(poses, cloud, frame, point, np.zeros((len(frame), 2)), focal, np.zeros(len(frame)), rows * steps, lens)
    for _ in range(3):  # the row decides when a point is seen, and that decides the row
        camera, place = predict(problem)
        pixel = place * CAMERA.fx + [CAMERA.cx, CAMERA.cy]
        problem.row[:] = np.clip(pixel[:, 1] / CAMERA.height - 0.5, -0.5, 0.5)
    pixel = pixel + rng.normal(0, noise, pixel.shape)
    inside = (camera[:, 2] > 0.1) & (pixel > 1).all(1) & (pixel < [CAMERA.width - 1, CAMERA.height - 1]).all(1)
    shown = inside & (rng.uniform(0, 1, len(frame)) < 0.7)
    shown &= np.bincount(point[shown], minlength=points)[point] >= 3
    frame, pixel = frame[shown], pixel[shown]
    number = np.unique(point[shown], return_inverse=True)[1]
    own = rng.uniform(0.05, 0.4, (points, 3))[point[shown]] * np.exp2(rng.normal(0, 0.02, (len(frame), 3)))
    radius = np.linalg.norm(pixel - [CAMERA.cx, CAMERA.cy], axis=1) / (0.5 * np.hypot(CAMERA.width, CAMERA.height))
    own *= ((1 + (corner**-0.5 - 1) * radius**2) ** -2)[:, None]
    given = poses.copy()
    if pose_error:
        given[:, :3, :3] = given[:, :3, :3] @ Rotation.from_rotvec(rng.normal(0, pose_error, (FRAMES, 3))).as_matrix()
    return Tracks(
        names=[f"{index:03d}" for index in range(FRAMES)],
        cameras=[CAMERA] * FRAMES,
        poses=given,
        times=np.arange(FRAMES, dtype=np.float64),
        scale=np.ones(FRAMES),
        frame=frame,
        point=number,
        pixel=pixel,
        linear=own if gain is None else own * gain[frame],
        slope=0.02 * np.exp2(rng.normal(0, 0.1, len(frame))),
    )
