"""The frame that the cameras decide (z up), and the region of interest in it: the box that gets the fine volume, because it is what the
cameras look at; and regions in general."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from fieldfuse.camera import Array, Similarity
from fieldfuse.poses.overlap import convergence

LEVEL = 0.25  # eigenvalue ratio below which the cameras' x axes lie in a plane (held level while turning)
ORBIT = 0.05  # the same for camera centres: they lie in a plane
AGREE = 15.0  # degrees between two estimates that count as one
NEAR = 60.0  # degrees that an estimate may lie off the mean up vector of the cameras
TURNING = 0.01  # least share of the x axes' second direction: about 6° of turning
UNDECIDED = 0.15  # length of a mean of unit vectors below which it points nowhere
SHORT = 0.5  # and below which it does not overrule the x axes
STEEP = 0.7  # cosine between a camera's axis and up above which that axis has no heading
PERCENTILES = (0.5, 99.5)  # of points, that a footprint spans

OBJECT = "object"  # cameras look inwards at one place
ROOM = "room"  # cameras look outwards, or around
FORWARD = "forward"  # cameras look one way

INWARD = 0.85  # share of cameras that must have the common point before them
MISS = 0.35  # median distance of an axis from the common point, relative to the camera's distance
TURNED = 0.02  # mean squared sine of axes about their mean direction that makes them converge (about 8°)
SURROUND = 0.25  # the same (30°) where depth shows the whole extent: a depth camera that sways in a room looks at the room
REACH = 0.8  # radius of an object's ball, relative to the median camera distance
CLEAR = 0.95  # and to the distance of the nearest tenth of the cameras
MARGIN = 0.05  # of the box on each side
BEST = (1.0, 99.0)  # weighted percentiles that span the box of an object or a view forward
ALL = (0.5, 99.5)  # of a room, where the walls are what is looked at
MIN_POINTS = 100  # points that make percentiles meaningful


def up_direction(world_from_camera: Array, given: tuple[float, float, float] | None = None) -> tuple[Array, str]:
    """A unit up vector (3,) in the frame of the poses, and the reason for it.

    Without a given one: people hold cameras level, so the direction across all x axes is up, when the cameras turned enough for
    that; else the mean up vector of the cameras (−y). Where the camera centres lie in a plane whose normal agrees within
    15°, as on an orbit, the two are averaged.
    """
    if given is not None:
        vector = np.asarray(given, dtype=np.float64)
        return vector / np.linalg.norm(vector), "given by the source"
    mean = -world_from_camera[:, :3, 1].mean(axis=0)  # shorter than 1 the more cameras disagree
    behind = -world_from_camera[:, :3, 2].mean(axis=0)
    length = float(np.linalg.norm(mean))
    x = world_from_camera[:, :3, 0]
    values, vectors = np.linalg.eigh(x.T @ x / len(x))
    level = vectors[:, 0]
    # Cameras that look straight down have their up vectors in the ground plane: then up is where they stand.
    level = _towards(level, mean if abs(level @ mean) > UNDECIDED else behind)
    turned = values[0] < LEVEL * values[1] and values[1] > TURNING
    if turned and (length < SHORT or _degrees(level, mean / length) < NEAR):
        up, reason = level, "direction across the cameras' x axes (held level)"
    elif length > UNDECIDED:
        up, reason = mean / length, "mean up vector of the cameras"
    else:
        return np.array([0.0, 0.0, 1.0]), "kept as it is: the cameras' up vectors point everywhere"
    centres = world_from_camera[:, :3, 3] - world_from_camera[:, :3, 3].mean(axis=0)
    values, vectors = np.linalg.eigh(centres.T @ centres / len(centres))
    normal = _towards(vectors[:, 0], up)
    if values[0] < ORBIT * values[1] and _degrees(normal, up) < AGREE:
        up, reason = (up + normal) / np.linalg.norm(up + normal), reason + ", averaged with the normal of the cameras' plane"
    return up, reason


def turn_about_z(degrees: float) -> Array:
    """(3, 3)."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def camera_frame(world_from_camera: Array, given: tuple[float, float, float] | None = None) -> tuple[Array, str]:
    """(3, 3) rotation into a frame that the cameras alone decide, and the reason for its z, which is up (see `up_direction`).

    Its x lies along the first camera's right, or along its view where it lies on its side. However a capture is turned, it is the same
    there: what comes after looks at the same numbers, to rounding, and lays the same lattice.
    """
    up, reason = up_direction(world_from_camera, given)
    right, ahead = world_from_camera[0, :3, 0], world_from_camera[0, :3, 2]
    heading = right if abs(right @ up) < STEEP else ahead
    x = heading - (heading @ up) * up
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up]), reason


def tight_turn(points: Array) -> float:
    """Degrees to turn (P, 3) points about z for the smallest axis-aligned footprint, within ±45°, to a tenth of a degree.

    The footprint spans percentiles, so that stray points do not decide.
    """

    def footprints(degrees: Array) -> list[float]:
        """Areas of the axis-aligned footprints of the points turned by each of the angles."""
        turned = (points[:, :2] @ turn_about_z(float(angle))[:2, :2].T for angle in degrees)
        return [float(np.prod(np.diff(np.percentile(places, PERCENTILES, axis=0), axis=0))) for places in turned]

    coarse = np.arange(-45.0, 45.0, 1.5)
    best = float(coarse[np.argmin(footprints(coarse))])
    fine = best + np.arange(-1.4, 1.45, 0.1)
    return float(fine[np.argmin(footprints(fine))])


