"""People who pass before the camera.

    at(t) = a + v · (t − t₀) + (0, 0, |sin(2π · 0.9 · (t − t₀))| · 2 cm),    |v| · visible time = width of the picture there

Each crosses the optical axis of the camera's pose at his moment t₀, at right angles to it (give or take 25°), at a distance d between
`near` and `far` of the way to what is looked at. There are as many of them, spread over the capture, as make the sum of the times for which
they are in the picture the share of it that is asked for. They are real surfaces: they hide and are hidden, and a depth camera measures
them; they cast no shadow. What is exactly true about a frame (depth, normals) is true of the scene without them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fieldfuse.camera import Array

TURN = 25.0  # degrees by which ways deviate from the right angle
HEIGHTS = (1.55, 1.9)  # metres
EYES = 1.55  # metres: how high above the floor a camera is taken to be held where the floor is not known
STEPS, BOB = 0.9, 0.02  # a second; metres
NEAREST = 0.5  # metres
GOLDEN = 0.6180339887  # multiples of it are spread evenly over a circle, however many there are


@dataclass(frozen=True)
class Passers:
    """Parameters of the effect."""

    share: float = 0.4  # of the capture's time with somebody before the camera
    near: float = 0.4  # shares of the distance to what is looked at
    far: float = 0.75
    speed: float = 1.0  # metres a second


PRESETS = {"weak": Passers(share=0.2), "medium": Passers(share=0.4), "strong": Passers(share=0.8)}


@dataclass(frozen=True)
class Walk:
    """One who passes."""

    moment: float  # seconds: when the optical axis is crossed
    foot: Array  # (3,) metres: where the feet are then
    velocity: Array  # (3,) metres a second, level
    height: float  # metres
    visible: float  # seconds, about
    looks: int  # seed of clothes and figure

    def foot_at(self, seconds: float) -> Array:
        """(3,) where the feet are."""
        since = seconds - self.moment
        return np.asarray(self.foot + self.velocity * since + [0, 0, BOB * abs(np.sin(2 * np.pi * STEPS * since))])

    def near(self, seconds: float) -> bool:
        """Whether he may be in the picture at all."""
        return abs(seconds - self.moment) < self.visible


def draw(
    effect: Passers, times: Array, world_from_camera: Array, focus: Array, wide: float, floor: float | None, rng: np.random.Generator
) -> list[Walk]:
    """Who passes during a capture.

    Args:
        times: (N,) seconds of the frames.
        world_from_camera: (N, 4, 4), metres, z up.
        focus: (3,) what is looked at.
        wide: width of the picture over its distance.
        floor: metres; None: not known.
    """
    whole = float(times[-1] - times[0]) if len(times) > 1 else 0.0
    wanted, spent = effect.share * whole, 0.0
    walks: list[Walk] = []
    first = rng.random()
    while spent < wanted or (not walks and effect.share > 0):
        moment = float(times[0]) + whole * float((first + GOLDEN * len(walks)) % 1)
        pose = world_from_camera[int(np.argmin(np.abs(times - moment)))]
        distance = max(NEAREST, float(np.linalg.norm(pose[:3, 3] - focus)) * float(rng.uniform(effect.near, effect.far)))
        speed = effect.speed * float(rng.uniform(0.7, 1.3))
        angle = np.arctan2(pose[1, 2], pose[0, 2]) + np.deg2rad(rng.choice([-90, 90]) + rng.uniform(-TURN, TURN))
        ahead = pose[:3, 3] + distance * pose[:3, 2]
        ground = pose[2, 3] - EYES if floor is None else floor
        visible = (distance * wide + 0.6) / max(speed, 1e-3)
        velocity = speed * np.array([np.cos(angle), np.sin(angle), 0.0])
        foot, tall, looks = np.array([ahead[0], ahead[1], ground]), float(rng.uniform(*HEIGHTS)), int(rng.integers(2**31))
        walks.append(Walk(moment, foot, velocity, tall, visible, looks))
        spent += min(visible, max(whole, 1e-9))
    return walks
