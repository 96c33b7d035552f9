"""The region of interest: the box that gets the fine volume, because it is what the cameras look at."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fieldfuse.camera import Array
from fieldfuse.poses.overlap import convergence

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


@dataclass(frozen=True)
class Layout:
    """How the cameras stand to the scene."""

    kind: str
    focus: Array  # (3,) where the axes come closest to each other
    distance: float  # median distance of the cameras from it
    nearest: float  # distance of the closest tenth


def layout(world_from_camera: Array, with_depth: bool = False) -> Layout:
    """Inward, outward or forward, from the poses alone; with depth maps more is asked of inward."""
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
