"""Where the depth camera stands beside the camera of the pictures, by points that pictures share and whose depth the sensor tells.

Least is Σ min(|r|, c) over all observations (r: `depth_maps`), by Gauss-Newton's method with weights 1/|r|; with a scale, so that poses
which are a little too large or small do not pass for an offset. A depth map has steps and noise, so its slopes are taken over several
pixels, fewer as c falls. Half of the points judges what fits the other half.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from fieldfuse.camera import Array
from fieldfuse.capture.types import Capture
from fieldfuse.effects.adjust import Problem, predict, residuals, uncertainty
from fieldfuse.effects.depth_maps import DepthMaps, read
from fieldfuse.progress import SILENT, Progress

DEPTH_OFFSET = "depth_offset"
MARGIN = 0.12  # least relative fall of what held-out points are off …
MIN_FALL = 0.0005  # … and least fall, as a share of depth
MAPS = 120  # depth maps that are looked at
FEWEST, MAX_OBSERVATIONS = 300, 6000  # observations
FOLDS = 2  # each of which is judged by what fits the others
MEETS = 2.0  # times the median distance between where a point is seen and where it should be: what is off by more is no point
SURE = 0.005  # share of its depth within which rays must meet
STAGES = ((0.2, 0.012), (0.1, 0.006), (0.06, 0.003))  # c; radians and shares of the usual depth that slopes are taken over
STEPS = 30  # for each of them
NOTHING = 0.003  # share of depth: residuals below this weigh the same
BELIEF = 0.05  # radians, and shares of the usual depth: how far off the depth camera may be
ALL, SCALE = np.arange(7), np.array([6])
EXACT = 1e-6  # share of depth: nothing is told more surely, so that a wall seen straight on, exactly, moves nothing
SLACK = 1e-3  # relative fall below which a stage is done


@dataclass(frozen=True)
class Registration:
    """Where the depth camera stands, and how well held-out points fit it."""

    depth_from_picture: Array  # (4, 4), units of the poses
    before: float  # what held-out points are off in the mean, share of depth, both cameras at one place
    after: float
    observations: int

    @property
    def gain(self) -> float:
        return 1 - self.after / self.before if self.before > 0 else 0.0

    @property
    def there(self) -> bool:
        return self.gain > MARGIN and self.before - self.after > MIN_FALL

    @property
    def reason(self) -> str:
        move = self.depth_from_picture[:3, 3]
        turn = np.degrees(np.linalg.norm(cv2.Rodrigues(self.depth_from_picture[:3, :3])[0]))
        return (
            f"points that pictures share are {100 * self.before:.2f}% of their depth off the sensor's, {100 * self.after:.2f}% with a "
            f"depth camera that stands {np.linalg.norm(move):.3g} units beside the pictures' and is turned by {turn:.2f}°"
        )


@dataclass(frozen=True)
class Observations:
    """Points in the axes of the cameras of pictures, and the depth maps beside these."""

    places: Array  # (N, 3)
    point: Array  # (N,) int which points they are
    map: Array  # (N,) int which map is theirs
    maps: DepthMaps

    def some(self, which: Array) -> Observations:
        return Observations(self.places[which], self.point[which], self.map[which], self.maps)

    def off(self, depth_from_picture: Array, scale: float) -> Array:
        """(N,) r; NaN: the four pixels around are not all known, or not of one surface."""
        return self.maps.off(self.places, self.map, depth_from_picture, scale)


def register(capture: Capture, indices: Sequence[int], problem: Problem, progress: Progress = SILENT) -> Registration | None:
    """Where the depth camera of `capture` stands; None: too few points have depth.

    Args:
        indices: which frames of the capture those of the problem are.

    Raises:
        InputError: a depth map cannot be read.
    """
    found = observed(capture, indices, problem, progress)
    return None if found is None else solved(found)


def observed(capture: Capture, indices: Sequence[int], problem: Problem, progress: Progress = SILENT) -> Observations | None:
    """The points of the problem that are sure, in up to `MAPS` pictures with depth; None: too few.

    Raises:
        InputError: a depth map cannot be read.
    """
    chosen = deep_frames(capture, indices, problem)
    use = sure(problem) & np.isin(problem.frame, chosen)
    if use.sum() < FEWEST:
        return None
    maps = read(capture, [indices[number] for number in chosen], progress)
    return Observations(predict(problem)[0][use], problem.point[use], np.searchsorted(chosen, problem.frame[use]), maps)


def deep_frames(capture: Capture, indices: Sequence[int], problem: Problem, most: int = MAPS) -> list[int]:
    """Up to `most` frames of the problem that have depth and show points, evenly spread, ascending."""
    deep = [number for number, index in enumerate(indices) if capture.frames[index].depth is not None and (problem.frame == number).any()]
    return [deep[k] for k in np.unique(np.linspace(0, len(deep) - 1, min(most, len(deep))).round().astype(int))] if deep else []


def sure(problem: Problem) -> Array:
    """(O,) bool: observations of points that are where they should be, and whose rays meet within `SURE` of their depth."""
    if not len(problem.frame):
        return np.zeros(0, dtype=bool)
    depth, off = predict(problem)[0][:, 2], np.linalg.norm(residuals(problem), axis=1)
    return np.asarray((off < MEETS * np.median(off)) & (depth > 0) & (uncertainty(problem) < SURE * np.maximum(depth, 0)))


def solved(found: Observations) -> Registration | None:
    """The offset by all observations; None: too few of these have depth."""
    usual = float(np.median(found.places[:, 2]))
    known = found.some(np.flatnonzero(np.isfinite(found.off(np.eye(4), 1.0))))
    fold = known.point % FOLDS
    if min(np.bincount(fold, minlength=FOLDS)) < FEWEST / FOLDS:
        return None
    alone, together = [], []  # of held-out observations, with both cameras at one place and each where it stands
    for held in range(FOLDS):
        fit, judge = known.some(np.flatnonzero(fold != held)), known.some(np.flatnonzero(fold == held))
        before, after = (_off(judge, _fitted(fit, usual, free), usual) for free in (SCALE, ALL))
        both = np.isfinite(before) & np.isfinite(after)
        alone.append(np.abs(before[both]))
        together.append(np.abs(after[both]))
    values = [float(np.minimum(np.concatenate(off), STAGES[-1][0]).mean()) if sum(map(len, off)) else 0.0 for off in (alone, together)]
    return Registration(_pose(_fitted(known, usual, ALL), usual), values[0], values[1], len(known.point))


def quickly(found: Observations) -> Array:
    """(4, 4) the offset, judged by the observations that it is fitted to; none where it is not there, or too few have depth."""
    known = found.some(np.flatnonzero(np.isfinite(found.off(np.eye(4), 1.0))))
    if len(known.point) < FEWEST:
        return np.eye(4)
    usual = float(np.median(known.places[:, 2]))
    scale, offset = (_fitted(known, usual, free) for free in (SCALE, ALL))
    off = np.abs([_off(known, scale, usual), _off(known, offset, usual)])
    off = np.minimum(off[:, np.isfinite(off).all(axis=0)], STAGES[-1][0])
    if not off.size:
        return np.eye(4)
    judged = Registration(_pose(offset, usual), float(off[0].mean()), float(off[1].mean()), off.shape[1])
    return judged.depth_from_picture if judged.there else np.eye(4)


def _fitted(found: Observations, usual: float, free: Array) -> Array:
    """(7,) a turn, a move in usual depths, the logarithm of the scale; 0 but for those `free`."""
    some = found.some(np.linspace(0, len(found.point) - 1, min(MAX_OBSERVATIONS, len(found.point))).astype(int))
    x = np.zeros(7)
    for cut, over in STAGES:
        x = _descend(some, x, usual, cut, over, free)
    return x


def _pose(x: Array, usual: float) -> Array:
    out = np.eye(4)
    out[:3, :3] = cv2.Rodrigues(x[:3].astype(np.float64))[0]
    out[:3, 3] = x[3:6] * usual
    return out


def _off(found: Observations, x: Array, usual: float) -> Array:
    """(N,) r; x: a turn, a move in usual depths, the logarithm of the scale."""
    return found.off(_pose(x, usual), float(np.exp(x[6])))


def _descend(found: Observations, x: Array, usual: float, cut: float, over: float, free: Array) -> Array:
    """From `x` on downhill in the numbers `free`."""
    off, damping = _off(found, x, usual), 1e-3
    for _ in range(STEPS):
        slopes = []
        for k in free:
            aside = over * (np.arange(7) == k)
            slopes.append((_off(found, x + aside, usual) - _off(found, x - aside, usual)) / (2 * over))
        slope = np.stack(slopes, axis=1)
        use = np.isfinite(off) & (np.abs(off) < cut) & np.isfinite(slope).all(axis=1)
        if use.sum() < FEWEST // 4:
            return x
        heavy = slope[use] / np.maximum(np.abs(off[use]), NOTHING)[:, None]
        hold = max(float(np.median(np.abs(off[use]))), EXACT) / BELIEF**2
        normal, downhill = heavy.T @ slope[use] + hold * np.eye(len(free)), heavy.T @ off[use] + hold * x[free]
        for _ in range(6):
            moved = x.copy()
            moved[free] -= np.linalg.solve(normal + damping * np.diag(np.diag(normal)), downhill)
            new = _off(found, moved, usual)
            both = np.isfinite(off) & np.isfinite(new)
            was, value = (float(np.minimum(np.abs(one[both]), cut).mean()) for one in (off, new))
            if value < was:
                break
            damping *= 10
        else:
            return x
        x, off, damping = moved, new, max(damping / 10, 1e-6)
        if was - value < SLACK * was:
            break
    return x
