"""Rolling shutter: the rows of a picture are exposed one after the other, each from where the camera is by then.

Row v (0 … H − 1, pixel centres at v + 0.5) of a frame at time t is exposed at

    t_v = t + readout · ((v + 0.5) / H − 0.5)

so the middle of the picture belongs to the frame's own time and pose.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fieldfuse.camera import Array


@dataclass(frozen=True)
class RollingShutter:
    """Parameters of the effect."""

    readout: float = 0.018  # seconds from the first row to the last


PRESETS = {"weak": RollingShutter(0.008), "medium": RollingShutter(0.018), "strong": RollingShutter(0.033)}


def forward(effect: RollingShutter, seconds: float, height: int) -> Array:
    """(H,) float64 time of each row of a frame at `seconds`."""
    return np.asarray(seconds + effect.readout * ((np.arange(height) + 0.5) / height - 0.5))
