"""A camera's motion as a function of time: a curve passed at constant speed, a direction to look, and the shake of a hand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from fieldfuse.camera import Array

SHAKE_WAVES = 12  # sines a shake is made of
SHAKE_SLOWEST, SHAKE_FASTEST = 0.7, 7.0  # cycles a second
MODEST = 1e-9


@dataclass(frozen=True)
class Curve:
    """Places and directions along a curve.

    Attributes:
        at: (S,) where along the curve the samples stand, from 0: metres, or degrees for turning on the spot.
        places: (S, 3) metres.
        forward: (S, 3) viewing directions, not necessarily of length 1, never straight up or down.
        closed: the last sample is the first again, and the camera may go round and round.
    """

    at: Array
    places: Array
    forward: Array
    closed: bool

    @property
    def length(self) -> float:
        return float(self.at[-1])

    def poses(self, along: Array) -> Array:
        """(N, 4, 4) upright poses at (N,) places along the curve."""
        if self.closed:
            along = np.mod(along, self.length)
        columns = [np.interp(along, self.at, column) for column in np.concatenate([self.places, self.forward], axis=1).T]
        place, forward = np.stack(columns[:3], axis=1), _unit(np.stack(columns[3:], axis=1))
        right = _unit(np.cross(forward, [0.0, 0.0, 1.0]))
        out = np.tile(np.eye(4), (len(place), 1, 1))
        out[:, :3] = np.stack([right, np.cross(forward, right), forward, place], axis=2)
        return out


def by_length(places: Array, forward: Array, closed: bool) -> Curve:
    """A curve through densely sampled places (S, 3), measured in metres."""
    if closed:
        places, forward = (np.concatenate([values, values[:1]]) for values in (places, forward))
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    return Curve(np.concatenate([[0], np.cumsum(np.maximum(steps, MODEST))]), places, forward, closed)


class Shake:
    """Small rotations of a hand: for each axis a sum of sines whose angular speed has a root mean square.

    w_a(t) = Σ_k c_ak · sin(2π f_k t + φ_ak), scaled so that the mean of |dw/dt|² over all time is `degrees_a_second`².
    """

    def __init__(self, degrees_a_second: float, rng: np.random.Generator) -> None:
        self.frequency = rng.uniform(SHAKE_SLOWEST, SHAKE_FASTEST, SHAKE_WAVES)
        self.phase = rng.uniform(0, 2 * np.pi, (3, SHAKE_WAVES))
        weight = rng.normal(0, 1, (3, SHAKE_WAVES)) / self.frequency * np.array([[1.0], [1.0], [0.6]])  # less about the viewing axis
        speed = np.sqrt(((2 * np.pi * self.frequency * weight) ** 2).sum() / 2)
        self.weight = weight * np.deg2rad(degrees_a_second) / speed

    def vectors(self, seconds: Array) -> Array:
        """(N, 3) rotation vectors in camera axes, radians."""
        waves = np.sin(2 * np.pi * self.frequency * seconds[:, None] + self.phase[:, None])  # (3, N, K)
        return np.asarray((waves * self.weight[:, None]).sum(2).T)


@dataclass(frozen=True)
class Motion:
    """A camera on its way: where it is and looks at any time.

    Attributes:
        speed: along the curve: metres, or degrees on the spot, a second.
        bob: height in metres of the up and down of a walk at 1.8 steps a second; 0: none.
    """

    curve: Curve
    speed: float
    start: float = 0.0
    shake: Shake | None = None
    bob: float = 0.0

    def poses(self, seconds: Array) -> Array:
        """(N, 4, 4) float64 world_from_camera at (N,) times."""
        seconds = np.asarray(seconds, dtype=np.float64).reshape(-1)
        along = self.start + self.speed * seconds
        out = self.curve.poses(along if self.curve.closed else np.clip(along, 0, self.curve.length))
        if self.bob:
            out[:, 2, 3] += self.bob * np.sin(2 * np.pi * 1.8 * seconds)
        if self.shake is not None:
            out[:, :3, :3] = out[:, :3, :3] @ Rotation.from_rotvec(self.shake.vectors(seconds)).as_matrix()
        return out


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12))