def _towards(vector: Array, other: Array) -> Array:
    return vector if vector @ other >= 0 else -vector


def _degrees(first: Array, second: Array) -> float:
    return float(np.degrees(np.arccos(np.clip(first @ second, -1.0, 1.0))))


@dataclass(frozen=True)
class Layout:
    """How the cameras stand to the scene."""

    kind: str
    focus: Array  # (3,) where the axes come closest to each other
    distance: float  # median distance of the cameras from it
    nearest: float  # distance of the closest tenth


def layout(world_from_camera: Array, with_depth: bool = False) -> Layout:
    """Inward, outward or forward, from the poses alone; with depth maps inward takes more."""
    focus, depth, miss = convergence(world_from_camera)
    centres, axes = world_from_camera[:, :3, 3], world_from_camera[:, :3, 2]
    away = np.linalg.norm(centres - focus, axis=1)
    distance, nearest = float(np.median(away)), float(np.percentile(away, 10))
    mean = axes.mean(axis=0)
    length = float(np.linalg.norm(mean))
    turned = 1.0 if length < 1e-9 else float(1 - np.mean((axes @ (mean / length)) ** 2))
    if turned > (SURROUND if with_depth else TURNED) and np.mean(depth > 0) >= INWARD and np.median(miss / np.maximum(away, 1e-12)) < MISS:
        kind = OBJECT
    elif length > 0.85:
        kind = FORWARD
    else:
        kind = ROOM
    return Layout(kind, focus, distance, nearest)


def weighted_percentiles(values: Array, weights: Array, percents: tuple[float, float]) -> tuple[float, float]:
    """Of (P,) values with (P,) weights ≥ 0."""
    order = np.argsort(values, kind="stable")
    share = np.cumsum(weights[order])
    share = 100 * (share - 0.5 * weights[order]) / share[-1]
    low, high = np.interp(percents, share, values[order])
    return float(low), float(high)


def box(points: Array, weights: Array, percents: tuple[float, float], margin: float = MARGIN) -> tuple[Array, Array]:
    """Centre (3,) and half size (3,) of the axis-aligned box that spans weighted percentiles, widened by `margin` on each side.

    No side is thinner than a tenth of the longest: a volume needs some depth even before a flat wall.
    """
    spans = np.array([weighted_percentiles(points[:, axis], weights, percents) for axis in range(3)])
    centre = spans.mean(axis=1)
    half = 0.5 * (spans[:, 1] - spans[:, 0])
    half = np.maximum(half, 0.1 * half.max()) * (1 + 2 * margin)
    return centre, half


def points_of_interest(found: Layout, points: Array, views: Array, bounded: bool) -> tuple[Array, Array, tuple[float, float]]:
    """Which points span the region, their weights, and between which percentiles.

    For an object: the points inside a ball about the focus that keeps clear of the cameras; for other layouts, and for
    captures that end by themselves (`bounded`: alpha, depth), all points.

    Returns:
        (P,) bool, (P,) weights, percentiles.
    """
    weights = views.astype(np.float64)
    everything = np.ones(len(points), dtype=bool)
    if found.kind != OBJECT:
        return everything, weights, ALL if found.kind == ROOM or bounded else BEST
    radius = min(REACH * found.distance, CLEAR * found.nearest)
    inside = np.linalg.norm(points - found.focus, axis=1) < radius
    if np.count_nonzero(inside) < min(MIN_POINTS, len(points) // 4):
        return everything, weights, BEST
    return inside, weights, BEST


@dataclass(frozen=True)
class Region:
    """A convex part of space: all x with `normals` · x ≤ `offsets`, (K, 3) and (K,) float64."""

    normals: Array
    offsets: Array

    @classmethod
    def box(cls, low: Array, high: Array) -> Region:
        """From its lowest and highest corner (3,)."""
        return cls(np.concatenate([np.eye(3), -np.eye(3)]), np.concatenate([high, -np.asarray(low, dtype=np.float64)]))

    @classmethod
    def hull(cls, points: Array) -> Region | None:
        """The convex hull of (P, 3) points; None where they span no volume."""
        try:
            equations = ConvexHull(points).equations
        except (QhullError, ValueError):
            return None
        return cls(equations[:, :3], -equations[:, 3])

    def moved(self, to: Similarity) -> Region:
        """The same region in the frame that `to` leads to."""
        normals = to.directions(self.normals)
        return Region(normals, to.scale * self.offsets + normals @ to.translation)

    def both(self, other: Region) -> Region:
        """What lies in this one and in the other."""
        return Region(np.concatenate([self.normals, other.normals]), np.concatenate([self.offsets, other.offsets]))

    def inside(self, points: Array) -> Array:
        """(N,) bool of (N, 3) points."""
        return np.asarray((points @ self.normals.T <= self.offsets).all(axis=-1))
