"""Poses of all frames from shared points: training frames by bundle adjustment among themselves, the others by resection on its points.

The rows' motion takes no part, whatever speaks for a rolling shutter: images are fitted as if taken at once, and frames that are only
placed have no motion of their own, so points that were found beside other frames' motion would place them wrongly.

How far a frame was corrected is held against the corrections of the cameras next to it: errors of poses (drift, a tracker's or a
calibration's) are alike from one camera to the next. Where a frame was placed badly, or goes its own way without its points saying so
clearly, it gets its neighbours' correction.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from fieldfuse.camera import Array
from fieldfuse.capture.types import Capture
from fieldfuse.effects import geometry
from fieldfuse.effects.adjust import LENS, POSES, Belief, Problem, adjust, predict, resect, residuals
from fieldfuse.effects.depth_pose_refinement import DepthRefined, refine_by_depth
from fieldfuse.effects.tracks import Tracks
from fieldfuse.progress import SILENT, Progress

STEPS, FREE_STEPS = 60, 30  # of the fit, and of one that only measures how much noise is left
FEWEST = 12  # observations without which a frame is not placed by its own points
NEIGHBOURS = 4  # cameras whose corrections predict that of another
FACTOR = 5.0  # times the usual difference to the neighbours' correction that a frame's own may have …
FLOOR = 2.0  # … or so many working pixels, if that is more
CLOSE = 3.0  # times the fit's scatter: how far off an observation may be to count as an inlier
INLIERS = 0.5  # share of a frame's observations that must be inliers
FALLBACKS = 1 / 3  # share of placed frames that may need their neighbours' correction before the whole refinement is given up


@dataclass(frozen=True)
class Refined:
    """Poses in the frame of the given ones, and what goes with them."""

    poses: Array  # (F, 4, 4) world_from_camera
    lens: tuple[float, float]  # k1, k2
    agreed: DepthRefined | None = None  # with a sensor's depth; None: it took no part
    aside: Array | None = None  # (F, 4, 4) the same, with the frames that were set aside placed as held-out ones are
    borrowed: int = 0  # held-out frames that have their neighbours' correction, since their own points do not place them
    placed: int = 0  # held-out frames

    @property
    def fails(self) -> bool:
        """Whether too many held-out frames could not be placed for the others to be believed."""
        return self.placed > 0 and self.borrowed > max(1, FALLBACKS * self.placed)


def refined_poses(
    seen: Tracks,
    train: Array,
    kept: frozenset[str],
    capture: Capture | None = None,
    progress: Progress = SILENT,
    aside: Array | None = None,
) -> Refined:
    """Poses by points, and by the depth of sensors where it agrees.

    Points come from training frames alone; frames that are held out are placed against them and move nothing.

    Args:
        train: (F,) bool.
        kept: what is there: with a lens, poses are refined beside it.
        capture: whose depth takes part, its frames those of `seen`; None: none does.
        aside: (F,) bool training frames that are placed a second time as if they were held out, for `Refined.aside`.

    Raises:
        InputError: a depth map cannot be read.
    """
    whole, _ = geometry.open_problem(seen)
    mine = train[whole.frame]
    often = np.bincount(whole.point[mine], minlength=len(whole.points)) >= 2
    problem = whole.only(often).only_frames(train)
    unknown = frozenset({POSES, *(kept & {LENS})})
    before, free = adjust(problem).scatter, adjust(problem, unknown, FREE_STEPS).scatter
    belief = believed(problem, before, free)
    moved = adjust(problem, unknown, STEPS, belief).problem
    agreed = None if capture is None or not capture.has_depth else refine_by_depth(capture, moved, unknown, belief, progress)
    if agreed is not None:
        moved, belief = agreed.problem, agreed.belief
    fitted = train & (np.bincount(problem.frame, minlength=len(train)) >= FEWEST)
    everything = replace(whole.only(often).like(moved), points=moved.points)
    placing = Placing(everything, belief.poses, fitted, adjust(moved).scatter)
    poses = placing.settled()
    tried = poses.copy()
    held, extra = np.flatnonzero(~train), np.flatnonzero(train & aside) if aside is not None else np.zeros(0, np.int64)
    borrowed = 0
    for frame in np.flatnonzero(~fitted):
        poses[frame], own = placing.placed(int(frame))
        tried[frame] = poses[frame]
        borrowed += int(not own and frame in held)
    for frame in extra:
        tried[frame], _ = placing.placed(int(frame))
    return Refined(poses, moved.lens, agreed, tried if len(extra) else None, borrowed, len(held))


class Placing:
    """Corrections of fitted frames, and those that they predict for others.

    Args:
        problem: all observations of the points; its poses are those of the fitted frames.
        given: (F, 4, 4) poses before anything was refined.
        fitted: (F,) bool frames whose pose was fitted with the points.
        scatter: working pixels that the fit leaves.
    """

    def __init__(self, problem: Problem, given: Array, fitted: Array, scatter: float) -> None:
        self.problem, self.given, self.fitted, self.scatter = problem, given, fitted, scatter
        self.depth = max(float(np.median(predict(problem)[0][:, 2])), 1e-9) if len(problem.frame) else 1.0
        self.focal = float(np.median(problem.focal))
        turned = np.einsum("fij,fkj->fik", problem.poses[:, :3, :3], given[:, :3, :3])
        self.turn = Rotation.from_matrix(turned).as_rotvec()  # (F, 3) of the cameras, world axes
        self.move = problem.poses[:, :3, 3] - given[:, :3, 3]  # (F, 3)
        own = np.flatnonzero(fitted)
        apart = [self._apart(int(frame), problem.poses[frame], *self._expected(int(frame))) for frame in own] if len(own) > 1 else [0.0]
        self.most = max(FACTOR * float(np.median(apart)), FLOOR)

    def settled(self) -> Array:
        """(F, 4, 4) the fitted poses; those that leave their neighbours' way while their own points disagree are brought back to it."""
        poses = np.where(self.fitted[:, None, None], self.problem.poses, self.given)
        off = np.linalg.norm(residuals(self.problem), axis=1)
        for frame in (int(number) for number in np.flatnonzero(self.fitted)):
            expected = self._expected(frame)
            if self._apart(frame, poses[frame], *expected) > self.most and not self._explains(off[self.problem.frame == frame]):
                poses[frame] = self._moved(frame, *expected)
        return poses

    def placed(self, frame: int) -> tuple[Array, bool]:
        """(4, 4) the pose of a frame by its own points, False: by its neighbours' correction."""
        expected = self._expected(frame)
        start = self._moved(frame, *expected)
        if np.count_nonzero(self.problem.frame == frame) < FEWEST:
            return start, False
        poses = self.problem.poses.copy()
        poses[frame] = start
        pose, off = resect(replace(self.problem, poses=poses), frame)
        good = self._explains(off) and self._apart(frame, pose, *expected) <= self.most
        return (pose, True) if good else (start, False)

    def _explains(self, off: Array) -> bool:
        inliers = off < CLOSE * max(self.scatter, 0.15)
        return bool(inliers.sum() >= FEWEST and inliers.mean() >= INLIERS)

    def _expected(self, frame: int) -> tuple[Array, Array]:
        """The turn and the move that the nearest other fitted cameras have, by their distance."""
        others = np.flatnonzero(self.fitted)
        others = others[others != frame]
        if not len(others):
            return np.zeros(3), np.zeros(3)
        way = np.linalg.norm(self.given[others, :3, 3] - self.given[frame, :3, 3], axis=1) / self.depth
        angle = np.arccos(np.clip(self.given[others, :3, 2] @ self.given[frame, :3, 2], -1, 1))
        near = np.argsort(way + angle, kind="stable")[:NEIGHBOURS]
        weight = 1 / ((way + angle)[near] + 1e-3)
        weight /= weight.sum()
        return weight @ self.turn[others[near]], weight @ self.move[others[near]]

    def _moved(self, frame: int, turn: Array, move: Array) -> Array:
        """(4, 4) the given pose with this correction."""
        pose = self.given[frame].copy()
        pose[:3, :3] = Rotation.from_rotvec(turn).as_matrix() @ pose[:3, :3]
        pose[:3, 3] += move
        return pose

    def _apart(self, frame: int, pose: Array, turn: Array, move: Array) -> float:
        """How far a correction is from another, in working pixels that the usual point moves by."""
        expected = self._moved(frame, turn, move)
        between = Rotation.from_matrix(pose[:3, :3] @ expected[:3, :3].T).magnitude()
        return self.focal * float(between + np.linalg.norm(pose[:3, 3] - expected[:3, 3]) / self.depth)


def believed(problem: Problem, before: float, left: float) -> Belief:
    """The problem's poses, taken to be off by as much as its points show: each by a turn, and by a move at the points' distance, that shift
    what is seen by `before` working pixels.

    What fits leave, `left` working pixels, hardly separates a slow turn along a walk from a slow move, nor the scale; where a lens
    is not quite as it is taken to be, all depths drift by some percent. What images do show outweighs this by far.
    """
    focal, depth = float(np.median(problem.focal)), float(np.median(predict(problem)[0][:, 2]))
    turn = (left * focal / max(before, 1e-9)) ** 2
    return Belief(problem.poses, np.array([turn] * 3 + [turn / max(depth, 1e-9) ** 2] * 3))
