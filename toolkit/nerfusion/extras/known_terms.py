"""What latents start from, and what a local volume weighs (not in the paper): mean colour and expected distance to the surface.

Networks learn what to change of these terms, within bounds. Without the terms colours alone do not find surfaces: a fog of mean colours is
a minimum, too. Without the bounds networks paint images right before the cameras of key frames, which explains neighbouring views just as
well as surfaces.
"""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from fieldfuse.backends.constants import CHANGE, INSIDE
from fieldfuse.nerfusion.extras.plane_sweep import SdfEstimate
from fieldfuse.volume.topology import VOXELS, Topology

COLOUR_SCALE = 4.0  # a latent colour of ±1 is a colour logit of ±4
MOST = 0.93  # known terms are clamped to ± this, so that tanh is not driven to its ends
TRUNCATION = 2.0  # voxels about the surface within which distances are distinguished
HIDDEN = 0.02  # voxels that are visible with less likelihood are not known
BLIND = 0.1  # weight of a local volume where no depth stands out
FREE = 0.9  # signed distances beyond which a voxel is free space for sure


def sdf_latent(signed: Tensor) -> Tensor:
    """(N,) signed distances in [−1, 1], positive in front of the surface → p with tanh p = −signed, within what `MOST` allows."""
    return torch.atanh((-signed).clamp(-MOST, MOST))


def colour_latent(colour: Tensor) -> Tensor:
    """(N, 3) RGB in [0, 1] → p with sigmoid(COLOUR_SCALE · tanh p) = colour, within what `MOST` allows."""
    latent = torch.logit(colour, eps=1e-4) / COLOUR_SCALE
    return torch.atanh(latent.clamp(-MOST, MOST))


def start(colour: Tensor, expected_sdf: Tensor) -> Tensor:
    """(N, 3) mean RGB in [0, 1] and (N,) expected signed distances → (N, 4) known terms of the first latents."""
    return torch.cat([colour_latent(colour), sdf_latent(expected_sdf)[:, None]], 1)


def weight(estimate: SdfEstimate) -> Tensor:
    """(N,) of a local volume: small where voxels are hidden, and where images fit at no depth better than at others."""
    return estimate.visibility.clamp_min(HIDDEN) * (BLIND + (1 - BLIND) * estimate.confidence)


def blocks_near_surface(topology: Topology, rows: Tensor, starts: Tensor) -> Tensor:
    """(M,) bool, blocks with a corner that is not free space for sure: convolutions cost most, and free space needs none.

    Args:
        rows: (N,) of the corners; starts: (N, 4) of `start`.
    """
    active = torch.zeros(topology.blocks + 1, dtype=torch.bool, device=topology.device)
    slots = rows.div(VOXELS, rounding_mode="floor")
    near = starts[:, INSIDE] > _free_latent()
    # One more block takes those that are free: to choose the others would be to wait for the device.
    return active.index_fill(0, torch.where(near, slots, topology.blocks), True)[:-1]


@lru_cache(maxsize=1)
def _free_latent() -> float:
    """`sdf_latent` of `FREE`, rounded as a tensor's."""
    return float(sdf_latent(torch.tensor([FREE])))


def soft_bound(learned: Tensor, most: float) -> Tensor:
    """What is learned, within ± `most` without a kink."""
    return most * torch.tanh(learned / most)


def bounded(learned: Tensor) -> Tensor:
    """(N, channels) learned additions to a latent; that to the distance behind the surface stays within ± `CHANGE`."""
    return torch.cat([learned[:, :INSIDE], soft_bound(learned[:, INSIDE : INSIDE + 1], CHANGE), learned[:, INSIDE + 1 :]], 1)
