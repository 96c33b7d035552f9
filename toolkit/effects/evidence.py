"""What speaks for an effect in a capture: a number with a threshold and a sentence, from points that several images show.

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

ROUNDS = 6  # of reweighting
TUNING = 2.0  # residuals beyond this many deviations count less (Huber)
POINTS_A_CHUNK = 2048


@dataclass(frozen=True)
class Evidence:
    """What was found about one effect."""

    effect: str
    number: float  # in the unit that `reason` names; what chance can explain is already taken off
    threshold: float
    reason: str
    parameters: dict[str, Any] = field(default_factory=dict)  # of the effect as it would be; plain data

    @property
    def found(self) -> bool:
        return self.number > self.threshold


@dataclass(frozen=True)
class Finding:
    """What was found about one effect, and whether it is there."""

    effect: str
    number: float
    threshold: float
    reason: str
    there: bool  # the number is above its threshold, and held-out points agree by a margin
    before: float | None = None  # what held-out points are off without the effect, in `unit`; None where nothing is fitted
    after: float | None = None  # and with it
    unit: str = ""

    def to_dict(self) -> dict[str, Any]:
        out: dict[str, Any] = {
            "effect": self.effect,
            "number": round(float(self.number), 4),
            "threshold": self.threshold,
            "there": bool(self.there),  # NumPy's own truth values are not JSON
            "reason": self.reason,
        }
        if self.before is not None and self.after is not None:
            before, after = float(self.before), float(self.after)
            out["held_out"] = {"before": round(before, 4), "after": round(after, 4), "unit": self.unit}
            if before > 0 and after > 0:
                out["held_out"]["decibels"] = round(20 * float(np.log10(before / after)), 2)
        return out


def without_points_and_frames(values: Array, frame: Array, point: Array, weight: Array, frames: int) -> tuple[Array, Array]:
    """Least squares of values (O, C) on one constant a point and one a frame (frames have mean 0).

    Args:
        frame, point: (O,) int of each observation. weight: (O,).

    Returns:
        what is left (O, C), and the frames' constants (frames, C).
    """
    points = int(point.max(initial=-1)) + 1
    per_point = np.maximum(np.bincount(point, weight, points), 1e-12)
    mean = np.stack([np.bincount(point, weight * column, points) for column in values.T], axis=1) / per_point[:, None]
    centred = values - mean[point]
    matrix = np.diag(np.bincount(frame, weight, frames).astype(np.float64))
    order = np.argsort(point, kind="stable")
    ends = np.searchsorted(point[order], np.arange(0, points + POINTS_A_CHUNK, POINTS_A_CHUNK))
    for start, stop in pairwise(ends):
        rows = order[start:stop]
        if len(rows):
            seen = np.zeros((frames, POINTS_A_CHUNK))
            np.add.at(seen, (frame[rows], point[rows] % POINTS_A_CHUNK), weight[rows])
            matrix -= (seen / np.maximum(seen.sum(0), 1e-12)) @ seen.T
    right = np.stack([np.bincount(frame, weight * column, frames) for column in centred.T], axis=1)
    # The pull towards 0 decides what no shared point ties together, and the common constant.
    constants = np.linalg.solve(matrix + (1e-6 * max(float(np.trace(matrix)) / max(frames, 1), 1e-9)) * np.eye(frames), right)
    constants -= constants.mean(0)
    left = values - constants[frame]
    mean = np.stack([np.bincount(point, weight * column, points) for column in left.T], axis=1) / per_point[:, None]
    return left - mean[point], constants


def robust_weights(residual: Array) -> Array:
    """Huber's weights (O,) for residuals (O,) or (O, C), whose deviation is that of the median (1.4826 · MAD)."""
    size = np.abs(residual) if residual.ndim == 1 else np.linalg.norm(residual, axis=1) / np.sqrt(residual.shape[1])
    deviation = 1.4826 * float(np.median(size)) if len(size) else 0.0
    return np.minimum(1.0, TUNING * max(deviation, 1e-9) / np.maximum(size, 1e-12))


