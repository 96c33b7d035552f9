"""Motion blur: what the sensor gathers while the shutter is open and the camera moves, integrated in linear light.

    L' = (1 / E) ∫ L(t + τ) dτ,  τ from −E/2 to E/2  ≈  (1 / n) Σ_k L(t + E·((k + 0.5) / n − 0.5))

E is the exposure time; the midpoint rule with n samples is exact up to steps of (motion in pixels) / n.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from toolkit.camera import Array

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
