"""The planes of a scene (floor, walls, doors), and how one camera sees them.

They are found in points that matching gave: of planes through three neighbouring points the one that most of what is left lies on, again
and again (sequential RANSAC, Fischler and Bolles 1981).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fieldfuse.backends.numba.depth_maps import plane_depths, plane_numbers
from fieldfuse.camera import Array, Intrinsics, unproject
from fieldfuse.stereo.consistency import DepthMaps, numbers

POINTS = 60_000  # that planes are looked for in, of all images together
ON = 0.015  # share of its depth by which a point may miss a plane that it is counted to
MIN_SHARE = 0.006  # share of all points that a plane must have
MAX_PLANES = 24  # planes
TRIPLES = 400  # planes that are tried in each round …
SCORED = 6000  # … on so many of the points
APART = (0.02, 0.3)  # of the image's long side: a triple's points lie in one image, no nearer and no farther from each other
BEST = 3  # of the planes that were tried are fitted to their points
REFITS = 4


@dataclass(frozen=True)
class Points:
    """Points of several images, those of one image beside each other."""

    place: Array  # (N, 3) float64, world
    depth: Array  # (N,) float64 along z of the image's camera
    view: Array  # (N,) int64, rising
    pixel: Array  # (N, 2) float64 x, y in shares of the image's long side


def points_of(maps: DepthMaps) -> Points:
    """Points of depth maps, even shares of all of them, each at random places."""
    generator = np.random.default_rng(0)
    most = max(1, POINTS // max(len(maps.depths), 1))
    places, depths, views, pixels = [np.zeros((0, 3))], [np.zeros(0)], [np.zeros(0, np.int64)], [np.zeros((0, 2))]
    for index, (depth, camera, pose) in enumerate(zip(maps.depths, maps.cameras, maps.world_from_camera, strict=True)):
        rows, columns = np.nonzero(depth > 0)
        some = generator.permutation(len(rows))[:most]
        pixels.append(np.column_stack([columns[some] + 0.5, rows[some] + 0.5]))
        depths.append(depth[rows[some], columns[some]].astype(np.float64))
        places.append(unproject(camera, pose, pixels[-1], depths[-1]))
        pixels[-1] /= max(depth.shape)
        views.append(np.full(len(some), index))
    return Points(np.concatenate(places), np.concatenate(depths), np.concatenate(views), np.concatenate(pixels))


def find_planes(points: Points, seed: int = 0, on: float = ON, least: float = MIN_SHARE, most: int = MAX_PLANES) -> Array:
    """(K, 4) float64 planes, those with most points first: n · p = d with a unit normal n in the first three columns, d in the last.

    What lies on a plane, within twice `on` (a share of its depth), is not used for the next one. Each has `least` of the points.
    """
    generator = np.random.default_rng(seed)
    left = np.arange(len(points.depth))
    needed = max(3.0, least * len(left))
    found: list[Array] = []
    while len(found) < most and len(left) >= needed:
        tried = _planes_through(points, _triples(points, left, generator))
        some = generator.permutation(left)[:SCORED]
        counts = (_misses(points, some, tried) < on).sum(axis=0)
        fitted = [_fitted(points, left, tried[best], on) for best in np.argsort(-counts, kind="stable")[:BEST]]
        if not fitted:
            break
        number, plane = max(fitted, key=lambda one: one[0])
        if number < needed:
            break
        found.append(plane)
        left = left[_misses(points, left, plane[None])[:, 0] >= 2 * on]
    return np.array(found).reshape(-1, 4)


def shares(points: Points, planes: Array, on: float = ON) -> Array:
    """(K,) the share of all points that lies on each plane."""
    if not len(points.depth):
        return np.zeros(len(planes))
    return np.asarray((_misses(points, np.arange(len(points.depth)), planes) < on).mean(axis=0))


def _triples(points: Points, left: Array, generator: np.random.Generator) -> Array:
    """(T, 3) points of `left`, each three in one image and `APART`."""
    first = generator.choice(left, TRIPLES)
    views = points.view[left]
    start, stop = np.searchsorted(views, points.view[first]), np.searchsorted(views, points.view[first], side="right")
    others = left[start[:, None] + (generator.random((TRIPLES, 16)) * (stop - start)[:, None]).astype(np.int64)]  # (T, 16) of the same view
    gap = np.linalg.norm(points.pixel[others] - points.pixel[first][:, None], axis=2)
    fits = (gap > APART[0]) & (gap < APART[1])
    chosen = np.argsort(~fits, axis=1, kind="stable")[:, :2]
    whole = fits.sum(axis=1) >= 2
    return np.column_stack([first, np.take_along_axis(others, chosen, axis=1)])[whole]


def _planes_through(points: Points, triples: Array) -> Array:
    """(T', 4) the planes through points, without those on a line."""
    a, b, c = (points.place[triples[:, corner]] for corner in range(3))
    normal = np.cross(b - a, c - a)
    size = np.linalg.norm(normal, axis=1)
    whole = size > 1e-6 * np.linalg.norm(b - a, axis=1) * np.linalg.norm(c - a, axis=1)
    normal = normal[whole] / size[whole, None]
    return np.column_stack([normal, (normal * a[whole]).sum(axis=1)])


def _misses(points: Points, which: Array, planes: Array) -> Array:
    """(len(which), K) distances from planes, in shares of the points' depths."""
    return np.asarray(np.abs(points.place[which] @ planes[:, :3].T - planes[:, 3]) / points.depth[which, None])


def _fitted(points: Points, left: Array, plane: Array, on: float) -> tuple[int, Array]:
    """A plane by least squares over what lies on it, nearer points counting more since they are known better; and how many they are."""
    for number in range(REFITS):
        near = left[_misses(points, left, plane[None])[:, 0] < (2 * on if number == 0 else on)]
        if len(near) < 3:
            return 0, plane
        weight = 1 / points.depth[near]
        middle = (points.place[near] * weight[:, None]).sum(axis=0) / weight.sum()
        spread = (points.place[near] - middle) * weight[:, None]
        normal = np.linalg.eigh(spread.T @ spread)[1][:, 0]
        plane = np.append(normal, normal @ middle)
    return int((_misses(points, left, plane[None])[:, 0] < on).sum()), plane


def in_camera(planes: Array, pose: Array) -> Array:
    """(K, 4) planes n · p = d of the world in the frame of a camera that stands at `pose` (world from camera)."""
    return np.column_stack([planes[:, :3] @ pose[:3, :3], planes[:, 3] - planes[:, :3] @ pose[:3, 3]])


def numbers_of(depth: Array, camera: Intrinsics, local: Array, on: float, slant: float) -> Array:
    """(H, W) int32 the first of the planes that each pixel lies on; len(local): none of them, −1: there is no depth.

    Args:
        depth: (H, W) along z, 0 = missing.
        local: (K, 4) of `in_camera`.
        on: share of its depth by which a pixel may miss its plane.
        slant: degrees between view and normal beyond which a plane has no depth: a small error of it is a large one of the depth.
    """
    out = np.empty(depth.shape, np.int32)
    plane_numbers(depth, numbers(camera), local, on, float(np.cos(np.deg2rad(slant))), out)
    return out


def depth_of(which: Array, camera: Intrinsics, local: Array, slant: float) -> Array:
    """(H, W) float32 depth of plane which[v, u]; 0 where that is −1, behind the camera, or more than `slant` degrees aslant."""
    out = np.zeros(which.shape, np.float32)
    plane_depths(np.ascontiguousarray(which, dtype=np.int32), numbers(camera), local, float(np.cos(np.deg2rad(slant))), out)
    return out
