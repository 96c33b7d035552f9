"""Which of lens, rows and poses explain where points are seen, judged by points that took no part in the fit."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from fieldfuse.camera import Array, invert
from fieldfuse.effects.adjust import LENS, POSES, ROWS, UNKNOWNS, Problem, adjust, residuals, scatter
from fieldfuse.effects.tracks import LONG_SIDE, LOOSE, Tracks
from fieldfuse.poses.points import intersect

MOST_POINTS = 1600  # that take part
HELD_OUT = 4  # every n-th point is held out of the fits
FEWEST = 60  # points without which nothing is known
OUTLIER = 6.0  # deviations of a point's worst observation beyond which it is taken for a wrong match, once nothing explains it
MARGIN = {LENS: 0.08, POSES: 0.4, ROWS: 0.15}  # least relative fall of the held-out residual, larger for what has more numbers
MIN_FALL = 0.003  # working pixels by which it has to fall at least


@dataclass(frozen=True)
class Choice:
    """One unknown beside the others that are kept."""

    before: float  # working pixels: scatter of held-out points without it
    after: float
    kept: bool


@dataclass(frozen=True)
class Explained:
    """What was found about where points are seen."""

    problem: Problem  # all points, with the cameras that explain them
    kept: frozenset[str]
    choices: dict[str, Choice]
    observation: Array  # (O',) which of the tracks' observations the problem's are
    profile: list[float] = field(default_factory=list)  # radial residual at five radii, working pixels, before anything is explained


def open_problem(seen: Tracks) -> tuple[Problem, Array]:
    """Points where rays meet, wide tolerance, and the observations (O',) that they have."""
    place = seen.ideal()
    focal = seen.focal
    known = np.isfinite(place).all(1)
    tolerance = LOOSE * LONG_SIDE * min(1.0, float(np.median(focal)) / LONG_SIDE) / focal[seen.frame]
    rows = np.flatnonzero(known)
    points, point, kept, _ = intersect(seen.poses, seen.frame[rows], place[rows], seen.point[rows], tolerance[rows])
    used = rows[kept]
    order = np.argsort(point, kind="stable")
    point, used = point[order], used[order]
    still = np.zeros((len(seen.poses), 6))
    problem = Problem(seen.poses, points, seen.frame[used], point, place[used], focal, seen.row()[used], still)
    if len(points) > MOST_POINTS:  # those that most images show are worth most
        counts = np.bincount(point, minlength=len(points))
        chosen = np.zeros(len(points), dtype=bool)
        chosen[np.argsort(-counts, kind="stable")[:MOST_POINTS]] = True
        used = used[chosen[point]]
        problem = problem.only(chosen)
    return problem, used


def steps_of(poses: Array, times: Array) -> Array:
    """(F, 6) radians and units that each camera turns and moves in one step of the capture, in its own axes; 0 where not known."""
    count = len(poses)
    motion = np.zeros((count, 6))
    if not np.isfinite(times).all() or count < 3:
        return motion
    usual = float(np.median(np.diff(times)))
    for index in range(1, count - 1):
        passed = times[index + 1] - times[index - 1]
        if passed < 2.5 * usual:
            here, relative = poses[index, :3, :3].T, invert(poses[index - 1]) @ poses[index + 1]
            turn = Rotation.from_matrix(relative[:3, :3]).as_rotvec()
            motion[index, :3] = here @ poses[index - 1, :3, :3] @ turn / passed
            motion[index, 3:] = here @ (poses[index + 1, :3, 3] - poses[index - 1, :3, 3]) / passed
    return motion


def readout(motion: Array, steps: Array) -> tuple[float, float]:
    """Which share of a step the rows take, when cameras move by `motion` (F, 6) meanwhile and by `steps` (F, 6) a step.

    Judged by the turns alone; second, how well the two agree (cosine, 1: alike).
    """
    known = steps[:, :3].any(1)
    product = float((motion[known, :3] * steps[known, :3]).sum())
    size, other = float((steps[known, :3] ** 2).sum()), float((motion[known, :3] ** 2).sum())
    if size <= 0 or other <= 0:
        return 0.0, 0.0
    return product / size, product / np.sqrt(size * other)


def explain(seen: Tracks) -> Explained | None:
    """Try the unknowns one by one and, where one helps held-out points by a margin, in every combination. None: too few points."""
    whole, used = open_problem(seen)
    if len(whole.points) < FEWEST:
        return None
    every = adjust(whole, frozenset(UNKNOWNS), steps=5)
    worst = np.zeros(len(whole.points))
    np.maximum.at(worst, whole.point, np.linalg.norm(every.residual, axis=1))
    good = worst < OUTLIER * max(every.scatter, 0.15)
    used, whole = used[good[whole.point]], whole.only(good)
    if len(whole.points) < FEWEST:
        return None
    out = np.arange(len(whole.points)) % HELD_OUT == HELD_OUT // 2
    fit, held = whole.only(~out), whole.only(out)
    held = adjust(held).problem
    tried: dict[frozenset[str], tuple[float, Problem]] = {frozenset(): (scatter(residuals(held)), whole)}

    def attempt(unknown: frozenset[str]) -> float:
        if unknown not in tried:
            fitted = adjust(fit, unknown).problem
            tried[unknown] = (adjust(held.like(fitted)).scatter, fitted)
        return tried[unknown][0]

    def score(unknown: frozenset[str]) -> float:
        return attempt(unknown) * float(np.prod([1 / (1 - MARGIN[name]) for name in unknown])) + MIN_FALL * len(unknown)

    before = adjust(whole)
    kept = min([frozenset[str](), *(frozenset({name}) for name in UNKNOWNS)], key=score)
    if kept:  # poses can mimic a lens or rows, and these each other: every combination is tried
        both = [frozenset(UNKNOWNS) - {name} for name in UNKNOWNS]
        kept = min([*list(tried), *both, frozenset(UNKNOWNS)], key=score)
    choices = {name: Choice(attempt(kept - {name}), attempt(kept | {name}), name in kept) for name in UNKNOWNS}
    problem = adjust(whole.like(tried[kept][1])).problem
    return Explained(problem, kept, choices, used, _profile(seen, used, before.problem, before.residual))


def _profile(seen: Tracks, used: Array, problem: Problem, residual: Array) -> list[float]:
    """Median residual away from the middle, in five rings of equal width."""
    length = np.linalg.norm(problem.place, axis=1, keepdims=True)
    outwards = -(residual * problem.place / np.maximum(length, 1e-9)).sum(1)
    ring = np.clip((seen.radius()[used] * 5).astype(int), 0, 4)
    return [round(float(np.median(outwards[ring == k])), 3) if (ring == k).any() else 0.0 for k in range(5)]
