"""Which of the captured views shows most of the scene: where a visitor begins."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from fieldfuse.camera import Array, Intrinsics, pixel_grid, unproject

SIDE = 64  # long side in pixels of the renders that are compared
CELL = 0.05  # side of a cell of space, of the scene's median depth
FARTHEST = 4.0  # median depths: what lies behind is background


def overview(render: Callable[[Intrinsics, Array], Any], intrinsics: Sequence[Intrinsics], poses: Array, depth: float) -> int:
    """Index of the view whose surfaces most others see, too: Σ over the cells of space that it shows of how many other views show them.
    So it shows much, from not too near, and of what was filmed rather than what stood at the side.

    Args:
        render: pinhole camera and pose (4, 4) → `Rendered` with its depth.
        poses: (N, 4, 4) world_from_camera.
        depth: median depth of the scene, in their unit.
    """
    cells, views = [], []
    for index, (camera, pose) in enumerate(zip(intrinsics, poses, strict=True)):
        factor = SIDE / max(camera.width, camera.height)
        small = camera.pinhole().scaled(max(1, round(factor * camera.width)), max(1, round(factor * camera.height)))
        found = np.asarray(render(small, pose).depth, np.float64).reshape(-1)
        solid = (found > 0) & (found < FARTHEST * depth)
        points = unproject(small, pose, pixel_grid(small.width, small.height)[solid], found[solid])
        cells.append(np.unique(np.floor(points / (CELL * depth)).astype(np.int64), axis=0))
        views.append(np.full(len(cells[-1]), index))
    _, cell, seen = np.unique(np.concatenate(cells), axis=0, return_inverse=True, return_counts=True)
    scores = np.bincount(np.concatenate(views), weights=seen[cell.reshape(-1)] - 1, minlength=len(poses))
    return int(np.argmax(scores))
