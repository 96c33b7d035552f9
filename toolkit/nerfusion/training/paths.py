"""Camera paths through procedural scenes: a hand that walks and looks about, and cameras around what there is to look at."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fieldfuse.camera import Array

Clearance = Callable[[Array], Array]  # (N, 3) points → (N,) distance to the nearest surface
ROOM_FOR_A_CAMERA = 0.12  # of the distance to the focus: cameras keep this far from surfaces
TRIES = 24


def look_at(centres: Array, targets: Array, roll: Array) -> Array:
    """(N, 3) places, (N, 3) what each looks at, (N,) radians of roll → (N, 4, 4) world_from_camera, z up."""
    forward = targets - centres
    forward = forward / np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    flat = np.linalg.norm(right, axis=1, keepdims=True)
    right = np.where(flat > 1e-6, right / np.maximum(flat, 1e-12), [1.0, 0.0, 0.0])
    down = np.cross(forward, right)
    c, s = np.cos(roll)[:, None], np.sin(roll)[:, None]
    poses = np.tile(np.eye(4), (len(centres), 1, 1))
    poses[:, :3, :] = np.stack([c * right + s * down, c * down - s * right, forward, centres], axis=-1)
    return poses


def wander(rng: np.random.Generator, count: int, size: float, fastest: int = 5) -> Array:
    """(count, 3) a smooth random walk about zero, of deviation `size`."""
    s = np.linspace(0, 1, count)
    waves = np.arange(1, fastest)
    phase = rng.uniform(0, 2 * np.pi, (len(waves), 3))
    weight = rng.normal(0, 1, (len(waves), 3)) / waves[:, None]
    out = (np.sin(np.pi * waves[:, None, None] * s[:, None] + phase[:, None]) * weight[:, None]).sum(0)
    return np.asarray(size * out / np.sqrt((1 / waves**2).sum() / 2))


def hand_held(rng: np.random.Generator, count: int, free: Array, focus: Array, clearance: Clearance) -> Array | None:
    """(count, 4, 4) a walk through the free space (2, 3), looking ahead, aside or at the focus; None when no clear walk was found."""
    for _ in range(TRIES):
        start = rng.uniform(free[0], free[1])
        place = focus + rng.normal(0, 0.6, 3) if rng.random() < 0.6 else rng.uniform(free[0], free[1]) + rng.normal(0, 1.0, 3)
        away = float(np.linalg.norm(place - start))
        if away < 0.5:
            continue
        # Most walks go to the side of what is looked at, as people film; the others anywhere.
        heading = np.cross(place - start, [0, 0, 1.0]) if rng.random() < 0.7 else rng.normal(0, 1, 3) * [1, 1, 0.3]
        heading = heading / max(float(np.linalg.norm(heading)), 1e-9)
        length = away * np.exp(rng.uniform(np.log(0.5), np.log(1.8)))
        s = np.linspace(-0.5, 0.5, count)[:, None]
        centres = start + s * length * heading + wander(rng, count, 0.05 * length)
        targets = place + s * rng.uniform(-0.3, 0.8) * length * heading + wander(rng, count, 0.05 * away)
        if clearance(centres).min() > ROOM_FOR_A_CAMERA * min(away, 1.5):
            return look_at(centres, targets, rng.normal(0, 0.04) + wander(rng, count, 0.03)[:, 0])
    return None


def around(rng: np.random.Generator, count: int, free: Array, focus: Array, clearance: Clearance) -> Array | None:
    """(count, 4, 4) cameras around the focus on part of a dome, in order of the azimuth; None when they do not fit."""
    widest = float(np.max(np.linalg.norm((free - focus)[:, :2], axis=1)))
    for _ in range(TRIES):
        radius = widest * np.exp(rng.uniform(np.log(0.2), np.log(0.85)))
        arc = np.exp(rng.uniform(np.log(0.5), np.log(2 * np.pi)))
        azimuth = rng.uniform(0, 2 * np.pi) + np.sort(rng.uniform(0, arc, 3 * count))
        lift = np.clip(rng.normal(rng.uniform(0.15, 0.9), rng.uniform(0.03, 0.25), 3 * count), 0.03, 1.4)
        reach = radius * rng.uniform(0.9, 1.1, 3 * count)
        flat = reach * np.cos(lift)
        centres = focus + np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), reach * np.sin(lift)], axis=1)
        clear = np.flatnonzero(clearance(centres) > ROOM_FOR_A_CAMERA * radius)
        if len(clear) < count:
            continue
        chosen = np.sort(rng.permutation(clear)[:count])
        targets = focus + rng.normal(0, 0.08 * radius, (count, 3))
        return look_at(centres[chosen], targets, rng.normal(0, 0.05, count))
    return None
