"""Exposure and white-balance drift: every frame's light is multiplied by gains of its own, one a channel.

    L'_f = g_f · L,    log2 g_f = e_f + (r_f, 0, b_f)

e_f in stops (automatic exposure), r_f and b_f the drift of red and blue against green (automatic white balance). Over a capture each of
the three is a smooth random curve of mean 0 and of the deviation that the parameters name: the gauge is fixed, a common factor is no
drift. Applied in linear light, before clipping.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from fieldfuse.camera import Array
from fieldfuse.effects.evidence import ROUNDS, Evidence, Tracks, robust, without_points_and_frames

Tensor = torch.Tensor


@dataclass(frozen=True)
class Exposure:
    """Parameters of the effect."""

    stops: float = 0.3  # deviation of the exposure over the capture, in factors of two
    tint: float = 0.06  # deviation of red and of blue against green, in factors of two
    waves: int = 4  # fastest wave over the capture


PRESETS = {"weak": Exposure(0.12, 0.03), "medium": Exposure(0.35, 0.08), "strong": Exposure(0.8, 0.2)}


def draw(effect: Exposure, frames: int, rng: np.random.Generator) -> Array:
    """(frames, 3) float64 gains of red, green and blue."""
    s = (np.arange(frames) + 0.5) / frames
    wave = np.arange(1, effect.waves + 1)
    phase, weight = rng.uniform(0, 2 * np.pi, (3, effect.waves)), rng.normal(0, 1, (3, effect.waves))
    curves = (weight[..., None] * np.sin(np.pi * wave[:, None] * s + phase[..., None])).sum(1)  # (3, frames)
    curves -= curves.mean(1, keepdims=True)
    curves /= np.maximum(curves.std(1, keepdims=True), 1e-9)
    if frames < 3:  # too short to drift
        curves[:] = 0
    level, red, blue = curves * np.array([[effect.stops], [effect.tint], [effect.tint]])
    return np.asarray(np.exp2(np.stack([level + red, level, level + blue], axis=1)))


def forward(linear: Tensor, gain: Tensor) -> Tensor:
    """Linear light (..., 3) times the frame's gains (3,)."""
    return linear * gain


THRESHOLD = 0.04  # stops
FEWEST = 30  # observations without which nothing can be told


def evidence(tracks: Tracks, frames: int) -> Evidence:
    """Whether frames differ in exposure or white balance: the deviation over the frames of the gains that shared points ask for.

    The gains' own uncertainty is taken off the deviation. `parameters["gain"]` are (frames, 3) gains with geometric mean 1.
    """
    used = tracks.usable()
    if len(used.frame) < FEWEST:
        return Evidence("exposure", 0.0, THRESHOLD, "too few points are shared between pictures to compare their exposure")
    light, weight = np.log2(used.linear), np.ones(len(used.frame))
    constants = np.zeros((frames, 3))
    for _ in range(ROUNDS):
        left, constants = without_points_and_frames(light, used, weight, frames)
        weight, _ = robust(left)
    seen = np.bincount(used.frame, weight, frames)
    noise = (weight[:, None] * left**2).sum(0) / max(float(weight.sum()), 1e-9)  # (3,) variance of one observation
    told = seen > 0
    chance = (noise / np.maximum(seen[told, None], 1)).mean(0)
    deviation = np.sqrt(np.maximum((constants[told] ** 2).mean(0) - chance, 0))
    number = float(deviation.max())
    return Evidence(
        "exposure",
        number,
        THRESHOLD,
        f"the same points differ by {number:.3f} stops (deviation over frames) between pictures; {THRESHOLD:g} or more speak for drift",
        {"gain": np.exp2(constants).tolist()},
    )