def median_of_finite(values: Array, least: int) -> Array:
    """Median over the first axis of what is finite; NaN where this is less than `least`."""
    ordered, count = np.sort(values, axis=0), np.isfinite(values).sum(0)  # NaN last
    low, high = np.maximum((count - 1) // 2, 0), np.minimum(count // 2, len(values) - 1)
    middle = 0.5 * (np.take_along_axis(ordered, low[None], 0)[0] + np.take_along_axis(ordered, high[None], 0)[0])
    return np.where(count >= least, middle, np.nan)


# ------------------------------------------------------------------------------------------------- sharpness

BLUR = "motion_blur"
BLURRED = 0.033  # factors of two of the slopes' energy
FEWEST_SLOPES = 100  # observations
DARK, BRIGHT = 0.02, 0.6  # linear light of a patch: noise and clipping change slopes too, and exposure decides how much
TREND = 8  # frames from which on a slow trend is separated from blur, which comes and goes


def _sharpness(energy: Array, distance: Array, frame: Array, point: Array, frames: int) -> tuple[Array, Array, Array]:
    """(frames,) factors of two of each frame's sharpness, and (O,) the weights of observations and what they leave."""
    weight, constants, left = np.ones(len(frame)), np.zeros((frames, 1)), energy[:, None]
    for _ in range(ROUNDS):
        plain, _ = without_points_and_frames(np.stack([energy, distance], axis=1), frame, point, weight, frames)
        bend = float((weight * plain[:, 1] ** 2).sum())
        power = float((weight * plain[:, 0] * plain[:, 1]).sum()) / bend if bend > 1e-9 else 0.0
        left, constants = without_points_and_frames((energy - power * distance)[:, None], frame, point, weight, frames)
        weight = robust_weights(left[:, 0])
    return constants[:, 0], weight, left[:, 0]


def blur_evidence(slope: Array, depth: Array, frame: Array, point: Array, frames: int, linear: Array) -> Evidence:
    """Whether the same points are sharper in some frames than in others.

    The slopes' energy at an observation is the point's own, times the frame's sharpness, times a power of the depth (from nearby, slopes a
    pixel are gentler). Slow trends over the frames are no blur of a moving camera: they are taken out; the number is no larger than what
    two halves of the points agree on of how frames differ from their neighbours.

    Args:
        slope: (O,) mean square of the slopes of log light round the observation. depth: (O,) along z. frame, point: (O,).
        linear: (O, 3) light of the patch, as it was stored; what is dark or bright is excluded.

    Returns:
        `parameters["sharpness"]`: (frames,) factors of two of the energy, mean 0; 0 where nothing was measured.
    """
    used = (slope > 1e-5) & (depth > 0) & ((linear > DARK) & (linear < BRIGHT)).all(1)
    if int(used.sum()) < FEWEST_SLOPES or len(np.unique(frame[used])) < TREND:
        return Evidence(BLUR, 0.0, BLURRED, "too few points are shared between pictures to compare their sharpness")
    number = np.unique(point[used], return_inverse=True)[1]
    every, energy, distance = frame[used], np.log2(slope[used]), np.log2(depth[used])
    constants, weight, left = _sharpness(energy, distance, every, number, frames)
    seen = np.bincount(every, weight, frames)
    known = seen > 0
    values = constants[known]
    steps = np.linspace(-1, 1, len(values))
    chance = float((float((weight * left**2).sum() / weight.sum()) / np.maximum(seen[known], 1)).mean())
    spread = float(np.mean((values - np.polynomial.Polynomial.fit(steps, values, 2)(steps)) ** 2))
    deviation = float(np.sqrt(max(spread - chance, 0.0)))
    halves = [
        _sharpness(energy[half], distance[half], every[half], np.unique(number[half], return_inverse=True)[1], frames)[0]
        for half in (number % 2 == 0, number % 2 == 1)
    ]
    jumps = [one[1:-1] - 0.5 * (one[2:] + one[:-2]) for one in halves]
    agreed = float(np.sqrt(max(float(np.mean(jumps[0] * jumps[1])), 0.0) / 1.5))  # 1.5: of independent frames, what such jumps add up to
    deviation = min(deviation, agreed)
    trend, pull = values, np.ones(len(values))
    for _ in range(5 * ROUNDS):  # of least absolute residuals: a few very blurred frames must not bend the slow trend
        trend = np.polynomial.Polynomial.fit(steps, values, 2, w=np.sqrt(pull))(steps)
        pull = 1 / np.maximum(np.abs(values - trend), 0.01)
    sharpness = np.zeros(frames)
    sharpness[known] = values - trend
    reason = (
        f"the slopes of the same points differ in energy by {deviation:.3f} factors of two (deviation over frames); "
        f"{BLURRED:g} or more speak for frames that are blurred by motion or focus"
    )
    return Evidence(BLUR, deviation, BLURRED, reason, {"sharpness": sharpness.tolist()})
