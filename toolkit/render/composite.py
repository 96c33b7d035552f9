"""Volume rendering over flattened samples: weights, sums along rays, distortion. Gradients are autograd's.

Samples of all rays lie in one list, ray after ray and near to far; `first` (samples,) is the index of the first sample of a sample's
own ray. Everything is a pure function; each has a slow float64 loop as its reference in `tests/stability/hard/reference.py`.
"""

from __future__ import annotations

import torch

from fieldfuse.backends.constants import OPAQUE as OPAQUE
from fieldfuse.backends.constants import RAW_MAX as RAW_MAX
from fieldfuse.backends.constants import SOLID as SOLID
from fieldfuse.backends.constants import STOP as STOP
from fieldfuse.backends.constants import THRESHOLD as THRESHOLD
from fieldfuse.backends.constants import UNITS as UNITS

Tensor = torch.Tensor


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


def distortion(weight: Tensor, place: Tensor, length: Tensor, first: Tensor, ray: Tensor, rays: int) -> Tensor:
    """Distortion loss of a ray's weights (Barron et al. 2022, eq. 15), in linear time; differentiable in `weight`.

    Args:
        weight: (samples,) w ≥ 0.
        place: (samples,) mid-points along the ray, in units in which the whole ray is about 1, ascending within a ray.
        length: (samples,) lengths of the intervals in the same units.

    Returns:
        (rays,) Σ_ij w_i w_j |s_i - s_j| + ⅓ Σ_i w_i² l_i.
    """
    w, s = weight.double(), place.double()
    # Places ascend, so that Σ_ij w_i w_j |s_i - s_j| = 2 Σ_i w_i (s_i Σ_{j<i} w_j - Σ_{j<i} w_j s_j).
    pull = s * exclusive_sum(w, first) - exclusive_sum(w * s, first)
    return ray_sum(w * (2 * pull + w * length.double() / 3), ray, rays).to(weight.dtype)
