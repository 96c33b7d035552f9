"""Lens distortion: OpenCV's radial and tangential polynomial (Brown 1966), and its exact inverse.

With (x, y) the ideal point on the image plane (x/z, y/z) and r² = x² + y²:

    x' = x·(1 + k1·r² + k2·r⁴ + k3·r⁶) + 2·p1·x·y + p2·(r² + 2·x²)
    y' = y·(1 + k1·r² + k2·r⁴ + k3·r⁶) + p1·(r² + 2·y²) + 2·p2·x·y

The simulator sends each pixel's own ray through `invert`, so its pictures are never resampled.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from fieldfuse.camera import OPENCV, Intrinsics, lens_limit
from fieldfuse.errors import InputError

Tensor = torch.Tensor


@dataclass(frozen=True)
class Distortion:
    """Coefficients of the polynomial, as in OpenCV."""

    k1: float = -0.12
    k2: float = 0.03
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0


PRESETS = {
    "weak": Distortion(-0.04, 0.01),
    "medium": Distortion(-0.12, 0.03, 0.0008, -0.0006),
    "strong": Distortion(-0.28, 0.09, 0.002, -0.0015),
}


def forward(effect: Distortion, points: Tensor) -> Tensor:
    """Ideal image-plane points (..., 2) → where the lens puts them (..., 2)."""
    x, y = points[..., 0], points[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (effect.k1 + r2 * (effect.k2 + r2 * effect.k3))
    bent_x = x * radial + 2 * effect.p1 * x * y + effect.p2 * (r2 + 2 * x * x)
    bent_y = y * radial + effect.p1 * (r2 + 2 * y * y) + 2 * effect.p2 * x * y
    return torch.stack([bent_x, bent_y], dim=-1)


def invert(effect: Distortion, points: Tensor) -> Tensor:
    """Distorted image-plane points (..., 2) → ideal ones, by Newton's method in float64 (exact to rounding where one-to-one)."""
    target = points.double()
    ideal = target.clone()
    for _ in range(20):
        x, y = ideal[..., 0], ideal[..., 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (effect.k1 + r2 * (effect.k2 + r2 * effect.k3))
        slope = 2 * (effect.k1 + r2 * (2 * effect.k2 + 3 * r2 * effect.k3))  # of `radial` by r², times 2
        xx = radial + slope * x * x + 2 * effect.p1 * y + 6 * effect.p2 * x
        yy = radial + slope * y * y + 6 * effect.p1 * y + 2 * effect.p2 * x
        xy = slope * x * y + 2 * effect.p1 * x + 2 * effect.p2 * y  # symmetric
        off = forward(effect, ideal) - target
        scale = xx * yy - xy * xy
        step = torch.stack([yy * off[..., 0] - xy * off[..., 1], xx * off[..., 1] - xy * off[..., 0]], dim=-1) / scale[..., None]
        ideal = ideal - step
        if float(step.abs().max() if step.numel() else 0.0) < 1e-14:
            break
    return ideal.to(points.dtype)


def of(intrinsics: Intrinsics) -> Distortion:
    """The effect that a camera's lens is."""
    k1, k2, p1, p2, k3 = (*intrinsics.distortion, 0.0, 0.0, 0.0, 0.0, 0.0)[:5]
    return Distortion(k1, k2, p1, p2, k3)


def lens(effect: Distortion, intrinsics: Intrinsics) -> Intrinsics:
    """The pinhole camera with this lens before it.

    Raises:
        InputError: the polynomial turns back inside the picture, so that one pixel would see two directions.
    """
    values = (effect.k1, effect.k2, effect.p1, effect.p2, effect.k3)
    out = replace(intrinsics, lens=OPENCV, distortion=values if effect.k3 else values[:4])
    corners = torch.tensor([[0.0, 0.0], [0, intrinsics.height], [intrinsics.width, 0], [intrinsics.width, intrinsics.height]])
    place = (corners.double() - torch.tensor([intrinsics.cx, intrinsics.cy])) / torch.tensor([intrinsics.fx, intrinsics.fy])
    ideal = invert(effect, place)
    radius = float(ideal.norm(dim=1).max())
    if not (forward(effect, ideal) - place).abs().max() < 1e-9 or not lens_limit(out, radius) >= radius:
        raise InputError(
            f"the lens distortion k1={effect.k1:g}, k2={effect.k2:g} turns back inside the picture; "
            "use smaller values or a narrower field of view"
        )
    return out
