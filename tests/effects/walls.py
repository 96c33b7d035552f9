"""Pictures of a textured wall, made up: for what is told by patches of pictures."""

from __future__ import annotations

import cv2
import numpy as np

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.effects.adjust import Problem
from fieldfuse.effects.tracks import Tracks

WIDTH, HEIGHT, FOCAL, FRAMES, AWAY = 200, 150, 170.0, 9, 4.0
CAMERA = Intrinsics(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)


def stored(linear: Array) -> Array:
    return np.asarray((255 * np.clip(linear, 0, 1) ** (1 / 2.2) + 0.5).astype(np.uint8))


def wall(
    lamp: float = 0.0, gain: Array | None = None, corner: float = 1.0, top: float = -9.0, away: float = AWAY, seed: int = 0
) -> Tracks:
    """Cameras that pass a wall, which is all that is known of points. A lamp's image stands still in the picture, so wanders over the wall.

    Args:
        lamp: linear light that it adds. gain: (FRAMES,) of exposure. corner: of a vignetting. top: y/z above which the picture shows what
            stands behind, at the depth `away`.
    """
    rng = np.random.default_rng(seed)
    texture = 0.05 + 0.4 * cv2.GaussianBlur(rng.uniform(0, 1, (600, 800)).astype(np.float32), (0, 0), 2.5)
    texture = 0.05 + 0.3 * (texture - texture.min()) / (texture.max() - texture.min())
    x, y = np.meshgrid((np.arange(WIDTH) + 0.5 - CAMERA.cx) / FOCAL, (np.arange(HEIGHT) + 0.5 - CAMERA.cy) / FOCAL)
    spot = lamp * np.exp(-((x - 0.15) ** 2 + (y + 0.1) ** 2) / (2 * 0.07**2))
    radius = np.hypot(x, y) * FOCAL / (0.5 * np.hypot(WIDTH, HEIGHT))
    poses, pictures = np.tile(np.eye(4), (FRAMES, 1, 1)), []
    poses[:, 0, 3], poses[:, 1, 3] = np.linspace(-1, 1, FRAMES), 0.2 * np.sin(np.arange(FRAMES))
    for number, pose in enumerate(poses):
        behind = y + pose[1, 3] / AWAY < top
        depth = np.where(behind, away, AWAY)
        u, v = (120 * AWAY * (flat + pose[axis, 3] / depth) for axis, flat in enumerate((x, y)))
        seen = cv2.remap(texture, (u + 400).astype(np.float32), (v + 300).astype(np.float32), cv2.INTER_LINEAR) + spot
        seen = seen * (1 + (corner**-0.5 - 1) * radius**2) ** -2 * (1 if gain is None else gain[number])
        pictures.append(stored(seen))
    cloud = np.concatenate([rng.uniform([-2.6, max(-1.8, top * AWAY)], [2.6, 1.8], (260, 2)), np.full((260, 1), AWAY)], axis=1)
    frame, point = (index.ravel() for index in np.meshgrid(np.arange(FRAMES), np.arange(len(cloud))))
    camera = cloud[point] - poses[frame, :3, 3]
    pixel = camera[:, :2] / camera[:, 2:] * FOCAL + [CAMERA.cx, CAMERA.cy]
    shown = (pixel > 2).all(1) & (pixel < [WIDTH - 2, HEIGHT - 2]).all(1)
    shown &= np.bincount(point[shown], minlength=len(cloud))[point] >= 3
    point, frame, pixel = np.unique(point[shown], return_inverse=True)[1], frame[shown], pixel[shown]
    some = np.zeros((len(frame), 3))
    times, ones = np.arange(FRAMES, dtype=np.float64), np.ones(FRAMES)
    names = [str(number) for number in range(FRAMES)]
    return Tracks(names, [CAMERA] * FRAMES, poses, times, ones, frame, point, pixel, some, some[:, 0], tuple(pictures))


def problem_of(seen: Tracks) -> Problem:
    """Right poses, no lens; patches ask for no more."""
    nothing = np.zeros((0, 2))
    return Problem(seen.poses, np.zeros((0, 3)), seen.frame, seen.point, nothing, seen.focal, seen.row(), np.zeros((FRAMES, 6)))
