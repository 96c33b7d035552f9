"""Bundle adjustment of points with chosen other unknowns: a lens, rows one after the other, poses.

Observation o of point X in frame f, q_o on the ideal image plane, is predicted as

    c = exp(−w_f) (R_fᵀ (X − t_f) − d_f),   c' = c − u_o·(Ω_f × c + V_f),   x = c'_xy / c'_z,   q = x·(1 + k1·r² + k2·r⁴)

(w_f, d_f): correction of a pose in its own axes; (k1, k2): the lens beyond the capture's own; u_o: the row's share of
the height, −1/2 to 1/2, and (Ω_f, V_f): how far the camera turns and moves while the rows of frame f are read. Levenberg-Marquardt with
Huber's weights; points are eliminated by the Schur complement (Triggs et al. 2000, section 6).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from fieldfuse.camera import Array
from fieldfuse.effects.evidence import TUNING

LENS, ROWS, POSES = "distortion", "rolling_shutter", "poses"
UNKNOWNS = (LENS, ROWS, POSES)
STEPS = 12
RESECTION_STEPS = 20
POINTS_A_CHUNK = 512
SLACK = 1e-3  # relative fall of the cost below which a fit is done


@dataclass(frozen=True)
class Problem:
    """What is seen, and where everything is taken to be."""

    poses: Array  # (F, 4, 4) world_from_camera
    points: Array  # (P, 3)
    frame: Array  # (O,) int
    point: Array  # (O,) int, ascending
    place: Array  # (O, 2) observed, on the ideal image plane
    focal: Array  # (F,) working pixels
    row: Array  # (O,) −1/2 … 1/2
    motion: Array  # (F, 6) Ω (radians) and V while the rows are read, camera axes
    lens: tuple[float, float] = (0.0, 0.0)  # k1, k2
    depth: Array | None = None  # (O,) by a sensor, along the camera's axis; NaN: not known
    depth_weight: float = 1.0  # working pixels that being off by all of the depth counts as

    def only(self, points: Array) -> Problem:
        """The problem of some points (P,) bool."""
        keep = points[self.point]
        number = np.cumsum(points) - 1
        return replace(
            self,
            points=self.points[points],
            frame=self.frame[keep],
            point=number[self.point[keep]],
            place=self.place[keep],
            row=self.row[keep],
            depth=None if self.depth is None else self.depth[keep],
        )

    def only_frames(self, frames: Array) -> Problem:
        """The observations in some frames (F,) bool."""
        keep = frames[self.frame]
        return replace(self, frame=self.frame[keep], point=self.point[keep], place=self.place[keep], row=self.row[keep])

    def like(self, other: Problem) -> Problem:
        """These points, with the cameras of another."""
        return replace(self, poses=other.poses, lens=other.lens, motion=other.motion)


@dataclass(frozen=True)
class Belief:
    """Where cameras are before images are looked at, and how sure that is."""

    poses: Array  # (F, 4, 4)
    weight: Array  # (6,) working pixels² that a square of a turn (radians, camera axes) and of a move costs

    def off(self, poses: Array) -> Array:
        """(F, 6) turns and moves from the believed poses to these, camera axes."""
        turned = np.einsum("fji,fjk->fik", self.poses[:, :3, :3], poses[:, :3, :3])
        moved = np.einsum("fji,fj->fi", poses[:, :3, :3], poses[:, :3, 3] - self.poses[:, :3, 3])
        return np.concatenate([Rotation.from_matrix(turned).as_rotvec(), moved], axis=1)

    def cost(self, poses: Array) -> float:
        return 0.5 * float((self.weight * self.off(poses) ** 2).sum())


@dataclass(frozen=True)
class Fitted:
    """A problem at its optimum."""

    problem: Problem
    residual: Array  # (O, 2) working pixels, predicted minus observed
    scatter: float  # their robust deviation, corrected for the points' freedom


def predict(problem: Problem) -> tuple[Array, Array]:
    """(O, 3) points in camera axes and (O, 2) predicted places."""
    pose = problem.poses[problem.frame]
    camera = np.einsum("oji,oj->oi", pose[:, :3, :3], problem.points[problem.point] - pose[:, :3, 3])
    if problem.motion.any():
        motion = problem.motion[problem.frame]
        camera = camera - problem.row[:, None] * (np.cross(motion[:, :3], camera) + motion[:, 3:])
    front = np.maximum(camera[:, 2:], 1e-9)
    x = camera[:, :2] / front
    k1, k2 = problem.lens
    r2 = (x**2).sum(1, keepdims=True)
    return camera, x * (1 + r2 * (k1 + r2 * k2))


def residuals(problem: Problem) -> Array:
    """(O, 2) working pixels."""
    return np.asarray((predict(problem)[1] - problem.place) * problem.focal[problem.frame, None])


def depth_residuals(problem: Problem) -> Array:
    """(O,) predicted over measured depth − 1, in working pixels; 0 where nothing was measured."""
    if problem.depth is None:
        return np.zeros(len(problem.place))
    return np.nan_to_num(problem.depth_weight * (predict(problem)[0][:, 2] / problem.depth - 1))


def scatter(residual: Array) -> float:
    """Deviation of residuals (O, 2) by the median of their lengths (Rayleigh: median = 1.1774 deviations)."""
    return float(np.median(np.linalg.norm(residual, axis=1)) / 1.1774) if len(residual) else np.inf


def uncertainty(problem: Problem) -> Array:
    """(O,) deviation of points along the viewing direction of the images that show them, by how well rays meet; units of the poses."""
    by_point = _slopes(replace(problem, depth=None), frozenset())[0]
    count = len(problem.points)
    ends = np.searchsorted(problem.point, np.arange(count))
    certain = _sum(np.einsum("oai,oaj->oij", by_point, by_point), ends, count)
    certain += (1e-9 * np.trace(certain, axis1=1, axis2=2)[:, None, None] + 1e-12) * np.eye(3)
    spread = np.linalg.inv(certain) * scatter(residuals(problem)) ** 2
    along = problem.poses[problem.frame][:, :3, 2]
    return np.sqrt(np.einsum("oi,oij,oj->o", along, spread[problem.point], along))


def adjust(problem: Problem, unknown: frozenset[str] = frozenset(), steps: int = STEPS, belief: Belief | None = None) -> Fitted:
    """Fit the points and what is `unknown` beside them; poses that are unknown stay near those of `belief`, if there is one."""
    fitted, left = _descend(problem, lambda now, left, width, damping: _step(now, left, width, unknown, damping, belief), steps, 5, belief)
    return Fitted(fitted, left[:, :2], scatter(left[:, :2]))


def _descend(
    current: Problem, step: Callable[[Problem, Array, float, float], Problem], steps: int, ease: float, belief: Belief | None = None
) -> tuple[Problem, Array]:
    """Levenberg-Marquardt: the problem after damped steps, and what is left then. A `step` takes what is left before it, Huber's width and
    the damping, which is divided by `ease` where the cost falls."""
    left, damping = _left(current), 1e-3
    for _ in range(steps):
        width = TUNING * max(scatter(left[:, :2]), 1e-3)
        cost = _cost(left, width, current, belief)
        moved = step(current, left, width, damping)
        new = _left(moved)
        value = _cost(new, width, moved, belief) if np.isfinite(moved.poses).all() else np.inf
        if value < cost:
            current, left, damping = moved, new, max(damping / ease, 1e-7)
            if value > (1 - SLACK) * cost:
                break
        else:
            damping *= 10
            if damping > 1e4:
                break
    return current, left


def _left(problem: Problem) -> Array:
    """(O, 2) residuals, (O, 3) where a sensor measured depth."""
    seen = residuals(problem)
    return seen if problem.depth is None else np.column_stack([seen, depth_residuals(problem)])


def _cost(residual: Array, width: float, problem: Problem, belief: Belief | None) -> float:
    """Huber's cost, and that of the belief, over the number of residuals."""
    size = _sizes(residual)
    held = belief.cost(problem.poses) / max(len(size), 1) if belief is not None else 0.0
    return float(np.where(size < width, 0.5 * size**2, width * (size - 0.5 * width)).sum(axis=1).mean()) + held


