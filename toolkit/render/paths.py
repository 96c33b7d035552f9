"""Camera paths for videos: round an object, a small ellipse before a scene seen from one side, or a walk along a room's sweep."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation

from fieldfuse.camera import Array
from fieldfuse.errors import InputError

UP = (0.0, 0.0, 1.0)  # in the working frame
FACING = 0.9  # length of the mean viewing direction above which all cameras look the same way (spread of about 25°)
LOOKING_IN = 0.85  # median cosine between viewing direction and direction to the centre above which the cameras surround it
FULL_CIRCLE = np.deg2rad(50)  # the largest gap in azimuth that a closed circle may cross
ARC_ENDS = 0.04  # share of the cameras beyond either end of an arc: where hardly anybody stood, fog stands in the way
KEY_CAMERAS = 12
ARC_MARGIN = 0.02


def orbit(world_from_camera: Array, centre: Array, frames: int = 90) -> Array:
    """A smooth closed path of `frames` poses, (F, 4, 4) in OpenCV axes, that stays near the (N, 4, 4) captured cameras.

    - Cameras that look the same way: an ellipse in their plane, about as wide as they are spread, looking at one point.
    - Cameras round a centre: an ellipse round it at their distance and height; where they cover only an arc, along the arc and back.
    - Everything else (rooms seen from inside, walks): smoothly through some of the cameras and back.

    Args:
        centre: (3,) of what is looked at.

    Raises:
        InputError: no cameras, or fewer than one frame.
    """
    poses = np.asarray(world_from_camera, dtype=np.float64).reshape(-1, 4, 4)
    if len(poses) == 0:
        raise InputError("a camera path needs at least one camera, there is none; pass the poses of the capture")
    if frames < 1:
        raise InputError(f"a camera path needs at least one frame, not {frames}; raise export.video_frames")
    if len(poses) == 1:
        return np.repeat(poses, frames, axis=0)
    positions, forward = poses[:, :3, 3], poses[:, :3, 2]
    target = np.asarray(centre, dtype=np.float64)
    phase = 2 * np.pi * np.arange(frames) / frames
    if np.linalg.norm(forward.mean(axis=0)) > FACING:
        return _before(poses, target, phase)
    inward = target - positions
    inward /= np.maximum(np.linalg.norm(inward, axis=1, keepdims=True), 1e-12)
    if np.median((forward * inward).sum(axis=1)) > LOOKING_IN:
        return _around(positions, target, np.array(UP), phase)
    return _along(_keys(poses[_tour(positions)]), (1 - np.cos(phase)) / 2)


def look_at(positions: Array, target: Array, up: Array) -> Array:
    """(N, 4, 4) poses at (N, 3) positions that look at (3,) or (N, 3) targets, the image's upper side towards `up`."""
    positions = np.asarray(positions, dtype=np.float64).reshape(-1, 3)
    forward = _unit(np.broadcast_to(target, positions.shape) - positions)
    right = np.cross(forward, up)
    # Straight up or down: any horizontal direction does.
    lost = np.linalg.norm(right, axis=1) < 1e-6
    right[lost] = np.cross(forward[lost], np.roll(np.asarray(up, dtype=np.float64), 1))
    right = _unit(right)
    out = np.tile(np.eye(4), (len(positions), 1, 1))
    out[:, :3, 0], out[:, :3, 1], out[:, :3, 2], out[:, :3, 3] = right, np.cross(forward, right), forward, positions
    return out


def _before(poses: Array, target: Array, phase: Array) -> Array:
    positions = poses[:, :3, 3]
    middle = np.median(positions, axis=0)
    right, down, forward = (_unit(poses[:, :3, axis].mean(axis=0)) for axis in range(3))
    offset = positions - middle
    # The spread within which most cameras are: beyond them there are no images.
    width, height = (np.quantile(np.abs(offset @ axis), 0.7) for axis in (right, down))
    distance = max(float((target - middle) @ forward), 2 * width, 2 * height, 1e-6)
    at = middle + np.cos(phase)[:, None] * width * right + np.sin(phase)[:, None] * height * down
    return look_at(at, middle + distance * forward, -down)


