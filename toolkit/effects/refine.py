"""Poses of all frames from shared points: training frames by bundle adjustment among themselves, the others by resection on its points."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from toolkit.camera import Array
from toolkit.capture.types import Capture
from toolkit.effects import geometry
from toolkit.effects.adjust import LENS, POSES, ROWS, Belief, Problem, adjust, predict, resect
from toolkit.effects.sensed import Agreed, agreeing
from toolkit.effects.sightings import Sightings
from toolkit.progress import SILENT, Progress

STEPS, FREE_STEPS = 60, 30  # of the fit, and of one that only tells how much noise is left
FEWEST = 12  # observations without which a frame keeps its pose


@dataclass(frozen=True)
class Refined:
    """Poses in the frame of the given ones, and what goes with them."""

    poses: Array  # (F, 4, 4) world_from_camera
    lens: tuple[float, float]  # k1, k2
    agreed: Agreed | None = None  # with a sensor's depth; None: it took no part


def refined_poses(
    seen: Sightings, train: Array, kept: frozenset[str], capture: Capture | None = None, progress: Progress = SILENT
) -> Refined:
    """Poses by points, and by the depth of sensors where it agrees.

    Points come from training frames alone; frames that are held out are placed against them and move nothing.

    Args:
        train: (F,) bool.
        kept: what is there: with a lens or rows read one after the other, poses are refined beside these.
        capture: whose depth takes part, its frames those of `seen`; None: none does.

    Raises:
        InputError: a depth map cannot be read.
    """
    whole, _ = geometry.open_problem(seen)
    mine = train[whole.frame]
    often = np.bincount(whole.point[mine], minlength=len(whole.points)) >= 2
    problem = _only_frames(whole.only(often), train)
    unknown = frozenset({POSES, *(kept & {LENS, ROWS})})
    before, free = adjust(problem).scatter, adjust(problem, unknown, FREE_STEPS).scatter
    belief = believed(problem, before, free)
    moved = adjust(problem, unknown, STEPS, belief).problem
    agreed = None if capture is None or not capture.has_depth else agreeing(capture, moved, unknown, belief, progress)
    if agreed is not None:
        moved, belief = agreed.problem, agreed.belief
    poses = moved.poses.copy()
    few = np.bincount(problem.frame, minlength=len(train)) < FEWEST
    poses[few | ~train] = belief.poses[few | ~train]
    everything = whole.only(often).like(moved)
    everything = replace(everything, points=moved.points, poses=poses)
    for frame in np.flatnonzero(~train):
        rows = everything.frame == frame
        if rows.sum() >= FEWEST:
            poses[frame] = resect(everything, int(frame))
    return Refined(poses, moved.lens, agreed)


def believed(problem: Problem, before: float, left: float) -> Belief:
    """The problem's poses, taken to be off by as much as its points show: each by a turn, and by a move at the points' distance, that shift
    what is seen by `before` working pixels.

    What fits leave, `left` working pixels, hardly tells a slow turn along a walk from a slow move, nor the scale; where a lens or rows
    are not quite as they are taken to be, all depths drift by some percent. What pictures do tell outweighs this by far.
    """
    focal, depth = float(np.median(problem.focal)), float(np.median(predict(problem)[0][:, 2]))
    turn = (left * focal / max(before, 1e-9)) ** 2
    return Belief(problem.poses, np.array([turn] * 3 + [turn / max(depth, 1e-9) ** 2] * 3))


def _only_frames(problem: Problem, frames: Array) -> Problem:
    keep = frames[problem.frame]
    return replace(problem, frame=problem.frame[keep], point=problem.point[keep], place=problem.place[keep], row=problem.row[keep])
