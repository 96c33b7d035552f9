"""Poses of all frames from shared points: training frames by bundle adjustment among themselves, the others by resection on its points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from toolkit.camera import Array
from toolkit.effects import geometry
from toolkit.effects.adjust import LENS, POSES, ROWS, Problem, adjust, resect
from toolkit.effects.sightings import Sightings

FEWEST = 12  # observations without which a frame keeps its pose


def refined_poses(seen: Sightings, train: Array, kept: frozenset[str]) -> tuple[Array, tuple[float, float]]:
    """(F, 4, 4) poses in the frame of the given ones, and the lens (k1, k2) that goes with them.

    Points come from training frames alone; frames that are held out are placed against them and move nothing.

    Args:
        train: (F,) bool.
        kept: what is there: with a lens or rows read one after the other, poses are refined beside these.
    """
    whole, _ = geometry.open_problem(seen)
    mine = train[whole.frame]
    often = np.bincount(whole.point[mine], minlength=len(whole.points)) >= 2
    problem = _only_frames(whole.only(often), train)
    fitted = adjust(problem, frozenset({POSES, *(kept & {LENS, ROWS})}), steps=30).problem
    enough = train & (np.bincount(fitted.frame, minlength=len(train)) >= FEWEST)
    poses = aligned(fitted.poses, seen.poses, enough)
    moved = replace(fitted, poses=poses, points=_carried(fitted, poses, enough))
    poses[~enough] = seen.poses[~enough]
    everything = whole.only(often).like(moved)
    everything = replace(everything, points=moved.points, poses=poses)
    for frame in np.flatnonzero(~train):
        rows = everything.frame == frame
        if rows.sum() >= FEWEST:
            poses[frame] = resect(everything, int(frame))
    return poses, fitted.lens


def _only_frames(problem: Problem, frames: Array) -> Problem:
    keep = frames[problem.frame]
    return replace(problem, frame=problem.frame[keep], point=problem.point[keep], place=problem.place[keep], row=problem.row[keep])


def aligned(poses: Array, given: Array, use: Array) -> Array:
    """`poses` under the similarity that brings those in `use` (F,) bool closest to the given ones: mean turn, spread and place."""
    u, _, vt = np.linalg.svd(np.einsum("fij,fkj->ik", given[use, :3, :3], poses[use, :3, :3]))
    rotation = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    centre, target = poses[use, :3, 3].mean(0), given[use, :3, 3].mean(0)
    away, wanted = (poses[use, :3, 3] - centre) @ rotation.T, given[use, :3, 3] - target
    scale = float((away * wanted).sum() / max(float((away**2).sum()), 1e-30))
    out = poses.copy()
    out[:, :3, :3] = rotation @ poses[:, :3, :3]
    out[:, :3, 3] = scale * (poses[:, :3, 3] - centre) @ rotation.T + target
    return out


def _carried(problem: Problem, poses: Array, use: Array) -> Array:
    """(P, 3) the problem's points under the similarity that made `poses` of its own."""
    first = int(np.flatnonzero(use)[0])
    rotation = poses[first, :3, :3] @ problem.poses[first, :3, :3].T
    before, after = problem.poses[use, :3, 3], poses[use, :3, 3]
    spread = np.linalg.norm(before - before.mean(0))
    scale = float(np.linalg.norm(after - after.mean(0)) / spread) if spread > 1e-15 else 1.0
    return np.asarray(scale * (problem.points - problem.poses[first, :3, 3]) @ rotation.T + poses[first, :3, 3])