def _sizes(residual: Array) -> Array:
    """(O, 1) how far places are off, (O, 2) with depths."""
    return np.column_stack([np.linalg.norm(residual[:, :2], axis=1), np.abs(residual[:, 2:])])


def _weights(residual: Array, width: float) -> Array:
    """(O, 2 or 3) of Huber: both numbers of a place share one."""
    weight = np.minimum(1, width / np.maximum(_sizes(residual), 1e-12))
    return np.column_stack([weight[:, :1], weight])


def _step(problem: Problem, left: Array, width: float, unknown: frozenset[str], damping: float, belief: Belief | None = None) -> Problem:
    """One damped Gauss-Newton step."""
    by_point, by_camera, columns, count = _slopes(problem, unknown)
    weight = _weights(left, width)[:, :, None]
    points = len(problem.points)
    heavy = by_point * weight
    ends = np.searchsorted(problem.point, np.arange(points))
    v = _sum(np.einsum("oai,oaj->oij", heavy, by_point), ends, points)
    g = _sum(np.einsum("oai,oa->oi", heavy, left), ends, points)
    v += (damping * np.trace(v, axis1=1, axis2=2)[:, None, None] / 3 + 1e-12) * np.eye(3)
    inverse = np.linalg.inv(v)
    if count == 0:
        return replace(problem, points=problem.points - np.einsum("pij,pj->pi", inverse, g))
    matrix, right = np.zeros((count, count)), np.zeros(count)
    weighted = by_camera * weight
    np.add.at(right, columns, np.einsum("oac,oa->oc", weighted, left))
    block = np.einsum("oac,oad->ocd", weighted, by_camera)
    np.add.at(matrix, (columns[:, :, None], columns[:, None, :]), block)
    if belief is not None and POSES in unknown:  # turns by little add up, so that the slope by a turn is the identity
        pull = belief.weight * belief.off(problem.poses)
        right[: pull.size] += pull.ravel()
        matrix[np.arange(pull.size), np.arange(pull.size)] += np.tile(belief.weight, len(pull))
    matrix[np.diag_indices(count)] *= 1 + damping
    matrix[np.diag_indices(count)] += 1e-9 * np.trace(matrix) / count
    mixed = np.einsum("oac,oai->oci", weighted, by_point)  # (O, K, 3)
    root = np.linalg.cholesky(inverse)
    whole = np.append(ends, len(problem.point))
    for start in range(0, points, POINTS_A_CHUNK):
        stop = min(start + POINTS_A_CHUNK, points)
        mine = slice(whole[start], whole[stop])
        tied = np.zeros((count, stop - start, 3))
        at = (problem.point[mine] - start)[:, None]
        np.add.at(tied, (columns[mine], np.broadcast_to(at, columns[mine].shape)), mixed[mine])
        tied = np.einsum("cpi,pij->cpj", tied, root[start:stop]).reshape(count, -1)
        matrix -= tied @ tied.T
        right -= tied @ np.einsum("pji,pj->pi", root[start:stop], g[start:stop]).ravel()
    cameras = -np.linalg.solve(matrix, right)
    pulled = g + _sum(np.einsum("oci,oc->oi", mixed, cameras[columns]), ends, points)
    moved = replace(problem, points=problem.points - np.einsum("pij,pj->pi", inverse, pulled))
    return _with(moved, cameras, unknown)


