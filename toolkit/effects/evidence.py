"""What speaks for an effect in a capture: a number with a threshold and a sentence, from points that several pictures show.

All models here are linear in log₂ light: the light that observation o of point p in frame f shows is

    y_o = a_p + g_f + s_o + noise

with a_p the point's own, g_f the frame's, and s_o what the effect adds. `without_points_and_frames` takes a_p and g_f out of any such
quantity by weighted least squares, so that what is left can only be explained by s_o or is noise.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from fieldfuse.camera import Array

DARKEST, BRIGHTEST = 0.01, 0.85  # linear light between which a colour tells its exposure: not noise, not clipped
ROUNDS = 6  # of reweighting
TUNING = 2.0  # residuals beyond this many deviations count less (Huber)
POINTS_A_CHUNK = 2048


@dataclass(frozen=True)
class Evidence:
    """What was found about one effect.

    Attributes:
        number: in the unit that `reason` tells; what chance can explain is already taken off.
        parameters: what the effect would be, for its `invert`; plain data.
    """

    effect: str
    number: float
    threshold: float
    reason: str
    parameters: dict[str, Any] = field(default_factory=dict)

    @property
    def found(self) -> bool:
        return self.number > self.threshold


@dataclass(frozen=True)
class Tracks:
    """Observations of points that several pictures show, one row each."""

    linear: Array  # (O, 3) linear light
    frame: Array  # (O,) int, 0 … F − 1
    point: Array  # (O,) int, 0 … P − 1
    radius: Array  # (O,) distance from the principal point in half diagonals

    def usable(self) -> Tracks:
        """Without what is too dark or clipped, and without points that are then seen only once."""
        keep = ((self.linear > DARKEST) & (self.linear < BRIGHTEST)).all(1)
        counts = np.bincount(self.point[keep], minlength=int(self.point.max(initial=-1)) + 1)
        keep &= counts[self.point] > 1
        point = np.unique(self.point[keep], return_inverse=True)[1]
        return Tracks(self.linear[keep], self.frame[keep], point, self.radius[keep])


def without_points_and_frames(values: Array, tracks: Tracks, weight: Array, frames: int) -> tuple[Array, Array]:
    """Least squares of values (O, C) on one constant a point and one a frame (frames have mean 0).

    Returns:
        what is left (O, C), and the frames' constants (frames, C).
    """
    points = int(tracks.point.max(initial=-1)) + 1
    per_point = np.maximum(np.bincount(tracks.point, weight, points), 1e-12)
    mean = np.stack([np.bincount(tracks.point, weight * column, points) for column in values.T], axis=1) / per_point[:, None]
    centred = values - mean[tracks.point]
    matrix = np.diag(np.bincount(tracks.frame, weight, frames).astype(np.float64))
    order = np.argsort(tracks.point, kind="stable")
    ends = np.searchsorted(tracks.point[order], np.arange(0, points + POINTS_A_CHUNK, POINTS_A_CHUNK))
    for start, stop in pairwise(ends):
        rows = order[start:stop]
        if len(rows):
            seen = np.zeros((frames, POINTS_A_CHUNK))
            np.add.at(seen, (tracks.frame[rows], tracks.point[rows] % POINTS_A_CHUNK), weight[rows])
            total = seen.sum(0)
            matrix -= (seen / np.maximum(total, 1e-12)) @ seen.T
    right = np.stack([np.bincount(tracks.frame, weight * column, frames) for column in centred.T], axis=1)
    # The pull towards 0 decides what no shared point ties together, and the common constant.
    constants = np.linalg.solve(matrix + (1e-6 * max(float(np.trace(matrix)) / max(frames, 1), 1e-9)) * np.eye(frames), right)
    constants -= constants.mean(0)
    left = values - constants[tracks.frame]
    mean = np.stack([np.bincount(tracks.point, weight * column, points) for column in left.T], axis=1) / per_point[:, None]
    return left - mean[tracks.point], constants


def robust(residual: Array) -> tuple[Array, float]:
    """Huber's weights (O,) for residuals (O,) or (O, C), and their deviation by the median (1.4826 · MAD)."""
    size = np.abs(residual) if residual.ndim == 1 else np.linalg.norm(residual, axis=1) / np.sqrt(residual.shape[1])
    deviation = 1.4826 * float(np.median(size)) if len(size) else 0.0
    return np.minimum(1.0, TUNING * max(deviation, 1e-9) / np.maximum(size, 1e-12)), deviation


@dataclass(frozen=True)
class HeldOut:
    """Evidence from patches of pictures, and how well what it says predicts held-out pictures.

    Attributes:
        least: relative fall of the error that counts.
        before, after: error of the patches in question in held-out pictures, in stops, without and with the effect; None: there are none.
    """

    evidence: Evidence
    least: float
    before: float | None = None
    after: float | None = None

    @property
    def found(self) -> bool:
        return self.evidence.found and self.before is not None and self.after is not None and self.after < (1 - self.least) * self.before
