"""The loss terms of a fit that are not the colour error, and how strongly each counts. The paper has none of them.

**Depth.** Light is to end where an image's depth is known, by a sensor or by matching. Of a ray whose surface lies at the distance d, each
sample with weight w at the distance t costs

    w · (min(max(|t − d| − e d, 0) / (r d), 1) − 1):

nothing beyond the reach r d, the less the nearer it lies, and the same wherever it is as near as the noise e d. So weight is drawn to the
surface whatever lies far from it, a depth that is wrong costs no more than one that is missing by far, and where in its noise the surface
is, colours decide. `Trust` holds how strongly, and for how long.

**Near cameras.** Gradients of samples nearer than a bound r are multiplied by (t / r)², t their distance. A camera samples the space before
it the more densely the nearer, as 1 / t², so that what lies right before one, which few others see, is the first to explain whatever they
do not agree on; in views beside it that hangs in the air. With the factor all distances up to the bound are learnt as fast as each other
(Philip and Deschaintre, "Floaters no more: radiance field gradient scaling for improved near-camera training", EGSR 2023).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from fieldfuse.backends.constants import REACH as REACH

Tensor = torch.Tensor


@dataclass(frozen=True)
class Trust:
    """How far the depth of images is believed."""

    noise: float  # e: share of the distance by which it may be off: noise, and images that are not quite registered
    weight: float  # of the term at the beginning of a fit, in units of `fit.depth` …
    last: float  # … and the share of it at the end: depth decides early where surfaces are, colours how they look …
    rays: float = 1e7  # … which it comes to after so many rays, when the fit has more

    def share(self, done: float, rays: float) -> float:
        """Share of the weight at `done` (0 … 1) of a fit, after so many rays. It goes by what was fitted, not by how long the fit is meant
        to be: a long one would hold surfaces where rough depth has them, long after colours are the better guide."""
        return float(self.last ** min(1.0, max(done, rays / self.rays)))


FINE = Trust(noise=0.004, weight=1.0, last=0.05)  # by a sensor, or by matching images in full
ROUGH = Trust(noise=0.01, weight=2.0, last=0.0025)  # by matching small ones


@dataclass(frozen=True)
class Rates:
    """Step sizes and loss weights of one step."""

    density: float
    feature: float
    decoder: float
    distortion: float
    opacity: float = 0.0  # weight of the mean of (1 - opacity)², for captures in which every ray ends somewhere
    colour_threshold: float = 3e-3  # samples of smaller weight are neither decoded nor given a gradient
    depth: float = 0.0  # weight of the mean of the depth term, for rays whose surface is known
    depth_noise: float = FINE.noise  # share of its distance by which such a surface may be off
    slow_within: float = 0.0  # working units; gradients of samples nearer than this are scaled down, 0: none


def depth_gradient(distance: Tensor, target: Tensor, noise: float) -> Tensor:
    """(samples,) gradient of the term for the samples' weights, from their distances and those of their rays' surfaces (0: unknown)."""
    away = ((distance - target).abs() / target.clamp_min(1e-9) - noise) / REACH
    return torch.where(target > 0, away.clamp(0.0, 1.0) - 1.0, torch.zeros_like(away))


def near_gradient_scaling(distance: Tensor, within: float) -> Tensor:
    """(samples,) factors in [0, 1] for gradients of samples at `distance` along their rays; `within` in the same units, 0: all 1."""
    return (distance.clamp_min(0.0) / within).clamp_max(1.0).square() if within > 0 else torch.ones_like(distance)
