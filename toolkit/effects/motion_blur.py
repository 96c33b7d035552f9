"""Motion blur: what the sensor gathers while the shutter is open and the camera moves, integrated in linear light.

    L' = (1 / E) ∫ L(t + τ) dτ,  τ from −E/2 to E/2  ≈  (1 / n) Σ_k L(t + E·((k + 0.5) / n − 0.5))

E is the exposure time; the midpoint rule with n samples is exact up to steps of (motion in pixels) / n.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from fieldfuse.camera import Array
from fieldfuse.effects.evidence import ROUNDS, Evidence, Tracks, robust, without_points_and_frames

Tensor = torch.Tensor


@dataclass(frozen=True)
class MotionBlur:
    """Parameters of the effect."""

    exposure: float = 0.03  # seconds that the shutter is open
    samples: int = 9


PRESETS = {"weak": MotionBlur(0.012, 5), "medium": MotionBlur(0.03, 9), "strong": MotionBlur(0.07, 15)}


def instants(effect: MotionBlur) -> Array:
    """(samples,) float64 seconds relative to the middle of the exposure."""
    return np.asarray(effect.exposure * ((np.arange(effect.samples) + 0.5) / effect.samples - 0.5))


def forward(pictures: list[Tensor]) -> Tensor:
    """The mean of linear pictures taken at the `instants`, always summed in their order."""
    total = pictures[0].clone()
    for picture in pictures[1:]:
        total += picture
    return total / len(pictures)


THRESHOLD = 0.033  # factors of two of the slopes' energy
POWER = 2.0  # of a frame's sharpness: its weight in the fit, against that of sharp ones
FEWEST = 100
DARKEST, BRIGHTEST = 0.02, 0.6  # linear light of a patch: noise and clipping change slopes too, and exposure decides how much
TREND = 8  # frames from which on a slow trend is told from blur, which comes and goes


def _sharpness(energy: Array, distance: Array, frame: Array, point: Array, frames: int) -> tuple[Array, Array, Array]:
    """(frames,) factors of two of each frame's sharpness, and (O,) the weights of observations and what they leave."""
    tracks = Tracks(np.zeros((len(frame), 3)), frame, point, np.zeros(len(frame)))
    weight, constants, left = np.ones(len(frame)), np.zeros((frames, 1)), energy[:, None]
    for _ in range(ROUNDS):
        plain, _ = without_points_and_frames(np.stack([energy, distance], axis=1), tracks, weight, frames)
        bend = float((weight * plain[:, 1] ** 2).sum())
        power = float((weight * plain[:, 0] * plain[:, 1]).sum()) / bend if bend > 1e-9 else 0.0
        left, constants = without_points_and_frames((energy - power * distance)[:, None], tracks, weight, frames)
        weight, _ = robust(left[:, 0])
    return constants[:, 0], weight, left[:, 0]


def _trend(values: Array) -> Array:
    """(n,) the slow trend in the values (n,), of least absolute residuals: a few very blurred frames must not bend it."""
    steps, weight, trend = np.linspace(-1, 1, len(values)), np.ones(len(values)), values
    for _ in range(5 * ROUNDS):
        trend = np.polynomial.Polynomial.fit(steps, values, 2, w=np.sqrt(weight))(steps)
        weight = 1 / np.maximum(np.abs(values - trend), 0.01)
    return np.asarray(trend)


def evidence(slope: Array, depth: Array, frame: Array, point: Array, frames: int, linear: Array | None = None) -> Evidence:
    """Whether the same points are sharper in some frames than in others.

    The slopes' energy at an observation is the point's own, times the frame's sharpness, times a power of the depth (from nearby, slopes a
    pixel are gentler). Slow trends over the frames are no blur of a moving camera: they are taken out; the number is no larger than what
    two halves of the points agree on of how frames differ from their neighbours.

    Args:
        slope: (O,) mean square of the slopes of log light round the observation. depth: (O,) along z. frame, point: (O,).
        linear: (O, 3) light of the patch, as it was stored; what is dark or bright is left out. None: nothing is.

    Returns:
        `parameters["sharpness"]`: (frames,) factors of two of the energy, mean 0; 0 where nothing is told.
    """
    used = (slope > 1e-5) & (depth > 0)
    if linear is not None:
        used &= ((linear > DARKEST) & (linear < BRIGHTEST)).all(1)
    if int(used.sum()) < FEWEST or len(np.unique(frame[used])) < TREND:
        return Evidence("motion_blur", 0.0, THRESHOLD, "too few points are shared between pictures to compare their sharpness")
    number = np.unique(point[used], return_inverse=True)[1]
    every, energy, distance = frame[used], np.log2(slope[used]), np.log2(depth[used])
    constants, weight, left = _sharpness(energy, distance, every, number, frames)
    seen = np.bincount(every, weight, frames)
    told = seen > 0
    values = constants[told]
    steps = np.linspace(-1, 1, len(values))
    values = values - np.polynomial.Polynomial.fit(steps, values, 2)(steps)
    chance = float((float((weight * left**2).sum() / weight.sum()) / np.maximum(seen[told], 1)).mean())
    deviation = float(np.sqrt(max(float(np.mean(values**2)) - chance, 0.0)))
    halves = [
        _sharpness(energy[half], distance[half], every[half], np.unique(number[half], return_inverse=True)[1], frames)[0]
        for half in (number % 2 == 0, number % 2 == 1)
    ]
    jumps = [one[1:-1] - 0.5 * (one[2:] + one[:-2]) for one in halves]
    agreed = float(np.sqrt(max(float(np.mean(jumps[0] * jumps[1])), 0.0) / 1.5))  # 1.5: of independent frames, what such jumps add up to
    deviation = min(deviation, agreed)
    sharpness = np.zeros(frames)
    sharpness[told] = constants[told] - _trend(constants[told])
    return Evidence(
        "motion_blur",
        deviation,
        THRESHOLD,
        f"the slopes of the same points differ in energy by {deviation:.3f} factors of two (deviation over frames); "
        f"{THRESHOLD:g} or more speak for frames that are blurred by motion or focus",
        {"sharpness": sharpness.tolist()},
    )