def _sum(values: Array, ends: Array, points: int) -> Array:
    """Sums over the observations of each point; every point has some."""
    return np.asarray(np.add.reduceat(values, ends, axis=0)) if points else values[:0]


def _slopes(problem: Problem, unknown: frozenset[str]) -> tuple[Array, Array, Array, int]:
    """Derivatives of what is left (R = 2 or 3) by the points (O, R, 3) and by what else is unknown (O, R, K), its columns (O, K), and
    their number."""
    camera, _ = predict(problem)
    z = np.maximum(camera[:, 2], 1e-9)
    x = camera[:, :2] / z[:, None]
    k1, k2 = problem.lens
    r2 = (x**2).sum(1)
    radial, bend = 1 + r2 * (k1 + r2 * k2), 2 * k1 + 4 * k2 * r2
    lens = radial[:, None, None] * np.eye(2) + bend[:, None, None] * x[:, :, None] * x[:, None, :]
    flat = np.zeros((len(x), 2, 3))
    flat[:, 0, 0] = flat[:, 1, 1] = 1 / z
    flat[:, :, 2] = -x / z[:, None]
    by_place = np.einsum("oab,obc->oac", lens, flat) * problem.focal[problem.frame, None, None]  # of camera axes
    if problem.depth is not None:
        deep = np.zeros((len(x), 1, 3))
        deep[:, 0, 2] = np.nan_to_num(problem.depth_weight / problem.depth)
        by_place = np.concatenate([by_place, deep], axis=1)
    by_point = np.einsum("oac,oic->oai", by_place, problem.poses[problem.frame, :3, :3])
    parts, columns = [], []
    frames = len(problem.poses)
    first = 0
    turned = np.stack([np.cross(camera, axis) for axis in np.eye(3)], axis=2)  # (O, 3, 3) by turns about the camera's axes
    rigid = np.concatenate([np.einsum("oac,ocd->oad", by_place, turned), -by_place], axis=2)  # of (w, d)
    if POSES in unknown:
        parts.append(rigid)
        columns.append(6 * problem.frame[:, None] + np.arange(6))
        first = 6 * frames
    if LENS in unknown:
        focal = problem.focal[problem.frame, None]
        grown = np.zeros((len(x), by_place.shape[1], 2))
        grown[:, :2] = np.stack([x * r2[:, None], x * r2[:, None] ** 2], axis=2) * focal[:, :, None]
        parts.append(grown)
        columns.append(np.broadcast_to(first + np.arange(2), (len(x), 2)))
        first += 2
    if ROWS in unknown:
        parts.append(problem.row[:, None, None] * rigid)
        columns.append(first + 6 * problem.frame[:, None] + np.arange(6))
        first += 6 * frames
    if not parts:
        return by_point, np.zeros((len(x), by_place.shape[1], 0)), np.zeros((len(x), 0), np.int64), 0
    return by_point, np.concatenate(parts, axis=2), np.concatenate(columns, axis=1), first


