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
from fieldfuse.config import KeyframesSettings
from fieldfuse.errors import InputError
from fieldfuse.poses.overlap import best_neighbours, overlap, parallax

METHODS = PARALLAX, UNIFORM = "parallax", "uniform"
MIN_PARALLAX = 5.0  # degrees, baseline against the median depth, from which on a frame differs from a key frame …
MAX_OVERLAP = 0.8  # … or so much overlap (rotation)
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

    def group(self, at: int) -> list[int]:
        """The key frame at a position and its neighbours, each once."""
        return list(dict.fromkeys([int(self.indices[at]), *(int(index) for index in self.neighbours[at])]))


def select_keyframes(
    world_from_camera: Array,
    intrinsics: Sequence[Intrinsics],
    median_depth: float,
    wanted: KeyframesSettings | None = None,
    views: int = VIEWS,
    sharpness: Array | None = None,
) -> KeyFrames:
    """Choose key frames among posed frames, and K − 1 neighbours for each among all frames.

    `parallax`: greedy in the given order. A frame is taken when it differs from every key frame so far, by `MIN_PARALLAX` or `MAX_OVERLAP`.
    With `sharpness`, a blurred key frame then gives way to the sharpest of the frames that stand within half of these bounds from it.
    `uniform`: every n-th frame, as in the paper.

    Args:
        world_from_camera: (N, 4, 4), in the frame that `median_depth` is measured in.
        wanted: method and numbers; beyond `most` key frames, those are chosen that are farthest from each other.
        views: K, 2 or more.
        sharpness: (N,) of any unit, comparable between frames that show nearly the same.

    Raises:
        InputError: no frames, a depth that is not positive, or an unknown method.
    """
    poses, wanted = np.asarray(world_from_camera, dtype=np.float64), wanted or KeyframesSettings()
    if len(poses) == 0 or len(poses) != len(intrinsics):
        raise InputError(f"key frames need as many poses as cameras and at least one; there are {len(poses)} and {len(intrinsics)}")
    if not (np.isfinite(median_depth) and median_depth > 0):
        raise InputError(f"key frames need a positive scene depth, not {median_depth:g}")
    if wanted.method not in METHODS:
        raise InputError(f"there is no way {wanted.method!r} to choose key frames; known are {', '.join(METHODS)}")
    if views < 2 or wanted.every < 1 or wanted.most < 1:
        raise InputError(f"key frames need views ≥ 2, every ≥ 1 and most ≥ 1; there are {views}, {wanted.every} and {wanted.most}")
    shares = overlap(poses, intrinsics, median_depth)
    angles = parallax(poses, median_depth)
    if wanted.method == UNIFORM:
        chosen = list(range(0, len(poses), wanted.every))
        if len(chosen) > wanted.most:
            chosen = [chosen[i] for i in np.linspace(0, len(chosen) - 1, wanted.most).round().astype(int)]
    else:
        common, angle = np.minimum(shares, shares.T), np.minimum(angles, angles.T)
        chosen = [0]
        for i in range(1, len(poses)):
            if np.all((angle[i, chosen] > MIN_PARALLAX) | (common[i, chosen] < MAX_OVERLAP)):
                chosen.append(i)
        if sharpness is not None:
            chosen = _sharper(chosen, np.asarray(sharpness), common, angle)
        if len(chosen) > wanted.most:
            chosen = _farthest(poses, median_depth, chosen, wanted.most)
    indices = np.array(sorted(chosen), dtype=np.int64)
    return KeyFrames(indices, best_neighbours(poses, shares, angles, views - 1)[indices])


def _sharper(chosen: list[int], sharpness: Array, common: Array, angle: Array) -> list[int]:
    """Blurred ones of `chosen` replaced by much sharper frames from nearly the same place; never two by the same."""
    kept = set(chosen)
    for index in chosen:
        beside = (angle[index] <= 0.5 * MIN_PARALLAX) & (common[index] >= 0.5 * (1 + MAX_OVERLAP))
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
