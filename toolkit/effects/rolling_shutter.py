"""Rolling shutter: the rows of a picture are exposed one after the other, each from where the camera is by then.

Row v (0 … H − 1, pixel centres at v + 0.5) of a frame at time t is exposed at

    t_v = t + readout · ((v + 0.5) / H − 0.5)

so the middle of the picture belongs to the frame's own time and pose.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fieldfuse.camera import Array, Intrinsics, project
from fieldfuse.effects.evidence import ROUNDS, Evidence, robust


@dataclass(frozen=True)
class RollingShutter:
    """Parameters of the effect."""

    readout: float = 0.018  # seconds from the first row to the last


PRESETS = {"weak": RollingShutter(0.008), "medium": RollingShutter(0.018), "strong": RollingShutter(0.033)}


def forward(effect: RollingShutter, seconds: float, height: int) -> Array:
    """(H,) float64 time of each row of a frame at `seconds`."""
    return np.asarray(seconds + effect.readout * ((np.arange(height) + 0.5) / height - 0.5))


THRESHOLD = 0.003  # seconds
FEWEST = 40


def image_velocity(intrinsics: Intrinsics, poses: Array, seconds: float, points: Array) -> Array:
    """(N, 2) pixels a second at which world points (N, 3) move in a picture.

    Args:
        poses: (2, 4, 4) world_from_camera before and after it (its neighbours).
        seconds: time between the two.
    """
    before, _ = project(intrinsics, poses[0], points)
    after, _ = project(intrinsics, poses[1], points)
    return (after - before) / seconds


def evidence(residuals: Array, rows: Array, velocity: Array, height: int) -> Evidence:
    """Whether points lie ahead of where they should in late rows and behind in early ones.

    With u the share of the readout at a row, (row / H − 1/2), a rolling shutter shifts points by readout · u · velocity: the readout is the
    slope of the residuals on u · velocity, robustly. Three standard errors are taken off.

    Args:
        residuals: (N, 2) pixels, observed minus predicted by poses that know no rolling shutter.
        rows: (N,) observed vertical place in pixels, from 0 to `height`.
        velocity: (N, 2) from `image_velocity`.
    """
    known = np.isfinite(residuals).all(1) & np.isfinite(velocity).all(1)
    if int(known.sum()) < FEWEST:
        return Evidence("rolling_shutter", 0.0, THRESHOLD, "too few points are seen to compare rows")
    shift = velocity[known] * (rows[known] / height - 0.5)[:, None]
    observed, weight, readout, error = residuals[known], np.ones(int(known.sum())), 0.0, np.inf
    for _ in range(ROUNDS):
        bend = float((weight * (shift**2).sum(1)).sum())
        if bend < 1e-9:
            break
        readout = float((weight * (shift * observed).sum(1)).sum()) / bend
        rest = observed - readout * shift
        error = float(np.sqrt((weight * (rest**2).sum(1)).sum() / (2 * weight.sum()) / bend))
        weight, _ = robust(rest)
    number = max(abs(readout) - 3 * error, 0.0) if np.isfinite(error) else 0.0
    return Evidence(
        "rolling_shutter",
        number,
        THRESHOLD,
        f"points are displaced along their motion as by a readout of {1000 * readout:.1f} ms from the first row to the last; "
        f"{1000 * THRESHOLD:g} ms or more, beyond chance, speak for a rolling shutter",
        {"readout": readout},
    )