def _with(problem: Problem, step: Array, unknown: frozenset[str]) -> Problem:
    first = 0
    if POSES in unknown:
        first = 6 * len(problem.poses)
        moved = step[:first].reshape(-1, 6)
        poses = problem.poses.copy()
        poses[:, :3, 3] += np.einsum("fij,fj->fi", poses[:, :3, :3], moved[:, 3:])
        poses[:, :3, :3] = poses[:, :3, :3] @ Rotation.from_rotvec(moved[:, :3]).as_matrix()
        problem = replace(problem, poses=poses)
    if LENS in unknown:
        k1, k2 = (float(a + b) for a, b in zip(problem.lens, step[first : first + 2], strict=True))
        problem = replace(problem, lens=(k1, k2))
        first += 2
    if ROWS in unknown:
        problem = replace(problem, motion=problem.motion + step[first:].reshape(-1, 6))
    return problem


def resect(problem: Problem, frame: int) -> tuple[Array, Array]:
    """The pose of one frame against points that stay where they are, by damped Gauss-Newton steps from the pose it has.

    Returns:
        (4, 4) world_from_camera, and (O',) how far its points are then off in the image, working pixels.
    """
    keep = problem.frame == frame
    alone = replace(
        problem,
        poses=problem.poses[[frame]],
        frame=np.zeros(int(keep.sum()), dtype=np.int64),
        point=problem.point[keep],
        place=problem.place[keep],
        row=problem.row[keep],
        focal=problem.focal[[frame]],
        motion=problem.motion[[frame]],
        depth=None,
    )

    def step(now: Problem, left: Array, width: float, damping: float) -> Problem:
        _, slope, _, _ = _slopes(now, frozenset({POSES}))
        weight = _weights(left, width)
        matrix = np.einsum("oa,oac,oad->cd", weight, slope, slope)
        matrix[np.diag_indices(6)] *= 1 + damping
        matrix += 1e-9 * np.trace(matrix) * np.eye(6)
        return _with(now, -np.linalg.solve(matrix, np.einsum("oa,oac,oa->c", weight, slope, left)), frozenset({POSES}))

    alone, left = _descend(alone, step, RESECTION_STEPS, 10)
    return np.asarray(alone.poses[0]), np.linalg.norm(left, axis=1)
