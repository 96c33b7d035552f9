"""Rotations as quaternions, as COLMAP and TUM write them."""

from __future__ import annotations

import numpy as np

from fieldfuse.camera import Array
from fieldfuse.errors import InputError


def rigid(quaternion: Array, translation: Array, where: str) -> Array:
    """(4, 4) from a quaternion (w, x, y, z) of any length and a translation.

    Raises:
        InputError: the quaternion has no direction.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        length = np.linalg.norm(quaternion)
    if not np.isfinite(length) or length < 1e-9:
        raise InputError(f"{where}: the pose's quaternion {quaternion.tolist()} is not a rotation; correct or remove this frame")
    w, x, y, z = quaternion / length
    out = np.eye(4)
    out[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    out[:3, 3] = translation
    return out
