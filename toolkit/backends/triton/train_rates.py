"""Where the kernels of a step find its step sizes and the weights of its losses."""

from __future__ import annotations

from typing import TYPE_CHECKING

import triton.language as tl

if TYPE_CHECKING:
    from fieldfuse.training.losses import Rates


R_DENSITY, R_FEATURE, R_DECODER, R_DISTORTION, R_OPACITY, R_DEPTH, R_NOISE, R_SLOW = (tl.constexpr(v) for v in range(8))
RATES = 8


def told(rates: Rates) -> list[float]:
    """What kernels read of `rates`, each in its place."""
    steps = [rates.density, rates.feature, rates.decoder]
    losses = [rates.distortion, rates.opacity, rates.depth, rates.depth_noise, rates.slow_within]
    return [*steps, *losses]
