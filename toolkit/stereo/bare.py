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

from fieldfuse.camera import Array
from fieldfuse.capture.types import Views
from fieldfuse.progress import SILENT, Progress
from fieldfuse.stereo.check import agreement
from fieldfuse.stereo.cost import shrunk
from fieldfuse.stereo.match import CHECKED, MOST_WORKERS, Demands, StereoDepth, usable_neighbours, usable_pixels
from fieldfuse.stereo.plane_maps import depth_of, in_camera, numbers_of
from fieldfuse.stereo.planes import Points, find_planes

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
class Proposed:
    """A view's depth, and where planes go on in it."""

    depth: Array  # (H, W) float32 as matched, and where a plane goes on
    new: Array  # (H, W) bool where a plane goes on


def continued(
    found: Sequence[StereoDepth], views: Views, median_depth: float, progress: Progress = SILENT, asked: Demands | None = None
) -> list[StereoDepth]:
    """What matching `found` of `views`, and depth beside it where a plane goes on.

    Args:
        found: `match.stereo_depths` of the views, in their order.
        median_depth: what parallax and overlap of pictures are judged at.
        asked: of the neighbours that confirm a plane; None: as `match.demands` has it.

    Returns:
        depths as matched where there were any; others confident as what `check.confirmed` keeps.

    Raises:
        Interrupted: the user asked to stop.
    """
    poses = np.asarray(views.world_from_camera, dtype=np.float64)
    cameras = [one.intrinsics for one in found]
    planes = find_planes(points_of(found, poses))
    neighbours = usable_neighbours(poses, cameras, median_depth, CHECKED, asked) if len(found) > 1 else [[]]
    if not len(planes) or not any(neighbours):
        return list(found)
    others = [[other for other in row if neighbours[other]] for row in neighbours]
    small = [shrunk(picture, camera) for picture, camera in zip(views.images, cameras, strict=True)]
    soft = [cv2.GaussianBlur(picture, (0, 0), BLUR[1]) for picture in small]

    def proposed_for(index: int) -> Proposed:
        progress.check()
        return proposal(found[index], small[index], poses[index], planes, usable_pixels(views, index, cameras[index]))

    def compared(index: int) -> tuple[Array, StereoDepth]:
        progress.check()
        one, plan = found[index], proposed[index]
        said = agreement(index, others[index], depths, cameras, poses, noise=one.noise, pictures=soft)
        sure = plan.new & (said.agree >= min(CONFIRMED, len(others[index]))) & (said.agree > said.through)
        confidence = np.where(sure, said.agree / (said.agree + said.through + 1), one.confidence).astype(np.float32)
        return _middle(said.colours), replace(one, depth=np.where(sure, plan.depth, one.depth), confidence=confidence)

    with ThreadPoolExecutor(max(1, min(MOST_WORKERS, cv2.getNumThreads()))) as pool:
        try:
            proposed = list(pool.map(proposed_for, range(len(found))))
            depths = [one.depth for one in proposed]
            differences, sure = zip(*pool.map(compared, range(len(found))), strict=True)
        finally:
            pool.shutdown(cancel_futures=True)
    limit = _quantile(np.concatenate([values[one.depth > 0] for values, one in zip(differences, found, strict=True)]), ALIKE)
    alike = [(one.depth > 0) | (values <= limit) for values, one in zip(differences, found, strict=True)]
    return [replace(one, depth=one.depth * kept, confidence=one.confidence * kept) for one, kept in zip(sure, alike, strict=True)]


def points_of(found: Sequence[StereoDepth], poses: Array) -> Points:
    """Points of depth maps, even shares of all of them, each at random places."""
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


def proposal(one: StereoDepth, picture: Array, pose: Array, planes: Array, usable: Array | None) -> Proposed:
    """Where the pixels that have a depth, by their votes, let one of the planes go on.

    Args:
        picture: (H, W, 3) uint8 of the depth map's size; votes do not go across its edges.
        pose: (4, 4) world from camera.
        planes: (K, 4) of `find_planes`.
        usable: (H, W) bool where there is something to see, None: everywhere.
    """
    local = in_camera(planes, pose)
    voter = numbers_of(one.depth, one.intrinsics, local, ON, SLANT)
    guide = cv2.GaussianBlur(picture, (0, 0), BLUR[0])
    present = [plane for plane in np.unique(voter) if plane >= 0]  # len(planes): those that lie on none
    if not present:
        return Proposed(one.depth, np.zeros(one.depth.shape, bool))
    votes = np.stack([voter == plane for plane in present], axis=2).astype(np.float32)
    spread_along(guide, votes, AWAY * max(one.depth.shape), EDGE)
    total, first = votes.sum(axis=2), votes.argmax(axis=2)
    winner = np.array(present, np.int32)[first]
    open_ = (one.depth <= 0) & (total > LEAST_VOTES) & (votes.max(axis=2) > MAJORITY * total) & (winner < len(planes))
    if usable is not None:
        open_ &= usable
    there = depth_of(np.where(open_, winner, np.int32(-1)), one.intrinsics, local, SLANT)
    return Proposed(np.where(there > 0, there, one.depth), there > 0)


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
        _pass_on(values[:, :, None], (keep**across).astype(np.float32)[:, :, None])
        _pass_on(values[None], (keep**down).astype(np.float32)[None])


@numba.njit(cache=True, nogil=True)
def _pass_on(values: Array, keep: Array) -> None:
    """Along the second axis of values (A, B, C, K), there and back, every value becomes (1 − keep) of itself and keep[·, b, ·] of the one
    before it; keep (A, B − 1, C)."""
    lines, length, beside, channels = values.shape
    for a in range(lines):
        for b in range(1, length):
            for c in range(beside):
                share = keep[a, b - 1, c]
                for k in range(channels):
                    values[a, b, c, k] += share * (values[a, b - 1, c, k] - values[a, b, c, k])
        for b in range(length - 2, -1, -1):
            for c in range(beside):
                share = keep[a, b, c]
                for k in range(channels):
                    values[a, b, c, k] += share * (values[a, b + 1, c, k] - values[a, b, c, k])


def _middle(values: Array) -> Array:
    """(H, W) float16 median of (N, H, W) float32, which it sorts, over N, without those that are NaN; NaN: all are.

    np.nanmedian takes ten times as long.
    """
    if not len(values):
        return np.full(values.shape[1:], np.nan, np.float16)
    values.sort(axis=0)
    count = np.isfinite(values).sum(axis=0)
    middles = np.maximum((count - 1) // 2, 0), np.minimum(count // 2, len(values) - 1)
    low, high = (np.take_along_axis(values, at[None], axis=0)[0] for at in middles)
    return np.asarray((low + high) / 2, dtype=np.float16)


def _quantile(values: Array, share: float) -> float:
    values = values[np.isfinite(values)]
    return float(np.quantile(values.astype(np.float32), share)) if len(values) else 0.0
