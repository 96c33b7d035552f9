"""How far pictures move against each other between two depths, on the processor: by it a sweep chooses its planes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fieldfuse.nerfusion.cameras import Cameras

SPOTS = np.array([[u, v, 1.0] for u in (0.1, 0.5, 0.9) for v in (0.1, 0.5, 0.9)], np.float32)  # of the first picture
FRONT = 0.05  # of the unit of depth that a place has to lie before a view to count


def movement(widths: Sequence[int], cameras: Cameras, near: float, far: float) -> float:
    """Pixels by which what lies along rays of the first view moves from `near` to `far` in the view where it moves most.

    Each view's is the median of nine rays, of those whose ends both lie in front of it; 0 where none does.

    Args:
        widths: K, of the pictures that are compared.
        cameras: K, on the CPU.
    """
    lenses, sizes, poses = (values.numpy() for values in (cameras.intrinsics, cameras.size, cameras.world_from_camera))
    rays = SPOTS.copy()
    rays[:, :2] = (SPOTS[:, :2] * sizes[0] - lenses[0, 2:]) / lenses[0, :2]
    axes = poses[1:, :3, :3]
    turned = rays @ (poses[0, :3, :3].T @ axes)  # (K − 1, 9, 3)
    shift = (poses[0, :3, 3] - poses[1:, :3, 3])[:, None] @ axes
    ends = np.stack([turned + shift / np.float32(depth) for depth in (near, far)])
    front = (ends[..., 2] > FRONT).all(0)
    places = ends[..., :2] / np.where(front, ends[..., 2], np.float32(1))[..., None] * lenses[1:, None, :2]
    moved = np.sort(np.where(front, np.sqrt(np.square(places[0] - places[1]).sum(-1)), np.inf), 1).tolist()
    most = 0.0
    for row, count, width, size in zip(moved, front.sum(1).tolist(), widths[1:], sizes[1:, 0].tolist(), strict=True):
        if count:
            most = max(most, row[(count - 1) // 2] * width / size)
    return most
