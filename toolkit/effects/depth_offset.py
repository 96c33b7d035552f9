"""A depth camera that does not stand where the camera of the pictures does, in a capture that takes both for one.

    X_d = R X + t,    R = R_x(down) · R_y(right) · R_z(roll)

X is a point in the axes of the picture's camera, X_d in the depth camera's, t in metres. Two cameras in one housing stand some
centimetres apart and are not quite parallel; a capture whose depth was not brought to its pictures has this between them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from fieldfuse.camera import Array


@dataclass(frozen=True)
class DepthOffset:
    """Parameters of the effect: metres, and degrees about the axes of the picture's camera."""

    x: float = 0.025
    y: float = 0.002
    z: float = -0.004
    down: float = 0.3
    right: float = -0.6
    roll: float = 0.4


PRESETS = {
    "weak": DepthOffset(0.01, 0.0, 0.002, 0.1, 0.2, -0.1),
    "medium": DepthOffset(),
    "strong": DepthOffset(-0.06, 0.01, 0.01, -0.8, 1.2, 1.0),
}


def forward(effect: DepthOffset) -> Array:
    """(4, 4) the depth camera from the picture's."""
    out = np.eye(4)
    out[:3, :3] = Rotation.from_euler("XYZ", [effect.down, effect.right, effect.roll], degrees=True).as_matrix()
    out[:3, 3] = effect.x, effect.y, effect.z
    return out
