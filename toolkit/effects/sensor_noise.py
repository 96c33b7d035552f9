"""Sensor noise: shot noise of the light and read noise of the electronics, in linear light.

With W the electrons of a white pixel and σ_r the read noise in electrons,

    L' = (Poisson(W · L) + Normal(0, σ_r²)) / W,    variance L / W + (σ_r / W)²

independently for every pixel and channel; light above 1 fills the well and is clipped first.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fieldfuse.camera import Array


@dataclass(frozen=True)
class SensorNoise:
    """Parameters of the effect."""

    well: float = 1500.0  # electrons of a white pixel: the fewer, the noisier
    read: float = 6.0  # electrons


PRESETS = {"weak": SensorNoise(6000.0, 3.0), "medium": SensorNoise(1500.0, 6.0), "strong": SensorNoise(350.0, 8.0)}


def forward(effect: SensorNoise, linear: Array, rng: np.random.Generator) -> Array:
    """Linear light (H, W, 3) → float32 of the same shape with noise; it can be a little below 0."""
    electrons = rng.poisson(np.clip(linear, 0, 1).astype(np.float64) * effect.well)
    return np.asarray((electrons + rng.normal(0, effect.read, linear.shape)) / effect.well, dtype=np.float32)
