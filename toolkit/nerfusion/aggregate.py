"""From what K views show at a voxel to numbers that do not depend on their order: mean, variance, and how to read them.

Where a surface is, views agree: the cue is a variance near zero, so its logarithm is given as well, and where fewer than two views see
the voxel all of that is zero and a flag says so (else "seen once" would read as "consistent").
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

LOG_FLOOR = 1e-4  # variance at which the logarithm ends
FLAGS = 4
CUES = 2


def aggregate(values: Tensor, visible: Tensor, with_variance: bool = True) -> tuple[Tensor, Tensor, Tensor]:
    """Mean and variance over the views that see each voxel, in two passes (NeRFusion, section 3.1).

    Args:
        values: (K, N, C).
        visible: (K, N) bool, each voxel seen at least once.

    Returns:
        mean (N, C), variance (N, C) — exactly zero with one view —, and the number of views (N,).
    """
    count = visible.sum(0)
    share = visible.to(values.dtype)[..., None] / count.clamp_min(1)[:, None]  # (K, N, 1)
    one = (count == 1)[:, None]
    mean = (values * share).sum(0)
    if not with_variance:
        return mean, torch.zeros_like(mean), count
    variance = ((values - mean).square() * share).sum(0)
    return mean, variance.masked_fill(one, 0.0), count


def evidence(mean: Tensor, variance: Tensor, count: Tensor, footprint: Tensor, step: Tensor) -> Tensor:
    """The input of the local network.

    Args:
        mean, variance: (N, C) from `aggregate`.
        count: (N,) views.
        footprint: (N,) pixels that the voxel covers (geometric mean over the views).
        step: (N,) pixels by which views disagree about the voxel's neighbour in depth.

    Returns:
        (N, 3 · C + FLAGS): mean, deviation-like variance, its logarithm about [−1, 1]; a flag for two and more views, 1 / views, the
        logarithms of the footprint and of the step. Nothing has a unit.
    """
    several = (count >= 2)[:, None].to(mean.dtype)
    squashed = variance / (1 + variance)
    logarithm = (torch.log(variance + LOG_FLOOR) / 4 + 1) * several
    disparity = torch.log2(step + 0.05) * several[:, 0]
    flags = torch.stack([several[:, 0], 1 / count.clamp_min(1).to(mean.dtype), torch.log2(footprint) / 4, disparity / 4], 1)
    return torch.cat([mean, squashed * several, logarithm, flags], 1)


def agreement(variance: Tensor, count: Tensor, groups: Sequence[slice]) -> Tensor:
    """How far the views disagree about each voxel as a whole: one number a group of channels, which `evidence` has only channel by channel.

    The variance of three values is a rough number; that of a group is much steadier, and its logarithm cannot be had from the logarithms
    of its members.

    Args:
        variance: (N, C) from `aggregate`; count: (N,) views; groups: of columns.

    Returns:
        (N, groups) logarithm of the mean variance about [−1, 1], lower where views agree; zero where fewer than two views tell.
    """
    means = torch.stack([variance[:, group].mean(1) for group in groups], 1)
    return (torch.log(means + LOG_FLOOR) / 4 + 1) * (count >= 2)[:, None].to(variance.dtype)


def direction_spread(points: Tensor, positions: Tensor, visible: Tensor) -> Tensor:
    """Standard deviation of the unit viewing directions over the views that see each voxel.

    Args:
        points: (N, 3); positions: (K, 3) of the cameras; visible: (K, N).

    Returns:
        (N,), zero with one view.
    """
    directions = torch.nn.functional.normalize(points[None] - positions[:, None], dim=2)
    _, variance, _ = aggregate(directions, visible)
    return variance.sum(1).sqrt()
