"""Vignetting: light falls off towards the corners as under the cos⁴ law of a simple lens.

    L' = L · V(r),    V(r) = (1 + a·r²)⁻²,    a = corner^(−1/2) − 1

r is the distance from the optical axis in units of half the picture's diagonal, so V(0) = 1 (the gauge) and V(1) = `corner`.
With tan θ = √a · r this is cos⁴ θ.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from toolkit.camera import Intrinsics

Tensor = torch.Tensor


@dataclass(frozen=True)
class Vignetting:
    """Parameters of the effect."""

    corner: float = 0.6  # share of the light that is left at half a diagonal from the axis


PRESETS = {"weak": Vignetting(0.85), "medium": Vignetting(0.62), "strong": Vignetting(0.35)}


def falloff(effect: Vignetting, radius: Tensor) -> Tensor:
    """V at distances from the axis in half diagonals."""
    return (1 + (effect.corner**-0.5 - 1) * radius.square()) ** -2


def radii(intrinsics: Intrinsics) -> Tensor:
    """(H, W) float32 distance of pixel centres from the principal point, in half diagonals."""
    x = torch.arange(intrinsics.width) + 0.5 - intrinsics.cx
    y = torch.arange(intrinsics.height) + 0.5 - intrinsics.cy
    half = 0.5 * (intrinsics.width**2 + intrinsics.height**2) ** 0.5
    return torch.hypot(x[None], y[:, None]).float() / half


def forward(effect: Vignetting, linear: Tensor, radius: Tensor) -> Tensor:
    """Linear light (H, W, 3) as it arrives on the sensor; `radius` (H, W) from `radii`."""
    return linear * falloff(effect, radius)[..., None]


def invert(effect: Vignetting, linear: Tensor, radius: Tensor) -> Tensor:
    """What `forward` was given; exact where nothing was clipped afterwards."""
    return linear / falloff(effect, radius)[..., None]
