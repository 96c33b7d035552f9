"""Key frames and each one's neighbours: the views from which local volumes are built (NeRFusion, section 3.1 and 4).

The paper samples frames evenly and takes the ones next in time; here frames are chosen by how much they move against the
depth of the scene, neighbours by overlap and parallax, and of frames that show the same the sharpest. Even sampling stays as an option.
Pure NumPy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.errors import InputError
from fieldfuse.poses.overlap import best_neighbours, overlap, parallax

BY_PARALLAX = "parallax"
UNIFORM = "uniform"
VIEWS = 3  # K in the paper: a key frame and K − 1 neighbours
BLURRED = 0.8  # of the sharpness of a frame beside it: a key frame that gives way to that one


@dataclass
class KeyFrames:
    """Indices into the frames that were given."""

    indices: Array  # (M,) int64, ascending
    neighbours: Array  # (M, K − 1) int64, best first

    def to_dict(self) -> dict[str, Any]:
        return {"indices": self.indices.tolist(), "neighbours": self.neighbours.tolist()}

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> KeyFrames:
        indices = np.array(data["indices"], dtype=np.int64)
        return cls(indices, np.array(data["neighbours"], dtype=np.int64).reshape(len(indices), -1))


def select_keyframes(
    world_from_camera: Array,
    intrinsics: Sequence[Intrinsics],
    median_depth: float,
    *,
    method: str = BY_PARALLAX,
    most: int | None = None,
    views: int = VIEWS,
    min_parallax: float = 5.0,
    max_overlap: float = 0.8,
    every: int = 10,
    sharpness: Array | None = None,
) -> KeyFrames:
    """Choose key frames among posed frames, and K − 1 neighbours for each among all frames.

    `parallax`: greedy in the given order. A frame is taken when it differs from every key frame so far: by more than
    `min_parallax` degrees of parallax (baseline against `median_depth`), or by an overlap below `max_overlap` (rotation). With
    `sharpness`, a blurred key frame then gives way to the sharpest of the frames that stand within half of these bounds from it.
    `uniform`: each `every`-th frame, as in the paper.

    Args:
        world_from_camera: (N, 4, 4), in the frame that `median_depth` is measured in.
        most: at most this many; beyond it, those are kept that are farthest from each other.
        views: K, 2 or more.
        sharpness: (N,) of any unit, comparable between frames that show nearly the same; None: not looked at.

    Raises:
        InputError: no frames, a depth that is not positive, or an unknown method.
    """
    poses = np.asarray(world_from_camera, dtype=np.float64)
    if len(poses) == 0 or len(poses) != len(intrinsics):
        raise InputError(f"key frames need as many poses as cameras and at least one; there are {len(poses)} and {len(intrinsics)}")
    if not (np.isfinite(median_depth) and median_depth > 0):
        raise InputError(f"key frames need a positive scene depth, not {median_depth:g}")
    if method not in (BY_PARALLAX, UNIFORM):
        raise InputError(f"there is no way {method!r} to choose key frames; known are {BY_PARALLAX}, {UNIFORM}")
    if views < 2 or every < 1 or (most is not None and most < 1):
        raise InputError(f"key frames need views ≥ 2, every ≥ 1 and most ≥ 1; there are {views}, {every} and {most}")
    shares = overlap(poses, intrinsics, median_depth)
    angles = parallax(poses, median_depth)
    if method == UNIFORM:
        chosen = list(range(0, len(poses), every))
        if most is not None and len(chosen) > most:
            chosen = [chosen[i] for i in np.linspace(0, len(chosen) - 1, most).round().astype(int)]
    else:
        chosen = _greedy(shares, angles, min_parallax, max_overlap)
        if sharpness is not None:
            chosen = _sharper(chosen, np.asarray(sharpness), shares, angles, min_parallax, max_overlap)
        if most is not None and len(chosen) > most:
            chosen = _farthest(poses, median_depth, chosen, most)
    indices = np.array(sorted(chosen), dtype=np.int64)
    return KeyFrames(indices, best_neighbours(poses, shares, angles, views - 1)[indices])


def _greedy(shares: Array, angles: Array, min_parallax: float, max_overlap: float) -> list[int]:
    chosen = [0]
    for i in range(1, len(shares)):
        common = np.minimum(shares[i, chosen], shares[chosen, i])
        angle = np.minimum(angles[i, chosen], angles[chosen, i])
        if np.all((angle > min_parallax) | (common < max_overlap)):
            chosen.append(i)
    return chosen


def _sharper(chosen: list[int], sharpness: Array, shares: Array, angles: Array, min_parallax: float, max_overlap: float) -> list[int]:
    """Blurred ones of `chosen` replaced by much sharper frames from nearly the same place; never two by the same."""
    kept = set(chosen)
    for index in chosen:
        common = np.minimum(shares[index], shares[:, index])
        angle = np.minimum(angles[index], angles[:, index])
        beside = (angle <= 0.5 * min_parallax) & (common >= 0.5 * (1 + max_overlap))
        beside[list(kept)] = False
        if beside.any():
            best = int(np.argmax(np.where(beside, sharpness, -np.inf)))
            if sharpness[index] < BLURRED * sharpness[best]:
                kept = kept - {index} | {best}
    return sorted(kept)


def _farthest(poses: Array, depth: float, chosen: list[int], most: int) -> list[int]:
    """`most` of `chosen`, each next one farthest from those before, in position (by depth) and viewing direction together."""
    places = np.concatenate([poses[chosen, :3, 3] / depth, poses[chosen, :3, 2]], axis=1)  # (chosen, 6)
    kept = [0]
    gap = np.linalg.norm(places - places[0], axis=1)
    while len(kept) < most:
        kept.append(int(np.argmax(gap)))
        gap = np.minimum(gap, np.linalg.norm(places - places[kept[-1]], axis=1))
    return [chosen[k] for k in kept]
