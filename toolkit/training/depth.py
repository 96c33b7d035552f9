"""The depth term of a fit: light is to end where a picture's depth is known, by a sensor or by matching; the paper has no such term.

Of a ray whose surface lies at the distance d, each sample with weight w at the distance t costs

    w · (min(max(|t − d| − e d, 0) / (r d), 1) − 1):

nothing beyond the reach r d, the less the nearer it lies, and the same wherever it is as near as can be told, e d. So weight is drawn
to the surface whatever lies far from it, a depth that is wrong costs no more than one that is missing by far, and where in its noise the
surface is, colours decide. `Trust` tells how strongly, and for how long.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from fieldfuse.backends.constants import REACH as REACH
from fieldfuse.camera import Array, Intrinsics

Tensor = torch.Tensor


@dataclass(frozen=True)
class Trust:
    """How far the depth of pictures is believed."""

    noise: float  # e: share of the distance by which it may be off: noise, and pictures that are not quite registered
    weight: float  # of the term at the beginning of a fit, in units of `fit.depth` …
    last: float  # … and the share of it at the end: depth decides early where surfaces are, colours how they look …
    rays: float = 1e7  # … which it comes to after so many rays, when the fit has more

    def share(self, done: float, rays: float) -> float:
        """Share of the weight at `done` (0 … 1) of a fit, after so many rays. It goes by what was fitted, not by how long the fit is meant
        to be: a long one would hold surfaces where rough depth has them, long after colours know better."""
        return float(self.last ** min(1.0, max(done, rays / self.rays)))


FINE = Trust(noise=0.004, weight=1.0, last=0.05)  # by a sensor, or by matching pictures in full
ROUGH = Trust(noise=0.01, weight=2.0, last=0.0025)  # by matching small ones


def ray_distances(depth: Array, camera: Intrinsics) -> Array:
    """(H, W) float32 depth along z → distance along each pixel's ray; 0, missing, stays 0. The camera is a pinhole."""
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    length = np.sqrt(1 + x[None] ** 2 + y[:, None] ** 2)
    return np.asarray(np.where(np.isfinite(depth) & (depth > 0), depth * length, 0), dtype=np.float32)


def depth_gradient(distance: Tensor, target: Tensor, noise: float) -> Tensor:
    """(samples,) gradient of the term for the samples' weights, from their distances and those of their rays' surfaces (0: unknown)."""
    away = ((distance - target).abs() / target.clamp_min(1e-9) - noise) / REACH
    return torch.where(target > 0, away.clamp(0.0, 1.0) - 1.0, torch.zeros_like(away))
