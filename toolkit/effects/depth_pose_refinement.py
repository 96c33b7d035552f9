"""Refined poses that agree with a sensor's depth: where images hardly separate a turn from a move, nor the scale, depth does.

    least Σ ρ(q̂ − q) + Σ ρ(w·(ẑ / z − 1)) + belief,    w = scatter of places / scatter of depths

q: where points are seen; z: their depth as the sensor measures it (`adjust.Problem.depth`), with its camera where points place it
(`depth_camera`); w follows from what both leave, so that a coarse sensor counts little. Poses, points and the sensor's camera are found in
turns. Two things judge: what one depth map sees has to be where others see it, better than before; and where points are seen must not
be explained worse by the cameras.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fieldfuse.camera import Array, invert
from fieldfuse.capture.types import Capture
from fieldfuse.effects.adjust import LENS, Belief, Problem, adjust, predict, residuals, scatter
from fieldfuse.effects.correct import Corrections, correctable
from fieldfuse.effects.depth_camera import FEWEST, DepthMaps, Observations, deep_frames, register_quickly, sure
from fieldfuse.progress import SILENT, Progress

MAPS = 300  # depth maps that take part
ROUNDS = 3  # of which the best that passes is taken
STEPS = 60
MARGIN = 0.01  # least relative fall of what depth maps are off each other
SAME = 0.02  # share of depth that they may be off each other; beyond, they are not of one scene, or noise
WORSE = 0.03  # relative growth of what places are off that is nothing
PARTNERS = 6  # maps that each is held against, of those with the most points in common
COMMON = 12  # points without which they are none
ACROSS = 16  # pixels of a map along its long side that are compared
UNITS = 0.1  # a scale further from 1 than by this is another unit of length, or no depth of this scene
WRONG = 0.06  # share of depth off by which it is that of something else
CUT = 0.03  # share of depth beyond which being off counts no more
SHARP = 0.005  # share of depth: no sensor is believed to be better


@dataclass(frozen=True)
class DepthRefined:
    """Poses, points and what else was unknown where depth agrees, too."""

    problem: Problem
    belief: Belief  # at the sensor's scale
    before: float  # what depth maps are off each other without it, share of depth
    after: float

    @property
    def note(self) -> str:
        return (
            f"held to the sensor's depth, too: its maps are {100 * self.after:.2f}% of depth off each other, "
            f"{100 * self.before:.2f}% by pictures alone"
        )


def refine_by_depth(
    capture: Capture, problem: Problem, unknown: frozenset[str], belief: Belief, progress: Progress = SILENT
) -> DepthRefined | None:
    """The problem where depth takes part; None: there is too little depth, or it does not agree with the images.

    Args:
        capture: whose frames are those of the problem, in their order.
        problem: refined by images alone. belief: where its poses were taken to be.

    Raises:
        InputError: a depth map cannot be read.
    """
    frames = deep_frames(capture, range(len(capture.frames)), problem, MAPS)
    if not frames:
        return None
    if LENS in unknown and all(frame.intrinsics is None or correctable(frame.intrinsics) for frame in capture.frames):
        capture = Corrections(lens=problem.lens).on_capture(capture)  # where depth shares the camera of the images, its lens is theirs
    sensor = _Sensor(np.asarray(frames), DepthMaps.read(capture, frames, progress))
    start = sensor.standing(problem)
    ratio = sensor.depth(problem, start) / predict(problem)[0][:, 2]
    if np.isfinite(ratio).sum() < FEWEST or abs(float(np.nanmedian(ratio)) - 1) > UNITS:
        return None
    moved, held_to = scaled(problem, belief, float(np.nanmedian(ratio)))
    pairs = sensor.pairs(problem)
    was, most = sensor.apart(pairs, problem, start), (1 + WORSE) * adjust(problem).scatter
    best, standing = None, start
    for _ in range(ROUNDS):
        progress.check()
        measured = sensor.measured(moved, standing)
        if measured is None:
            break
        moved = replace(adjust(measured, unknown, STEPS, held_to).problem, depth=None)
        standing = sensor.standing(moved)
        now = sensor.apart(pairs, moved, standing)
        both = np.isfinite(was) & np.isfinite(now)
        if not both.any():
            break
        before, after = (float(np.minimum(np.abs(off[both]), CUT).mean()) for off in (was, now))
        least = min(SAME, (1 - MARGIN) * before if best is None else best.after / best.before * before)
        if after < least and adjust(moved).scatter < most:
            best = DepthRefined(moved, held_to, before, after)
    return best


@dataclass(frozen=True)
class _Sensor:
    """The depth maps of some frames of a problem. `standing`: (4, 4) its camera from the images'."""

    frames: Array
    maps: DepthMaps

    def depth(self, problem: Problem, standing: Array) -> Array:
        """(O,) what the sensor measures on the way to each point, z in the image's camera; NaN: nothing."""
        out = np.full(len(problem.frame), np.nan)
        places = predict(problem)[0]
        mine = np.isin(problem.frame, self.frames) & (places[:, 2] > 0)
        out[mine] = self.maps.along(places[mine], np.searchsorted(self.frames, problem.frame[mine]), standing)
        return out

    def measured(self, problem: Problem, standing: Array) -> Problem | None:
        """The problem with the sensor's depth, weighed by what both leave; None: there is none."""
        depth = self.depth(problem, standing)
        off = np.abs(predict(problem)[0][:, 2] / depth - 1)
        right = off < WRONG
        if not right.any():
            return None
        noise = max(float(np.median(off[right])) / 0.6745, SHARP)
        return replace(problem, depth=np.where(right, depth, np.nan), depth_weight=scatter(residuals(problem)) / noise)

    def standing(self, problem: Problem) -> Array:
        """(4, 4) where its camera stands, if that can be found, else where the images' does."""
        use = sure(problem) & np.isin(problem.frame, self.frames)
        if use.sum() < FEWEST:
            return np.eye(4)
        which = np.searchsorted(self.frames, problem.frame[use])
        return register_quickly(Observations(predict(problem)[0][use], problem.point[use], which, self.maps))

    def pairs(self, problem: Problem) -> list[tuple[int, int]]:
        """Maps (numbers of `frames`) that see the same, by the points that their frames share."""
        seen = np.zeros((len(self.frames), len(problem.points)), dtype=np.float32)
        mine = np.isin(problem.frame, self.frames)
        seen[np.searchsorted(self.frames, problem.frame[mine]), problem.point[mine]] = 1
        shared = seen @ seen.T
        np.fill_diagonal(shared, 0)
        best = np.argsort(-shared, axis=1, kind="stable")[:, :PARTNERS]
        return [(one, int(other)) for one, row in enumerate(best) for other in row if shared[one, other] >= COMMON]

    def apart(self, pairs: Sequence[tuple[int, int]], problem: Problem, standing: Array) -> Array:
        """(N,) what the first of each pair sees is off the second's depth, shares of depth, always of the same pixels; NaN: unknown."""
        poses = problem.poses @ invert(standing)
        seen = {one: self.maps.surface(one, ACROSS) for one, _ in pairs}
        off = [np.zeros(0)]
        for one, other in pairs:
            to_other = invert(poses[self.frames[other]]) @ poses[self.frames[one]]
            places = seen[one] @ to_other[:3, :3].T + to_other[:3, 3]
            off.append(self.maps.off(places, np.full(len(places), other), np.eye(4)))
        return np.concatenate(off)


def scaled(problem: Problem, belief: Belief, scale: float) -> tuple[Problem, Belief]:
    """Cameras and points, and where cameras are believed to be, grown about the cameras' middle."""
    middle = problem.poses[:, :3, 3].mean(axis=0)

    def grown(poses: Array) -> Array:
        out = poses.copy()
        out[:, :3, 3] = middle + scale * (poses[:, :3, 3] - middle)
        return out

    points = middle + scale * (problem.points - middle)
    motion = problem.motion * np.array([1, 1, 1, scale, scale, scale])
    return replace(problem, poses=grown(problem.poses), points=points, motion=motion), replace(belief, poses=grown(belief.poses))
