"""Volume rendering over flattened samples: weights, sums along rays, distortion, and their gradients by hand.

Samples of all rays lie in one list, ray after ray and near to far; `first` (samples,) is the index of the first sample of a sample's
own ray. Everything is a pure function; each has a slow float64 loop as its reference in `tests/stability/hard/reference.py`.
"""

from __future__ import annotations

import torch

Tensor = torch.Tensor

OPAQUE = 128.0  # optical thickness whose transmittance is 0 in float32

UNITS = 32.0  # σ is counted per 1/32 of normalised space, so raw densities mean the same at every resolution
THRESHOLD = 1e-3  # samples of smaller weight have no colour and get no gradient
SOLID = 0.5  # a ray of which less than this is left ends somewhere: its strongest sample is a surface
STOP = 1e-4  # a ray ends where less than this part of the light is left
RAW_MAX = 12.0  # exp(12) is opaque over a thousandth of a voxel; the clamp keeps forward values and gradients finite


def exclusive_sum(values: Tensor, first: Tensor) -> Tensor:
    """(samples,) → sum over the earlier samples of the same ray, float64 (differences of one long running sum need the digits)."""
    total = torch.cumsum(values.double(), 0)
    before = total - values.double()
    return before - before[first] if len(values) else before


def weights(thickness: Tensor, first: Tensor) -> tuple[Tensor, Tensor]:
    """Optical thickness τ = σ·δ (samples,) ≥ 0 → weights w = T·α and transmittance T in front of each sample.

    NeRFusion eq. 6: T_i = exp(-Σ_{j<i} τ_j), α_i = 1 - exp(-τ_i), with expm1 so that thin media keep their digits.
    """
    # One running sum serves all rays: opaque samples would fill it with digits that thin rays behind them in the list need.
    # Beyond OPAQUE exp(-τ) is 0 in float32, so the bound changes nothing else.
    transmittance = torch.exp(-exclusive_sum(thickness.clamp_max(OPAQUE), first)).to(thickness.dtype)
    return transmittance * -torch.expm1(-thickness), transmittance


def ray_sum(values: Tensor, ray: Tensor, rays: int) -> Tensor:
    """(samples,) or (samples, C) → (rays,) or (rays, C): sum over the samples of each ray. Empty rays give 0."""
    out = values.new_zeros((rays, *values.shape[1:]))
    return out.index_add_(0, ray, values)


def thickness_gradient(
    weight: Tensor, transmittance: Tensor, thickness: Tensor, weight_gradient: Tensor, first: Tensor, ray: Tensor, rays: int
) -> Tensor:
    """∂L/∂τ (samples,) from ∂L/∂w (samples,), which already holds everything that depends on w (also through the opacity).

    ∂w_i/∂τ_i = T_i exp(-τ_i) and ∂w_j/∂τ_i = -w_j for j > i, so
    ∂L/∂τ_i = T_i e^{-τ_i} g_i - Σ_{j>i} w_j g_j.
    """
    product = (weight * weight_gradient).double()
    before = exclusive_sum(product, first)
    total = torch.zeros(rays, dtype=torch.float64, device=ray.device).index_add_(0, ray, product)
    after = total[ray] - before - product
    return transmittance * torch.exp(-thickness) * weight_gradient - after.to(weight.dtype)


def distortion(weight: Tensor, place: Tensor, length: Tensor, first: Tensor, ray: Tensor, rays: int) -> tuple[Tensor, Tensor]:
    """Distortion loss of a ray's weights (Barron et al. 2022, eq. 15), in linear time.

    Args:
        weight: (samples,) w ≥ 0.
        place: (samples,) mid-points along the ray, in units in which the whole ray is about 1, ascending within a ray.
        length: (samples,) lengths of the intervals in the same units.

    Returns:
        per-ray loss (rays,) Σ_ij w_i w_j |s_i - s_j| + ⅓ Σ_i w_i² l_i and its gradient with respect to `weight` (samples,).
    """
    w, s = weight.double(), place.double()
    w_before, ws_before = exclusive_sum(w, first), exclusive_sum(w * s, first)
    sums = torch.zeros(rays, 2, dtype=torch.float64, device=ray.device).index_add_(0, ray, torch.stack([w, w * s], 1))[ray]
    w_after, ws_after = sums[:, 0] - w_before - w, sums[:, 1] - ws_before - w * s
    pull = s * (w_before - w_after) - (ws_before - ws_after)
    width = w * length.double() / 3
    loss = torch.zeros(rays, dtype=torch.float64, device=ray.device).index_add_(0, ray, w * (pull + width))
    return loss.to(weight.dtype), (2 * (pull + width)).to(weight.dtype)
