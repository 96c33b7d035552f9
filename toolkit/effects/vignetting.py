"""Vignetting: light falls off towards the corners as under the cos⁴ law of a simple lens.

    L' = L · V(r),    V(r) = (1 + a·r²)⁻²,    a = corner^(−1/2) − 1

r is the distance from the optical axis in units of half the picture's diagonal, so V(0) = 1 (the gauge) and V(1) = `corner`.
With tan θ = √a · r this is cos⁴ θ.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from fieldfuse.camera import Intrinsics
from fieldfuse.effects.evidence import ROUNDS, Evidence, Tracks, robust, without_points_and_frames

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


THRESHOLD = 0.05  # share of the light
FEWEST = 60
STRONGEST = 20.0  # of a: a corner with a four-hundredth of the light


def evidence(tracks: Tracks, frames: int) -> Evidence:
    """Whether points get darker as they move towards the corners, in whichever frame: the share of light lost at half a diagonal.

    a of V(r) = (1 + a·r²)⁻² is found by Gauss-Newton after each point's and each frame's own light is taken out; three standard errors
    are taken off the loss. `parameters["corner"]` is V(1).
    """
    used = tracks.usable()
    if len(used.frame) < FEWEST:
        return Evidence("vignetting", 0.0, THRESHOLD, "too few points are shared between pictures to compare middle and corners")
    light = np.log2(used.linear).mean(1, keepdims=True)
    square, weight, a = used.radius**2, np.ones(len(used.frame)), 0.0
    error = np.inf
    for _ in range(2 * ROUNDS):
        expected = -2 * np.log2(1 + a * square)
        slope = -2 / np.log(2) * square / (1 + a * square)
        left, _ = without_points_and_frames(np.stack([light[:, 0] - expected, slope], axis=1), used, weight, frames)
        bend = float((weight * left[:, 1] ** 2).sum())
        if bend < 1e-9:  # no point moves towards the corner
            break
        step = float((weight * left[:, 0] * left[:, 1]).sum()) / bend
        rest = left[:, 0] - step * left[:, 1]
        error = float(np.sqrt((weight * rest**2).sum() / weight.sum() / bend))
        a = float(np.clip(a + step, -0.5, STRONGEST))
        weight, _ = robust(rest)
    sure = a - 3 * error if np.isfinite(error) else 0.0
    number = float(1 - (1 + max(sure, 0.0)) ** -2)
    corner = float((1 + max(a, 0.0)) ** -2)
    return Evidence(
        "vignetting",
        number,
        THRESHOLD,
        f"points lose at least {100 * number:.0f}% of their light on the way to the corner; "
        f"{100 * THRESHOLD:g}% or more speak for vignetting",
        {"corner": corner},
    )


def corrected(tracks: Tracks, corner: float) -> Tracks:
    """The tracks without a vignetting of this corner: `exposure.evidence` wants them so, because points that move towards the corners
    of one frame get darker in it as if it were exposed less. (The other way round there is nothing to do: frames' gains are taken out.)
    """
    share = falloff(Vignetting(corner), torch.from_numpy(tracks.radius)).numpy()
    return replace(tracks, linear=tracks.linear / share[:, None])
