"""Depth for captures that have none: each image is matched with posed neighbours by a plane sweep, and views confirm each other.

Steps: fronto-parallel planes at even steps of inverse depth, semi-global matching over them and refinement between the planes
(`cost_volume.py`), agreement between views (`consistency.py`). Nothing is learned; what has no texture stays empty here, and planes go on
through it afterwards (`plane_completion.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np

from fieldfuse import memory
from fieldfuse.camera import Array, Intrinsics
from fieldfuse.capture.types import Views
from fieldfuse.errors import InputError
from fieldfuse.poses.overlap import best_neighbours, overlap, parallax, spread_parallax
from fieldfuse.progress import SILENT, Progress
from fieldfuse.stereo.consistency import DepthMaps, confirmed
from fieldfuse.stereo.cost_volume import GreyView, Matcher, grey_view, plane_homography, refined, smoothed_planes
from fieldfuse.threads import in_order

T = TypeVar("T")

LONG_SIDE = 400  # pixels; cost grows with the third power of it
MATCHED = 4  # neighbours that an image is matched with
CHECKED = 8  # neighbours that its depth is checked against
SWEET = 5.0  # degrees of parallax that are looked for: what is seen from farther apart looks less alike (docs/measured/fitting.md)
MANY = 24  # images; fewer have no choice of neighbours (`LENIENT`)
MOST_COST = 0.4  # matching cost beyond which nothing was recognised: bare walls have 0.5 everywhere
STEP = 1.5  # pixels from plane to plane in the image of the neighbour that moves most; refinement finds what lies between
PLANES = (32, 128)  # fewest and most planes
NOISE = 0.4  # of the step from plane to plane, mostly 0.6 pixels of the neighbour that moves most: how well two depths agree
MOST_WORKERS = 8
COSTS_HELD = 3  # volumes of costs that a worker needs: those of the sweep, those that are smoothed, and images


@dataclass(frozen=True)
class Demands:
    """What neighbours must meet.

    Attributes:
        parallax: degrees outside which a neighbour measures nothing, or looks too different.
        overlap: least share of an image that the other shows, too.
        confirm: neighbours that must have the same depth. The first may be an image that was used for matching: it alone proves little …
    """

    parallax: tuple[float, float]
    overlap: float
    confirm: int


STRICT = Demands((1.0, 45.0), 0.25, 2)
# … but is all that there is where images are few, and enough where a fit has the last word (docs/measured/few_views.md).
LENIENT = Demands((1.0, 60.0), 0.15, 1)


@dataclass(frozen=True)
class StereoDepth:
    """Depth of one view by matching."""

    depth: Array  # (H, W) float32 along z, working units, 0 = unknown
    confidence: Array  # (H, W) float32 in [0, 1), 0 where depth is unknown; see `consistency.confirmed`
    intrinsics: Intrinsics  # pinhole, of the depth map's size
    noise: float = 0.0  # inverse depth by which it may be off, wherever that is more than a share of the depth


def stereo_depths(
    views: Views,
    near: float,
    far: float,
    median_depth: float,
    *,
    long_side: int = LONG_SIDE,
    required: Demands | None = None,
    progress: Progress = SILENT,
) -> list[StereoDepth]:
    """One depth map for each of `views`, all of which are matched with each other (leave held-out views out before).

    Args:
        near, far: nearest and farthest depth that is looked for, working units.
        median_depth: depth at which parallax and overlap of images are judged.
        long_side: size of the depth maps; larger images are shrunk for matching.
        required: of neighbours; None: as `demands` has it.

    Raises:
        InputError: fewer than two views, no two of them that see the same from different places, a range that is none, or too little
            memory.
        Interrupted: the user asked to stop.
    """
    if len(views) < 2:
        raise InputError(f"depth from matching needs at least two images with poses, here is {len(views)}; give more images")
    if not (np.isfinite([near, far]).all() and 0 < near < far):
        raise InputError(f"depth between {near:g} and {far:g} cannot be looked for; check the poses of the capture")
    cameras = [shrunk_camera(camera, long_side) for camera in views.intrinsics]
    poses = np.asarray(views.world_from_camera, dtype=np.float64)
    grey = [grey_view(*each) for each in zip(views.images, cameras, poses, strict=True)]
    required = required or demands(len(views))
    neighbours = usable_neighbours(poses, cameras, median_depth, max(MATCHED, CHECKED), required)
    if not any(neighbours):
        raise InputError(
            "no two images see the same things from places far enough apart to match them for depth; the camera has to move sideways"
        )
    def raw(index: int) -> tuple[Array, float]:
        progress.check()
        if not neighbours[index]:
            return np.zeros(grey[index].grey.shape, np.float32), 0.0
        depth, noise = _matched(grey[index], [grey[other] for other in neighbours[index][:MATCHED]], near, far)
        usable = usable_pixels(views, index, cameras[index])
        return depth if usable is None else np.where(usable, depth, np.float32(0)), noise

    def checked(index: int) -> StereoDepth:
        progress.check()
        known = [other for other in neighbours[index] if neighbours[other]]
        needed = min(required.confirm, max(1, len(known)))
        depth, confidence = confirmed(index, known, DepthMaps(maps, cameras, poses), needed, noises[index])
        return StereoDepth(depth, confidence, cameras[index], noises[index])

    count, each = len(views), COSTS_HELD * PLANES[1] * 4 * max(camera.width * camera.height for camera in cameras)
    what = f"matching images of {long_side} pixels for depth"
    workers = memory.workers(_workers(), each, what, "close other programs")
    maps: list[Array] = []
    noises: list[float] = []
    for depth, noise in side_by_side(raw, count, workers):
        maps.append(depth)
        noises.append(noise)
        progress.update(len(maps), 1.1 * count, "images matched")
    out = list(side_by_side(checked, count, workers))
    progress.update(1.1 * count, 1.1 * count, "depths checked")
    return out


def demands(images: int) -> Demands:
    """What the neighbours of so many images must meet."""
    return STRICT if images >= MANY else LENIENT


def usable_neighbours(
    world_from_camera: Array, cameras: Sequence[Intrinsics], median_depth: float, count: int, required: Demands | None = None
) -> list[list[int]]:
    """For each view the neighbours that suit matching, best first, without views that see too little in common or from one place."""
    shares = overlap(world_from_camera, cameras, median_depth)
    angles = np.maximum(parallax(world_from_camera, median_depth), spread_parallax(world_from_camera, cameras, median_depth))
    best = best_neighbours(world_from_camera, shares, angles, count, SWEET)
    required = required or demands(len(cameras))
    fits = (np.minimum(shares, shares.T) >= required.overlap) & (angles >= required.parallax[0]) & (angles <= required.parallax[1])
    return [[int(other) for other in row if fits[index, other]] for index, row in enumerate(best)]


def inverse_depths(view: GreyView, others: Sequence[GreyView], near: float, far: float) -> Array:
    """(D,) inverse depths of the planes, even, about `STEP` apart."""
    width, height = view.camera.width, view.camera.height
    spots = np.array([[u * width, v * height, 1] for u in (0.1, 0.5, 0.9) for v in (0.1, 0.5, 0.9)]).T  # (3, 9)
    moves = [1.0]
    for other in others:
        at_far, at_near = (plane_homography(view, other, 1 / depth) @ spots for depth in (far, near))
        front = (at_far[2] > 0) & (at_near[2] > 0)
        gap = np.linalg.norm(at_far[:2, front] / at_far[2, front] - at_near[:2, front] / at_near[2, front], axis=0)
        moves.append(float(np.median(gap)) if len(gap) else 0.0)
    return np.linspace(1 / far, 1 / near, int(np.clip(np.ceil(max(moves) / STEP) + 1, *PLANES)))


def _workers() -> int:
    return max(1, min(MOST_WORKERS, cv2.getNumThreads()))


def side_by_side(of: Callable[[int], T], count: int, workers: int | None = None) -> Iterator[T]:
    """`of` of each number below `count`, in order, several at once on threads; it has to let other threads go on."""
    return in_order(of, range(count), workers or _workers())


def shrunk_camera(camera: Intrinsics, long_side: int) -> Intrinsics:
    """The pinhole camera whose image is `long_side` pixels long at most."""
    factor = min(1.0, long_side / max(camera.width, camera.height))
    return camera.pinhole().scaled(max(1, round(camera.width * factor)), max(1, round(camera.height * factor)))


def usable_pixels(views: Views, index: int, camera: Intrinsics) -> Array | None:
    """(H, W) bool pixels of a depth map where a view has something to see, None: all."""
    usable = views.valid[index] if views.valid else None
    if views.alpha and (alpha := views.alpha[index]) is not None:
        usable = alpha >= 128 if usable is None else usable & (alpha >= 128)
    return None if usable is None else resized(usable.astype(np.uint8), camera) > 0


def resized(values: Array, camera: Intrinsics) -> Array:
    """(H, W) at a camera's size, each the nearest of them: depth is never averaged, nor are masks."""
    if values.shape == (camera.height, camera.width):
        return values
    return np.asarray(cv2.resize(values, (camera.width, camera.height), interpolation=cv2.INTER_NEAREST))


def _matched(view: GreyView, others: Sequence[GreyView], near: float, far: float) -> tuple[Array, float]:
    """(H, W) float32 depth of one view from matching alone, 0 where nothing was recognised, and its noise, an inverse depth."""
    planes = inverse_depths(view, others, near, far)
    step = float(planes[1] - planes[0])
    plane = smoothed_planes(Matcher(view, others).volume(planes), view.grey)
    inverse, cost = refined(view, others, planes[0] + plane * step, step)
    depth = np.where(cost <= MOST_COST, 1 / np.clip(inverse, 1 / far, 1 / near), 0)
    return depth.astype(np.float32), NOISE * step
