"""Highlights looked for between points, on pictures of a textured wall that are made up: found where light wanders over it, and only then."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from toolkit.camera import Array, Intrinsics
from toolkit.effects.adjust import Problem
from toolkit.effects.light import EXPOSURE, VIGNETTING, Light
from toolkit.effects.sheen import THRESHOLD, Shiny, shiny
from toolkit.effects.sightings import Sightings

WIDTH, HEIGHT, FOCAL, FRAMES, AWAY = 200, 150, 170.0, 9, 4.0
CAMERA = Intrinsics(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
PLAIN = Light({}, frozenset(), {}, {}, np.ones((FRAMES, 3)), 1.0)


def stored(linear: Array) -> Array:
    return np.asarray((255 * np.clip(linear, 0, 1) ** (1 / 2.2) + 0.5).astype(np.uint8))


def wall(lamp: float = 0.0, gain: Array | None = None, corner: float = 1.0, seed: int = 0) -> Sightings:
    """Cameras that pass a wall. A lamp's image stands still in the picture and so wanders over the wall.

    Args:
        lamp: linear light that it adds. gain: (FRAMES,) of exposure. corner: of a vignetting.
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
        u, v = 400 + 120 * (AWAY * x + pose[0, 3]), 300 + 120 * (AWAY * y + pose[1, 3])
        seen = cv2.remap(texture, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR) + spot
        seen = seen * (1 + (corner**-0.5 - 1) * radius**2) ** -2 * (1 if gain is None else gain[number])
        pictures.append(stored(seen))
    cloud = np.concatenate([rng.uniform([-2.6, -1.8], [2.6, 1.8], (260, 2)), np.full((260, 1), AWAY)], axis=1)
    frame, point = (index.ravel() for index in np.meshgrid(np.arange(FRAMES), np.arange(len(cloud))))
    camera = cloud[point] - poses[frame, :3, 3]
    pixel = camera[:, :2] / camera[:, 2:] * FOCAL + [CAMERA.cx, CAMERA.cy]
    shown = (pixel > 2).all(1) & (pixel < [WIDTH - 2, HEIGHT - 2]).all(1)
    shown &= np.bincount(point[shown], minlength=len(cloud))[point] >= 3
    point, frame, pixel = np.unique(point[shown], return_inverse=True)[1], frame[shown], pixel[shown]
    some = np.zeros((len(frame), 3))
    times, ones = np.arange(FRAMES, dtype=np.float64), np.ones(FRAMES)
    names = [str(number) for number in range(FRAMES)]
    return Sightings(names, [CAMERA] * FRAMES, poses, times, ones, frame, point, pixel, some, some, ones[:1], ones, tuple(pictures))


def looked(seen: Sightings, found: Light = PLAIN, wrong: float = 0.0) -> Shiny:
    flat = np.zeros((0, 2))
    problem = Problem(seen.poses, np.zeros((0, 3)), seen.frame, seen.point, flat, seen.focal, seen.row(), np.zeros((FRAMES, 6)))
    depth = np.full(len(seen.frame), AWAY)
    depth[: int(wrong * len(depth))] *= 0.5
    return shiny(seen, problem, np.random.default_rng(1).permutation(depth), found)


@pytest.mark.parametrize("seed", [0, 1])
def test_a_wall_without_lamps_is_dull(seed: int) -> None:
    drift = np.exp2(0.5 * np.sin(np.arange(FRAMES)))
    uneven = replace(PLAIN, kept=frozenset({EXPOSURE}))
    dim = replace(PLAIN, kept=frozenset({VIGNETTING}), corner=0.5)
    for found in (looked(wall(seed=seed)), looked(wall(gain=drift, seed=seed), uneven), looked(wall(corner=0.5, seed=seed), dim)):
        assert not found.found and found.evidence.number < 0.5 * THRESHOLD, found.evidence.reason


@pytest.mark.parametrize("seed", [0, 1])
def test_light_that_wanders_over_a_wall_is_found_and_held_out_pictures_agree(seed: int) -> None:
    found = looked(wall(lamp=0.08, seed=seed))
    assert found.found and found.evidence.number > 4 * THRESHOLD, found.evidence.reason
    assert found.before is not None and found.after is not None and found.after < 0.5 * found.before
    drift = np.exp2(0.3 * np.sin(np.arange(FRAMES)))
    assert looked(wall(lamp=0.08, gain=drift, seed=seed), replace(PLAIN, kept=frozenset({EXPOSURE}))).found


def test_wrong_depths_are_no_highlights_and_nothing_is_told_of_too_little() -> None:
    assert not looked(wall(), wrong=0.3).found
    found = looked(replace(wall(lamp=0.08), poses=np.tile(np.eye(4), (FRAMES, 1, 1))))  # all from one place
    assert not found.found and found.evidence.number == 0 and found.before is None
