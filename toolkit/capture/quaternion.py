"""Rotations as quaternions, as COLMAP and TUM write them."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

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
    out = np.eye(4)
    out[:3, :3] = Rotation.from_quat((quaternion / length)[[1, 2, 3, 0]]).as_matrix()
    out[:3, 3] = translation
    return out
