"""Whether the networks are alive: numbers that tell when PSNR does not.

A dead encoder, gates stuck at their ends, or a fog that explains every picture equally well all train with a healthy-looking loss.
"""

from __future__ import annotations

import torch

from toolkit.training.nerfusion.losses import Traced, depth_likelihood, psnr
from toolkit.training.nerfusion.rays import TargetRays

Tensor = torch.Tensor
ALIVE = 0.1  # spatial deviation of features below this means that the encoder tells places no longer apart


def feature_deviation(features: Tensor) -> float:
    """(V, C, H, W) maps → mean over pictures and channels of the standard deviation over the picture."""
    return float(features.detach().float().flatten(2).std(2).mean())


def saturation(gate: Tensor) -> float:
    """Share of a gate's values within 0.01 of 0 or 1."""
    gate = gate.detach()
    return float(((gate < 0.01) | (gate > 0.99)).float().mean()) if gate.numel() else 0.0


def opacity_histogram(opacity: Tensor) -> dict[str, float]:
    """Shares of rays whose opacity is below a third, between, and above two thirds."""
    opacity = opacity.detach()
    low, high = float((opacity < 1 / 3).float().mean()), float((opacity > 2 / 3).float().mean())
    return {"opacity_low": low, "opacity_middle": max(0.0, 1 - low - high), "opacity_high": high}


def relative_depth_error(distance: Tensor, truth: Tensor) -> float | None:
    """Median of |d − d*| / d* where the truth is known and the ray is not empty; None when there is none."""
    known = (truth > 0) & (distance > 0)
    if not bool(known.any()):
        return None
    return float(((distance - truth).abs() / truth)[known].median())


def rendering_health(traced: Traced, rays: TargetRays, prefix: str = "") -> dict[str, float]:
    """PSNR, opacity, depth error and log depth likelihood of one rendering. `prefix` goes before each name."""
    with torch.no_grad():
        out = {"psnr": psnr((traced.colour - rays.colour).square().mean()), **opacity_histogram(traced.opacity)}
        likelihood, _ = depth_likelihood(traced, rays.distance)
        if len(likelihood):
            out["depth_likelihood"] = float(likelihood.mean())
        error = relative_depth_error(traced.median_distance(), rays.distance)
        if error is not None:
            out["depth_error"] = error
    return {prefix + name: value for name, value in out.items()}
