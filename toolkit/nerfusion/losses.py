"""Losses of training across scenes: squared colour error as in the paper, opacity of solid rays, and the auxiliary depth likelihood.

The paper trains on colours alone. The two others are additions: the opacity term says that rays which meet a surface end, and the depth
term, which is annealed to zero early, keeps the networks from settling in fog that explains the colours just as well.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from fieldfuse.nerfusion.training.rays import TargetRays
from fieldfuse.render.composite import ray_sum

Tensor = torch.Tensor
WIDTH = 0.03  # relative: how close to the true distance a weight counts as right
FLOOR = 1e-3  # smallest likelihood: a ray with no weight near the truth costs this much and no more


@dataclass(frozen=True)
class Traced:
    """What a renderer answers for R rays.

    Attributes:
        colour: (R, 3), already over its background.
        opacity: (R,).
        weight, distance: (S,) of all samples, distances along the rays.
        ray: (S,) int64.
    """

    colour: Tensor
    opacity: Tensor
    weight: Tensor
    distance: Tensor
    ray: Tensor

    def median_distance(self) -> Tensor:
        """(R,) distance at which half of a ray's own opacity is reached; 0 where it is empty. No gradient."""
        with torch.no_grad():
            rays = len(self.opacity)
            total = torch.cumsum(self.weight.double(), 0)
            before = torch.zeros(rays, dtype=torch.float64, device=total.device)
            opacity = ray_sum(self.weight.double(), self.ray, rays)
            before[1:] = opacity.cumsum(0)[:-1]
            reached = total - before[self.ray] >= 0.5 * opacity[self.ray]
            far = torch.full((rays,), torch.inf, device=self.distance.device)
            found = far.scatter_reduce(0, self.ray, torch.where(reached, self.distance, torch.inf), "amin")
            return torch.where(torch.isfinite(found) & (self.opacity > 1e-3), found, 0.0)


def depth_likelihood(traced: Traced, distance: Tensor, voxel_size: float = 0.0) -> tuple[Tensor, Tensor]:
    """How much of each ray's weight lies where the surface truly is.

    Args:
        distance: (R,) true distances, 0 = unknown.
        voxel_size: what is nearer than half of it cannot be told apart.

    Returns:
        (R',) natural logarithm of Σ_i w_i exp(−½ ((t_i − t*) / s)²) with s = max(`WIDTH` · t*, voxel_size / 2), not below log `FLOOR`,
        for the rays with a known distance; and (R,) bool, which those are.
    """
    likelihood, known = _likelihood(traced, distance, voxel_size)
    return likelihood[known], known


def mean_likelihood(traced: Traced, distance: Tensor, voxel_size: float = 0.0) -> Tensor:
    """Mean of `depth_likelihood` without asking a device how many distances are known: not a number where none is."""
    likelihood, known = _likelihood(traced, distance, voxel_size)
    return torch.where(known, likelihood, 0.0).sum() / known.sum()


def _likelihood(traced: Traced, distance: Tensor, voxel_size: float) -> tuple[Tensor, Tensor]:
    """(R,) of all rays, and which have a known distance."""
    known = distance > 0
    safe = torch.where(known, distance, torch.ones_like(distance))
    true = safe[traced.ray]
    window = torch.exp(-0.5 * ((traced.distance - true) / (WIDTH * true).clamp_min(0.5 * voxel_size)).square())
    mass = ray_sum(traced.weight * window, traced.ray, len(distance))
    return torch.log(mass.clamp(0, 1) + FLOOR), known


@dataclass(frozen=True)
class LossParts:
    """The loss of one rendering and what it is made of."""

    total: Tensor
    colour: Tensor
    opacity: Tensor
    depth: Tensor


def rendering_loss(traced: Traced, rays: TargetRays, opacity_weight: float, depth_weight: float, voxel_size: float = 0.0) -> LossParts:
    """colour: mean squared error over rays and channels. opacity: mean of (1 − A)² over solid rays. depth: mean −log likelihood.

    `voxel_size`: see `depth_likelihood`.
    """
    colour = (traced.colour - rays.colour).square().mean()
    zero = colour.new_zeros(())
    solid = rays.solid
    # Sums of what counts, by how many there are: nobody waits for the answer to how many.
    opacity = torch.where(solid, (1 - traced.opacity).square(), 0.0).sum() / solid.sum().clamp_min(1)
    depth = zero
    if depth_weight > 0:
        likelihood, known = _likelihood(traced, rays.distance, voxel_size)
        depth = -torch.where(known, likelihood, 0.0).sum() / known.sum().clamp_min(1)
    return LossParts(colour + opacity_weight * opacity + depth_weight * depth, colour, opacity, depth)


def annealed(start: float, step: int, steps: int) -> float:
    """A weight that falls from `start` to exactly zero over `steps` steps, first slowly, then faster (half a cosine)."""
    if steps <= 0 or step >= steps:
        return 0.0
    return float(start * 0.5 * (1 + torch.cos(torch.tensor(step / steps * torch.pi, dtype=torch.float64))))


def psnr(error: Tensor | float) -> float:
    """Mean squared error → decibels."""
    return float(decibels(torch.as_tensor(error, dtype=torch.float64)))


def decibels(error: Tensor) -> Tensor:
    """`psnr`, left on the device."""
    return -10 * torch.log10(error.double().clamp_min(1e-10))