def _around(positions: Array, target: Array, up: Array, phase: Array) -> Array:
    east = _unit(np.cross(up, [1.0, 0, 0] if abs(up[0]) < 0.9 else [0, 1.0, 0]))
    north = np.cross(up, east)
    offset = positions - target
    azimuth = np.arctan2(offset @ north, offset @ east)
    ordered = np.sort(azimuth)
    gaps = np.diff(np.append(ordered, ordered[0] + 2 * np.pi))
    widest = int(np.argmax(gaps))
    if gaps[widest] <= FULL_CIRCLE:
        angle = phase
    else:  # along the arc and back, never through the part that nobody saw
        start = ordered[(widest + 1) % len(ordered)]
        first, last = start + np.quantile((azimuth - start) % (2 * np.pi), [ARC_ENDS, 1 - ARC_ENDS])
        angle = first + (last - first) * (0.5 - (0.5 - ARC_MARGIN) * np.cos(phase))
    # Distance, and height, as a constant plus one wave round the circle, by least squares with a pull towards the constant:
    # it follows an off-centre or tilted ring of cameras and cannot swing out between them.
    waves = np.stack([np.ones_like(azimuth), np.cos(azimuth), np.sin(azimuth)], axis=1)
    pull = np.diag([0, 1, 1]) * 0.02 * len(azimuth)
    ground = np.hypot(offset @ north, offset @ east)
    fit = np.linalg.solve(waves.T @ waves + pull, waves.T @ np.stack([ground, offset @ up], axis=1))
    radius, height = (np.stack([np.ones_like(angle), np.cos(angle), np.sin(angle)], axis=1) @ fit).T
    radius = np.clip(radius, ground.min(), ground.max())[:, None]
    at = target + radius * (np.cos(angle)[:, None] * east + np.sin(angle)[:, None] * north) + height[:, None] * up
    return look_at(at, target, up)


def _along(poses: Array, share: Array) -> Array:
    """Rigid poses at `share` (F,) of the way through the keys, evenly paced.

    Positions and quaternions follow cubic Hermite curves whose knots are spaced by distance moved and angle turned (slopes from
    neighbours, as in Catmull and Rom 1974), so velocity has no jumps.
    """
    if len(poses) == 1:
        return np.repeat(poses, len(share), axis=0)
    positions, turns = poses[:, :3, 3], _quaternions(poses[:, :3, :3])
    moved = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    turned = 2 * np.arccos(np.clip((turns[1:] * turns[:-1]).sum(axis=1), -1, 1))
    pace = moved / max(moved.mean(), 1e-12) + turned / max(turned.mean(), 0.2)
    knots = np.concatenate([[0], np.cumsum(np.maximum(pace, 1e-3))])
    values = np.concatenate([positions, turns], axis=1)
    width = np.diff(knots)[:, None]
    rise = np.diff(values, axis=0) / width
    inner = (rise[:-1] * width[1:] + rise[1:] * width[:-1]) / (width[1:] + width[:-1])
    # At the ends the slope of the parabola through the neighbour's slope and the first interval.
    first, last = (2 * rise[0] - inner[0], 2 * rise[-1] - inner[-1]) if len(inner) else (rise[0], rise[-1])
    curve = CubicHermiteSpline(knots, values, np.concatenate([first[None], inner, last[None]]))(share * knots[-1])
    out = np.tile(np.eye(4), (len(share), 1, 1))
    out[:, :3, :3] = Rotation.from_quat(curve[:, 3:]).as_matrix()
    out[:, :3, 3] = curve[:, :3]
    return out


def _keys(walk: Array) -> Array:
    """Up to KEY_CAMERAS poses along a walk (N, 4, 4), their positions without the shake of the hand: means over neighbours."""
    number = np.arange(len(walk))
    chosen = np.unique(np.linspace(0, len(walk) - 1, KEY_CAMERAS).round().astype(int))
    keys = walk[chosen].copy()
    width = 0.4 * len(walk) / KEY_CAMERAS
    if width > 1:
        # A narrower mean towards the ends, so that they stay where they are.
        reach = np.maximum(np.minimum(width, np.minimum(chosen, len(walk) - 1 - chosen) / 2), 0.1)
        weight = np.exp(-0.5 * ((number[None] - chosen[:, None]) / reach[:, None]) ** 2)
        keys[:, :3, 3] = weight @ walk[:, :3, 3] / weight.sum(axis=1, keepdims=True)
    return keys


def _tour(positions: Array) -> Array:
    """(N,) an order in which to visit the cameras: as captured, or from neighbour to neighbour where that is much shorter (photos)."""
    left = list(range(1, len(positions)))
    order = [0]
    while left:
        distance = np.linalg.norm(positions[left] - positions[order[-1]], axis=1)
        order.append(left.pop(int(np.argmin(distance))))
    captured = np.linalg.norm(np.diff(positions, axis=0), axis=1).sum()
    greedy = np.linalg.norm(np.diff(positions[order], axis=0), axis=1).sum()
    return np.array(order) if greedy < 0.5 * captured else np.arange(len(positions))


def _quaternions(rotations: Array) -> Array:
    """(N, 4) x, y, z, w of (N, 3, 3), each on the side of the one before it."""
    out = np.asarray(Rotation.from_matrix(rotations).as_quat())
    sides = np.where((out[1:] * out[:-1]).sum(axis=1) < 0, -1.0, 1.0)
    return out * np.concatenate([[1.0], np.cumprod(sides)])[:, None]


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12))

