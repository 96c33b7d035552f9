"""What is near a camera moves slowly: gradients of samples nearer than a bound r are multiplied by (t / r)², t their distance.

A camera samples the space before it the more densely the nearer, as 1 / t², so that what lies right before one, which few others see, is
the first to explain whatever they do not agree on: a bare wall, a highlight, a blurred corner. In views beside it that hangs in the air.
With the factor all distances up to the bound are learnt as fast as each other (Philip and Deschaintre, "Floaters no more: radiance field
gradient scaling for improved near-camera training", EGSR 2023). The paper that this toolkit follows has no such term.
"""

from __future__ import annotations

import torch

Tensor = torch.Tensor


def slowness(distance: Tensor, within: float) -> Tensor:
    """(samples,) factors in [0, 1] for gradients of samples at `distance` along their rays; `within` in the same units, 0: all 1."""
    return (distance.clamp_min(0.0) / within).clamp_max(1.0).square() if within > 0 else torch.ones_like(distance)
