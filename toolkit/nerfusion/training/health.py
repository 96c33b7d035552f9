"""Whether the networks are alive: numbers that tell when PSNR does not.

A dead encoder, gates stuck at their ends, or a fog that explains every picture equally well all train with a healthy-looking loss.
"""

from __future__ import annotations

import torch

from fieldfuse.nerfusion.losses import Traced, decibels, mean_likelihood
from fieldfuse.nerfusion.training.rays import TargetRays

Tensor = torch.Tensor
ALIVE = 0.1  # spatial deviation of features below this means that the encoder tells places no longer apart


def feature_deviation(features: Tensor) -> Tensor:
    """(V, C, H, W) maps → mean over pictures and channels of the standard deviation over the picture."""
    return features.detach().float().flatten(2).std(2).mean()


def saturation(gate: Tensor) -> float:
    """Share of a gate's values within 0.01 of 0 or 1."""
    gate = gate.detach()
    return float(((gate < 0.01) | (gate > 0.99)).float().mean()) if gate.numel() else 0.0


def opacity_histogram(opacity: Tensor) -> dict[str, Tensor]:
    """Shares of rays whose opacity is below a third, between, and above two thirds."""
    opacity = opacity.detach()
    low, high = (opacity < 1 / 3).float().mean().double(), (opacity > 2 / 3).float().mean().double()
    return {"opacity_low": low, "opacity_middle": (1 - low - high).clamp_min(0), "opacity_high": high}


def relative_depth_error(distance: Tensor, truth: Tensor) -> Tensor:
    """Median of |d − d*| / d* where the truth is known and the ray is not empty; not a number when there is none."""
    known = (truth > 0) & (distance > 0)
    return torch.where(known, (distance - truth).abs() / truth, torch.nan).nanmedian()


@torch.no_grad()
def rendering_health(traced: Traced, rays: TargetRays) -> dict[str, Tensor]:
    """PSNR, opacity, depth error and log depth likelihood of one rendering, left on its device; the last two are not numbers where no
    depth is known."""
    return {
        "psnr": decibels((traced.colour - rays.colour).square().mean()),
        **opacity_histogram(traced.opacity),
        "depth_likelihood": mean_likelihood(traced, rays.distance),
        "depth_error": relative_depth_error(traced.median_distance(), rays.distance),
    }
