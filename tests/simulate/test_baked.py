"""Pictures and depth of a scene: colours land where they belong, light is shaded, edges are smooth."""

from __future__ import annotations

import numpy as np

from fieldfuse.camera import Array, Intrinsics, project, unproject
from fieldfuse.simulate.baked import BakedScene, Light, _ball, _sphere
from fieldfuse.simulate.trace import Rectangle, Sphere

CAMERA = Intrinsics(80, 60, 70.0, 70.0, 40.0, 30.0)
FRONT = np.array([[1, 0, 0, 0], [0, 0, 1, -3], [0, -1, 0, 0.5], [0, 0, 0, 1]], dtype=float)  # at y = −3, looking along y; z is up
WALL = Rectangle(np.array([-2.0, 0, 2.0]), np.array([4.0, 0, 0]), np.array([0, 0, -3.0]))
EVEN = Light(lamp=(0.0, -6.0, 0.5), radius=0.01, lamp_strength=0.0, sky_strength=1.0)


def quadrants() -> Array:
    image = np.zeros((64, 64, 3), dtype=np.float32)
    image[:32, :32], image[:32, 32:], image[32:, :32], image[32:, 32:] = (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1)
    return image


def test_textures_are_upright_and_not_mirrored() -> None:
    """A wall seen from its front shows its texture as one looks at a picture: the first row up, the first column left."""
    scene = BakedScene([WALL], [], [quadrants()], [], EVEN)
    picture = scene.picture(CAMERA, FRONT)
    middle, _ = project(CAMERA, FRONT, np.array([[0.0, 0.0, 0.5]]))
    u, v = middle[0].astype(int)
    assert picture[v - 10, u - 10].argmax() == 0
    assert picture[v - 10, u + 10].argmax() == 1
    assert picture[v + 10, u - 10].argmax() == 2
    assert picture[v + 10, u + 10].min() > 200


def test_depth_lies_on_the_shapes_and_nothing_is_zero() -> None:
    ball = Sphere(np.array([0.3, -1.0, 0.6]), 0.5)
    wall = Rectangle(np.array([-1.0, 0, 1.4]), np.array([2.0, 0, 0]), np.array([0, 0, -2.0]))
    scene = BakedScene([wall], [ball], [quadrants(), quadrants()], [0.0], EVEN)
    depth = scene.depth(CAMERA, FRONT)
    v, u = np.nonzero(depth)
    points = unproject(CAMERA, FRONT, np.stack([u + 0.5, v + 0.5], axis=1), depth[v, u])
    on_wall = np.abs(points[:, 1]) < 1e-4
    on_ball = np.abs(np.linalg.norm(points - ball.centre, axis=1) - ball.radius) < 1e-4
    assert (on_wall | on_ball).all() and on_wall.sum() > 200 and on_ball.sum() > 200
    assert (depth == 0).any()
    assert (scene.picture(CAMERA, FRONT, samples=1)[depth == 0] == 0).all()


def test_a_ball_throws_a_shadow() -> None:
    """Behind the ball, as seen from the side, the wall is darker than without it; away from it nothing changes."""
    lamp = Light(lamp=(0.0, -4.0, 0.5), radius=0.05, lamp_strength=0.6, sky_strength=0.1)
    white = np.ones((600, 600, 3), dtype=np.float32)
    ball = Sphere(np.array([0.0, -1.0, 0.5]), 0.3)
    aside = FRONT.copy()
    turn = np.array([[np.cos(0.6), -np.sin(0.6), 0], [np.sin(0.6), np.cos(0.6), 0], [0, 0, 1]])
    aside[:3, :3] = turn @ FRONT[:3, :3]
    aside[0, 3] = 2.0
    alone = BakedScene([WALL], [], [white], [], lamp).picture(CAMERA, aside).astype(float)
    beside = BakedScene([WALL], [ball], [white, white], [0.0], lamp).picture(CAMERA, aside).astype(float)
    (behind, far), _ = project(CAMERA, aside, np.array([[0.0, 0.0, 0.5], [-0.2, 0.0, -0.6]]))
    shadow, lit = (beside[int(v), int(u)].mean() / alone[int(v), int(u)].mean() for u, v in (behind, far))
    assert shadow < 0.65
    assert 0.95 < lit < 1.01


def test_gloss_moves_with_the_view() -> None:
    grey = np.full((64, 128, 3), 0.3, dtype=np.float32)
    lamp = Light(lamp=(0.0, -4.0, 3.0), lamp_strength=0.5, sky_strength=0.4)
    ball = Sphere(np.array([0.0, 0.0, 0.5]), 0.6)
    point = np.array([[0.0, -0.6 * np.cos(0.3), 0.5 + 0.6 * np.sin(0.3)]])

    def seen(gloss: float, right: float) -> float:
        pose = FRONT.copy()
        pose[0, 3] = right
        (u, v), _ = project(CAMERA, pose, point)[0][0], None
        return float(BakedScene([], [ball], [grey], [gloss], lamp).picture(CAMERA, pose, samples=3)[int(v), int(u)].mean())

    assert abs(seen(0.0, 0.0) - seen(0.0, 1.0)) < 4
    assert seen(0.4, 0.0) - seen(0.4, 1.0) > 15


def test_supersampling_smooths_edges() -> None:
    scene = BakedScene([WALL], [], [np.ones((64, 64, 3), dtype=np.float32)], [], EVEN)
    tilted = FRONT.copy()
    tilt = np.array([[np.cos(0.2), -np.sin(0.2), 0], [np.sin(0.2), np.cos(0.2), 0], [0, 0, 1]])
    tilted[:3, :3] = FRONT[:3, :3] @ tilt
    tilted[1, 3] = -7
    full = int(np.median(scene.picture(CAMERA, tilted)[25:35, 35:45]))
    levels = [len(np.unique(scene.picture(CAMERA, tilted, samples=s)[..., 0] // 16)) for s in (1, 3)]
    assert full > 150
    assert levels[1] > levels[0]


def test_directions_and_ball_points_are_spread() -> None:
    rng = np.random.default_rng(0)
    assert np.abs(_sphere(rng, 200).mean(0)).max() < 0.02
    radii = np.linalg.norm(_ball(rng, 400), axis=1)
    assert radii.max() <= 1 and abs((radii < 0.5 ** (1 / 3)).mean() - 0.5) < 0.02
