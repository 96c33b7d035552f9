"""Camera paths through a scene, clear of what stands in it: hand-held walk, orbit, forward, turning on the spot, fly-through.

A motion is a curve passed at constant speed, a direction to look, and the shake of a hand.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch
from pydantic import Field
from scipy.spatial.transform import Rotation

from fieldfuse.camera import Array
from fieldfuse.config import nearest
from fieldfuse.errors import InputError
from fieldfuse.simulate.eye import Scenery

MARGINS = (0.35, 0.25, 0.15, 0.08)  # metres that a path keeps from surfaces: the widest that is possible
TRIES = 60
DENSE = 1500  # samples of a curve
LONG = 2.5  # a free space this many times longer than wide is walked along, not round
SHAKE_WAVES = 12  # sines a shake is made of
SHAKE_SLOWEST, SHAKE_FASTEST = 0.7, 7.0  # cycles a second
MODEST = 1e-9


@dataclass(frozen=True)
class Curve:
    """Places and directions along a curve."""

    at: Array  # (S,) where along the curve the samples stand, from 0: metres, or degrees for turning on the spot
    places: Array  # (S, 3) metres
    forward: Array  # (S, 3) viewing directions, not necessarily of length 1, never straight up or down
    closed: bool  # the last sample is the first again, and the camera may go round and round

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
    """A camera on its way: where it is and looks at any time."""

    curve: Curve
    speed: float  # along the curve: metres, or degrees on the spot, a second
    start: float = 0.0
    shake: Shake | None = None
    bob: float = 0.0  # height in metres of the up and down of a walk at 1.8 steps a second; 0: none

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


@dataclass
class PathSettings:
    """How the camera moves."""

    kind: str = "walk"  # walk, orbit, forward, rotation or fly
    frames: Annotated[int, Field(ge=1, le=100_000)] = 60
    fps: Annotated[float, Field(ge=1e-3, le=1e4, allow_inf_nan=False)] = 10.0  # frames a second
    speed: Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)] = 0.5  # metres a second
    turn: Annotated[float, Field(ge=0, le=1000, allow_inf_nan=False)] = 20.0  # degrees a second, for rotation only
    # Root mean square of the hand's angular speed, degrees a second
    shake: Annotated[float, Field(ge=0, le=1000, allow_inf_nan=False)] = 2.0

    def times(self) -> Array:
        """(frames,) seconds."""
        return np.asarray(np.arange(self.frames) / self.fps)


def plan(scene: Scenery, settings: PathSettings, rng: np.random.Generator) -> Motion:
    """A motion of this kind that fits into the scene.

    Raises:
        InputError: no such kind, or no place in the scene for a path this long.
    """
    if settings.kind not in MAKERS:
        raise InputError(f"there is no camera path {settings.kind!r}; known are {', '.join(MAKERS)}{nearest(settings.kind, MAKERS)}")
    turning = settings.kind == "rotation"
    speed = settings.turn if turning else settings.speed
    needed = speed * (settings.frames - 1) / settings.fps
    longest = 0.0
    for margin in MARGINS:
        for _ in range(TRIES):
            curve = MAKERS[settings.kind](scene, rng)
            if not _clear(scene, curve.places, margin):
                continue
            longest = max(longest, curve.length)
            if curve.closed or curve.length >= needed:
                start = float(rng.uniform(0, curve.length if curve.closed else curve.length - needed))
                shake = Shake(settings.shake, rng) if settings.shake > 0 else None
                return Motion(curve, speed, start, shake, 0.012 if settings.kind == "walk" and settings.shake > 0 else 0.0)
    if longest > 0:
        raise InputError(
            f"a {settings.kind} path of {needed:.1f} m does not fit into the scene, which leaves at most {longest:.1f} m; "
            "lower path.speed or path.frames, or raise path.fps"
        )
    raise InputError(f"the scene leaves no room for a {settings.kind} path; choose another path.kind")


def _clear(scene: Scenery, places: Array, margin: float) -> bool:
    """Whether a curve keeps `margin` from surfaces: looked at so densely that no wall fits between two looks."""
    longest = float(np.linalg.norm(np.diff(places, axis=0), axis=1).max())
    step = min(max(1, int(margin / max(longest, 1e-9))), max(1, len(places) // 60))
    return bool((scene.clearance(torch.from_numpy(places[::step].astype(np.float32))) > margin).all())


def _long(scene: Scenery) -> bool:
    wide = np.sort(np.ptp(scene.free, axis=0)[:2])
    return bool(wide[1] > LONG * wide[0])


def _closed_waves(count: int, rng: np.random.Generator, first: int = 1, last: int = 4) -> Array:
    """(count,) a smooth closed random curve of deviation 1."""
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    wave = np.arange(first, last)
    phase, weight = rng.uniform(0, 2 * np.pi, len(wave)), rng.normal(0, 1, len(wave)) / wave
    curve = (weight[:, None] * np.sin(wave[:, None] * angle + phase[:, None])).sum(0)
    return np.asarray(curve / max(float(curve.std()), 1e-9))


def _round(scene: Scenery, rng: np.random.Generator, wobble: float, aim: float) -> Curve:
    """A loop about the focus within the free space, looking about at the focus; `wobble` and `aim`: how unevenly."""
    low, high = scene.free
    middle = np.clip(scene.focus, low, high)
    reach = np.maximum(np.minimum(high - middle, middle - low), 0.3 * (high - low) / 2)[:2]
    angle = np.linspace(0, 2 * np.pi, DENSE, endpoint=False) * (1 if rng.random() < 0.5 else -1)
    share = rng.uniform(0.72, 0.97) * (1 + wobble * _closed_waves(DENSE, rng))
    flat = middle[:2] + share[:, None] * reach * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rise = rng.uniform(0.3, 0.8) + (0.12 + wobble) * _closed_waves(DENSE, rng)
    places = np.column_stack([flat, low[2] + np.clip(rise, 0, 1) * (high[2] - low[2])])
    places[:, :2] = np.clip(places[:, :2], low[:2], high[:2])
    target = scene.focus + aim * np.stack([_closed_waves(DENSE, rng) for _ in range(3)], axis=1) * np.array([1, 1, 0.5])
    return by_length(places, target - places, closed=True)


def _straight(scene: Scenery, rng: np.random.Generator, sway: float, look: float) -> Curve:
    """From one end of the free space to the other; `sway` (metres) to the sides, `look` (degrees) off the way."""
    low, high = scene.free
    axis = int(np.argmax((high - low)[:2])) if _long(scene) or rng.random() < 0.6 else int(rng.integers(2))
    ends = rng.uniform(low, high, (2, 3))
    ends[:, axis] = (low[axis], high[axis]) if rng.random() < 0.5 else (high[axis], low[axis])
    if _long(scene):
        ends[1, 1 - axis] = ends[0, 1 - axis] = rng.uniform(0.35, 0.65) * (low + high)[1 - axis]
    ends[1, 2] = ends[0, 2]
    s = np.linspace(0, 1, DENSE)[:, None]
    places = ends[0] * (1 - s) + ends[1] * s
    ahead = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    aside = np.cross(ahead, [0.0, 0.0, 1.0])
    if sway:
        wave = np.sin(2 * np.pi * s * rng.uniform(1, 3) + rng.uniform(0, 2 * np.pi))
        places = np.clip(places + sway * wave * aside, low, high)
    yaw = np.deg2rad(look) * np.sin(2 * np.pi * s * rng.uniform(0.5, 2) + rng.uniform(0, 2 * np.pi))
    return by_length(places, np.cos(yaw) * ahead + np.sin(yaw) * aside - np.array([0, 0, 0.12 * bool(look)]), closed=False)


def _rotation(scene: Scenery, rng: np.random.Generator) -> Curve:
    """On the spot, round and round, nodding a little. Measured in degrees."""
    place = rng.uniform(*scene.free)
    angle = np.linspace(0, 2 * np.pi, DENSE + 1)
    nod = 0.15 * np.append(_closed_waves(DENSE, rng, 2, 5), 0)
    nod[-1] = nod[0]
    forward = np.stack([np.cos(angle), np.sin(angle), nod - 0.1], axis=1)
    return Curve(np.linspace(0, 360, DENSE + 1), np.tile(place, (DENSE + 1, 1)), forward, closed=True)


def _fly(scene: Scenery, rng: np.random.Generator) -> Curve:
    """A smooth closed flight through random points of the free space, looking ahead and towards the focus."""
    low, high = scene.free
    corners = rng.uniform(low, high, (5, 3))
    centre = corners.mean(0)
    corners = corners[np.argsort(np.arctan2(corners[:, 1] - centre[1], corners[:, 0] - centre[0]))]
    at = np.linspace(0, len(corners), DENSE, endpoint=False)
    part, t = at.astype(int), (at % 1)[:, None]
    a, b, c, d = (corners[(part + k) % len(corners)] for k in (-1, 0, 1, 2))
    # Uniform B-spline: it stays inside the hull of the points, and so inside the free space.
    places = ((1 - t) ** 3 * a + (3 * t**3 - 6 * t**2 + 4) * b + (-3 * t**3 + 3 * t**2 + 3 * t + 1) * c + t**3 * d) / 6
    ahead = np.roll(places, -DENSE // 12, axis=0) - places
    ahead[:, 2] *= 0.5
    inwards = scene.focus - places
    forward = ahead / np.linalg.norm(ahead, axis=1, keepdims=True) + 0.8 * inwards / np.linalg.norm(inwards, axis=1, keepdims=True)
    flat = np.linalg.norm(forward[:, :2], axis=1)
    forward[:, 2] = np.clip(forward[:, 2], -1.5 * flat, 1.5 * flat)
    if flat.min() < 0.2:  # ahead and the focus cancel out somewhere: the view would spin
        forward = ahead
    return by_length(places, forward, closed=True)


def _walk(scene: Scenery, rng: np.random.Generator) -> Curve:
    """Round the focus as one walks to film it; along the free space where that is long."""
    return _straight(scene, rng, sway=0.25, look=25.0) if _long(scene) else _round(scene, rng, 0.06, 0.25)


MAKERS: dict[str, Callable[[Scenery, np.random.Generator], Curve]] = {
    "walk": _walk,
    "orbit": lambda scene, rng: _round(scene, rng, 0.0, 0.0),  # looking at the focus
    "forward": lambda scene, rng: _straight(scene, rng, sway=0.0, look=0.0),  # looking where one goes
    "rotation": _rotation,
    "fly": _fly,
}
