"""Camera paths through a scene, clear of what stands in it: hand-held walk, orbit, forward, turning on the spot, fly-through."""

from __future__ import annotations

import difflib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch
from pydantic import Field

from fieldfuse.camera import Array
from fieldfuse.errors import InputError
from fieldfuse.simulate.curve import Curve, Motion, Shake, by_length
from fieldfuse.simulate.seen import Scenery

MARGINS = (0.35, 0.25, 0.15, 0.08)  # metres that a path keeps from surfaces: the widest that is possible
TRIES = 60
DENSE = 1500  # samples of a curve
LONG = 2.5  # a free space this many times longer than wide is walked along, not round


@dataclass
class PathSettings:
    """How the camera moves.

    Attributes:
        kind: "walk", "orbit", "forward", "rotation" or "fly".
        frames: pictures taken.
        fps: pictures a second.
        speed: metres a second.
        turn: degrees a second, for "rotation" only.
        shake: root mean square of the hand's angular speed, degrees a second.
    """

    kind: str = "walk"
    frames: Annotated[int, Field(ge=1, le=100_000)] = 60
    fps: Annotated[float, Field(ge=1e-3, le=1e4, allow_inf_nan=False)] = 10.0
    speed: Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)] = 0.5
    turn: Annotated[float, Field(ge=0, le=1000, allow_inf_nan=False)] = 20.0
    shake: Annotated[float, Field(ge=0, le=1000, allow_inf_nan=False)] = 2.0

    @property
    def seconds(self) -> float:
        return (self.frames - 1) / self.fps

    def times(self) -> Array:
        """(frames,) seconds."""
        return np.asarray(np.arange(self.frames) / self.fps)


def plan(scene: Scenery, settings: PathSettings, rng: np.random.Generator) -> Motion:
    """A motion of this kind that fits into the scene.

    Raises:
        InputError: no such kind, or no place in the scene for a path this long.
    """
    if settings.kind not in MAKERS:
        near = difflib.get_close_matches(settings.kind, list(MAKERS), n=1)
        raise InputError(
            f"there is no camera path {settings.kind!r}; known are {', '.join(MAKERS)}" + (f" (did you mean {near[0]!r}?)" if near else "")
        )
    turning = settings.kind == "rotation"
    speed = settings.turn if turning else settings.speed
    needed = speed * settings.seconds
    longest = 0.0
    for margin in MARGINS:
        for _ in range(TRIES):
            curve = MAKERS[settings.kind](scene, rng)
            if curve is None or not _clear(scene, curve.places, margin):
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


def _inside(scene: Scenery) -> tuple[Array, Array]:
    low, high = np.asarray(scene.free, dtype=np.float64)
    return low, high


def _long(scene: Scenery) -> bool:
    low, high = _inside(scene)
    wide = np.sort((high - low)[:2])
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
    low, high = _inside(scene)
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


def _orbit(scene: Scenery, rng: np.random.Generator) -> Curve:
    """A circle or ellipse round the focus, looking at it."""
    return _round(scene, rng, 0.0, 0.0)


def _walk(scene: Scenery, rng: np.random.Generator) -> Curve:
    """Round the focus as one walks to film it; along the free space where that is long."""
    if _long(scene):
        return _straight(scene, rng, sway=0.25, look=25.0)
    return _round(scene, rng, 0.06, 0.25)


def _forward(scene: Scenery, rng: np.random.Generator) -> Curve:
    """Straight ahead along the free space, looking where one goes."""
    return _straight(scene, rng, sway=0.0, look=0.0)


def _straight(scene: Scenery, rng: np.random.Generator, sway: float, look: float) -> Curve:
    """From one end of the free space to the other; `sway` (metres) to the sides, `look` (degrees) off the way."""
    low, high = _inside(scene)
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
    place = rng.uniform(*_inside(scene))
    angle = np.linspace(0, 2 * np.pi, DENSE + 1)
    nod = 0.15 * np.append(_closed_waves(DENSE, rng, 2, 5), 0)
    nod[-1] = nod[0]
    forward = np.stack([np.cos(angle), np.sin(angle), nod - 0.1], axis=1)
    return Curve(np.linspace(0, 360, DENSE + 1), np.tile(place, (DENSE + 1, 1)), forward, closed=True)


def _fly(scene: Scenery, rng: np.random.Generator) -> Curve:
    """A smooth closed flight through random points of the free space, looking ahead and towards the focus."""
    low, high = _inside(scene)
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


MAKERS: dict[str, Callable[[Scenery, np.random.Generator], Curve | None]] = {
    "walk": _walk,
    "orbit": _orbit,
    "forward": _forward,
    "rotation": _rotation,
    "fly": _fly,
}
