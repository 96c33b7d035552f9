"""Depth of what is bare: where matching found nothing to compare, the planes of what stands beside it go on.

Floors, walls and doors have nothing that could be recognised but at their edges, and where no depth is known a fit puts things that hang in
the air. Steps: the planes of the scene (`planes.py`); in each picture, pixels with a depth vote for their plane, along the picture and not
across its edges (Gastal and Oliveira 2011); a depth is kept when other pictures have the same point, and colours as alike there as those of
what was matched.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import cv2
import numba
import numpy as np

from toolkit.camera import Array, Intrinsics, invert
from toolkit.capture.types import Views
from toolkit.progress import SILENT, Progress
from toolkit.stereo.check import agreement, numbers, seen_at
from toolkit.stereo.match import CHECKED, MOST_WORKERS, StereoDepth, usable_neighbours, usable_pixels
from toolkit.stereo.planes import Points, find_planes

POINTS = 60_000  # that planes are looked for in, of all pictures together
ON = 0.03  # share of its depth by which a pixel may miss the plane that it votes for
SLANT = 80.0  # degrees beyond which a plane tells no depth: a small error of it is a large one of the depth
AWAY = 0.5  # of the picture's long side: how far votes go where nothing stands in their way …
EDGE = 30.0  # … and the step of colour, in levels, that is as much in their way as that
LEAST_VOTES = 1e-6
MAJORITY = 0.6  # share of the votes
CONFIRMED = 2  # pictures that must have the same point
ALIKE = 0.9  # quantile of the differences of colour of what was matched: what is more different is not kept
PASSES = 3  # of the filter that spreads votes
BLUR = (0.7, 1.0)  # pixels, before votes and before colours are compared


@dataclass(frozen=True)
class _Proposed:
    depth: Array  # (H, W) float32 as matched, and where a plane goes on
    new: Array  # (H, W) bool where a plane goes on


def continued(found: Sequence[StereoDepth], views: Views, median_depth: float, progress: Progress = SILENT) -> list[StereoDepth]:
    """What matching `found` of `views`, and depth beside it where a plane goes on.

    Args:
        found: `match.stereo_depths` of the views, in their order.
        median_depth: what parallax and overlap of pictures are judged at.

    Returns:
        depths as matched where there were any; others confident as what `check.confirmed` keeps.

    Raises:
        Interrupted: the user asked to stop.
    """
    poses = np.asarray(views.world_from_camera, dtype=np.float64)
    cameras = [one.intrinsics for one in found]
    planes = find_planes(_points(found, poses))
    neighbours = usable_neighbours(poses, cameras, median_depth, CHECKED) if len(found) > 1 else [[]]
    if not len(planes) or not any(neighbours):
        return list(found)
    others = [[other for other in row if neighbours[other]] for row in neighbours]
    small = [_shrunk(picture, camera) for picture, camera in zip(views.images, cameras, strict=True)]
    soft = [cv2.GaussianBlur(picture, (0, 0), BLUR[1]) for picture in small]

    def proposal(index: int) -> _Proposed:
        progress.check()
        return _proposal(found[index], small[index], poses[index], planes, usable_pixels(views, index, cameras[index]))

    def difference(index: int) -> Array:
        progress.check()
        return _differences(index, others[index], depths, soft, cameras, poses)

    def checked(index: int) -> StereoDepth:
        progress.check()
        one, plan = found[index], proposed[index]
        agree, through, _ = agreement(index, others[index], depths, cameras, poses)
        kept = plan.new & (agree >= min(CONFIRMED, len(others[index]))) & (agree > through) & (differences[index] <= limit)
        confidence = np.where(kept, agree / (agree + through + 1), one.confidence).astype(np.float32)
        return replace(one, depth=np.where(kept, plan.depth, one.depth), confidence=confidence)

    every = range(len(found))
    with ThreadPoolExecutor(max(1, min(MOST_WORKERS, cv2.getNumThreads()))) as pool:
        try:
            proposed = list(pool.map(proposal, every))
            depths = [one.depth for one in proposed]
            differences = list(pool.map(difference, every))
            matched = [values[one.depth > 0] for values, one in zip(differences, found, strict=True)]
            limit = _quantile(np.concatenate(matched), ALIKE)
            return list(pool.map(checked, every))
        finally:
            pool.shutdown(cancel_futures=True)


def _points(found: Sequence[StereoDepth], poses: Array) -> Points:
    """Even shares of all pictures, each at random places."""
    generator = np.random.default_rng(0)
    most = max(1, POINTS // max(len(found), 1))
    places, depths, views, pixels = [np.zeros((0, 3))], [np.zeros(0)], [np.zeros(0, np.int64)], [np.zeros((0, 2))]
    for index, (one, pose) in enumerate(zip(found, poses, strict=True)):
        rows, columns = np.nonzero(one.depth > 0)
        some = generator.permutation(len(rows))[:most]
        x, y, depth = columns[some] + 0.5, rows[some] + 0.5, one.depth[rows[some], columns[some]].astype(np.float64)
        camera = one.intrinsics
        local = np.column_stack([(x - camera.cx) / camera.fx * depth, (y - camera.cy) / camera.fy * depth, depth])
        places.append(local @ pose[:3, :3].T + pose[:3, 3])
        depths.append(depth)
        views.append(np.full(len(some), index))
        pixels.append(np.column_stack([x, y]) / max(one.depth.shape))
    return Points(np.concatenate(places), np.concatenate(depths), np.concatenate(views), np.concatenate(pixels))


def _shrunk(picture: Array, camera: Intrinsics) -> Array:
    if picture.shape[:2] != (camera.height, camera.width):
        picture = cv2.resize(picture, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(picture)


def _proposal(one: StereoDepth, picture: Array, pose: Array, planes: Array, usable: Array | None) -> _Proposed:
    """Where the pixels that have a depth, by their votes, let one of the planes go on."""
    numbers_ = numbers(one.intrinsics)
    normals = planes[:, :3] @ pose[:3, :3]
    local = np.column_stack([normals, planes[:, 3] - planes[:, :3] @ pose[:3, 3]])  # the planes in the camera's frame
    voter = np.empty(one.depth.shape, np.int32)
    slant = float(np.cos(np.deg2rad(SLANT)))
    _voters(one.depth, numbers_, local, ON, slant, voter)
    guide = cv2.GaussianBlur(picture, (0, 0), BLUR[0])
    present = [plane for plane in np.unique(voter) if plane >= 0]  # len(planes): those that lie on none
    if not present:
        return _Proposed(one.depth, np.zeros(one.depth.shape, bool))
    votes = np.stack([voter == plane for plane in present], axis=2).astype(np.float32)
    spread_along(guide, votes, AWAY * max(one.depth.shape), EDGE)
    total, first = votes.sum(axis=2), votes.argmax(axis=2)
    winner = np.array(present, np.int32)[first]
    open_ = (one.depth <= 0) & (total > LEAST_VOTES) & (votes.max(axis=2) > MAJORITY * total) & (winner < len(planes))
    if usable is not None:
        open_ &= usable
    depth = one.depth.copy()
    _go_on(numbers_, local, slant, np.where(open_, winner, np.int32(-1)), depth)
    return _Proposed(depth, open_ & (depth > 0))


def spread_along(guide: Array, values: Array, away: float, edge: float) -> None:
    """Let `values` (H, W, K) float32 spread along the picture `guide` (H, W, 3) uint8, in place: the domain transform's recursive filter.

    Args:
        away: standard deviation in pixels where the picture is even.
        edge: a step of colour, in levels summed over the channels, that is as much in the way as `away` pixels.
    """
    picture = guide.astype(np.float32)
    across, down = (1 + away / edge * np.abs(np.diff(picture, axis=axis)).sum(axis=2) for axis in (1, 0))
    for number in range(PASSES):
        reach = away * np.sqrt(3) * 2 ** (PASSES - 1 - number) / np.sqrt(4**PASSES - 1)
        keep = np.exp(-np.sqrt(2) / reach)
        _pass_on(values, (keep**across).astype(np.float32))
        _pass_on(values.transpose(1, 0, 2), (keep**down).astype(np.float32).T)


@numba.njit(cache=True, nogil=True)
def _pass_on(values: Array, keep: Array) -> None:
    """Along each row, there and back, every value becomes (1 − keep) of itself and keep[·, x] of the one before it."""
    for v in range(values.shape[0]):
        for x in range(1, values.shape[1]):
            share = keep[v, x - 1]
            for k in range(values.shape[2]):
                values[v, x, k] += share * (values[v, x - 1, k] - values[v, x, k])
        for x in range(values.shape[1] - 2, -1, -1):
            share = keep[v, x]
            for k in range(values.shape[2]):
                values[v, x, k] += share * (values[v, x + 1, k] - values[v, x, k])


@numba.njit(cache=True, nogil=True)
def _inverse_on(planes: Array, which: int, x: float, y: float, slant: float) -> float:
    """Inverse depth of the plane `which` on the ray (x, y, 1), 0: behind the camera, or too much aslant."""
    along = planes[which, 0] * x + planes[which, 1] * y + planes[which, 2]
    offset = planes[which, 3]
    if along * offset <= 0 or abs(along) <= slant * np.sqrt(x * x + y * y + 1):
        return 0.0
    return float(along / offset)


@numba.njit(cache=True, nogil=True)
def _voters(depth: Array, camera: Array, planes: Array, on: float, slant: float, voter: Array) -> None:
    """The first of the planes (in the camera's frame) that each pixel lies on; len(planes): none, −1: no depth."""
    fx, fy, cx, cy = camera
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            voter[v, u] = -1
            z = depth[v, u]
            if z <= 0:
                continue
            voter[v, u] = len(planes)
            for plane in range(len(planes)):
                inverse = _inverse_on(planes, plane, (u + 0.5 - cx) / fx, (v + 0.5 - cy) / fy, slant)
                if inverse > 0 and abs(inverse * z - 1) < on:
                    voter[v, u] = plane
                    break


@numba.njit(cache=True, nogil=True)
def _go_on(camera: Array, planes: Array, slant: float, winner: Array, depth: Array) -> None:
    """The depth of plane winner[v, u] where that is one, and stands before the camera."""
    fx, fy, cx, cy = camera
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            if winner[v, u] >= 0:
                inverse = _inverse_on(planes, winner[v, u], (u + 0.5 - cx) / fx, (v + 0.5 - cy) / fy, slant)
                if inverse > 0:
                    depth[v, u] = 1 / inverse


def _differences(
    index: int, others: Sequence[int], depths: Sequence[Array], pictures: Sequence[Array], cameras: Sequence[Intrinsics], poses: Array
) -> Array:
    """(H, W) float16 median over `others` of how much their colours differ from this picture's, in levels; NaN: none sees the point."""
    each = np.full((max(1, len(others)), *depths[index].shape), np.nan, np.float32)
    for place, other in enumerate(others):
        there = invert(poses[other]) @ poses[index]
        here, away = (depths[index], pictures[index], numbers(cameras[index])), (depths[other], pictures[other], numbers(cameras[other]))
        _differ(*here, *away, there, each[place])
    # np.nanmedian, which warns of pixels that none sees and takes ten times as long
    each.sort(axis=0)
    count = np.isfinite(each).sum(axis=0)
    low, high = (np.take_along_axis(each, np.clip(at, 0, len(each) - 1)[None], axis=0)[0] for at in ((count - 1) // 2, count // 2))
    return np.asarray((low + high) / 2, dtype=np.float16)


@numba.njit(cache=True, nogil=True)
def _differ(
    depth: Array, picture: Array, camera: Array, other: Array, other_picture: Array, other_camera: Array, there: Array, out: Array
) -> None:
    """Mean difference of the three colours of what one other view shows where each pixel's point is, unless something stands before it."""
    rows, columns = other.shape
    for y in range(depth.shape[0]):
        for x in range(depth.shape[1]):
            z = depth[y, x]
            if z <= 0:
                continue
            u, v, qz = seen_at(x, y, z, camera, there, other_camera)
            if qz <= 0 or not (0 <= u < columns and 0 <= v < rows):
                continue
            column, row = int(u), int(v)
            seen = other[row, column]
            if seen > 0 and seen < (1 - ON) * qz:
                continue
            total = 0.0
            for channel in range(3):
                total += abs(float(picture[y, x, channel]) - float(other_picture[row, column, channel]))
            out[y, x] = total / 3


def _quantile(values: Array, share: float) -> float:
    values = values[np.isfinite(values)]
    return float(np.quantile(values.astype(np.float32), share)) if len(values) else 0.0
