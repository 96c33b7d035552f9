"""Depth distributions of a sample's key frames, checked against each other as in direct inference (`cross_view_consistency.py`)."""

from __future__ import annotations

import torch

from fieldfuse.nerfusion.cameras import Cameras
from fieldfuse.nerfusion.extras.cross_view_consistency import confident_points, consistency, cross_view
from fieldfuse.nerfusion.extras.matching import SIDE, patch_descriptors
from fieldfuse.nerfusion.extras.plane_sweep import DepthDistribution, cost_volume, to_probability
from fieldfuse.nerfusion.training.samples import Pictures, Sample

Tensor = torch.Tensor


def cameras_of(pictures: Pictures, indices: Tensor) -> Cameras:
    """The networks' cameras of some pictures."""
    height, width = pictures.images.shape[2:]
    return Cameras.same_size(pictures.intrinsics[indices], pictures.world_from_camera[indices], width, height)


@torch.no_grad()
def keyframe_distributions(sample: Sample, side: int = SIDE) -> list[DepthDistribution]:
    """The sweep of each key frame, held against those of all others; alone where there is one key frame.

    Nothing in a sweep is learned, so whichever key frames come later may be asked before they are fused, as `keyframe_depth` does.

    Args:
        side: pixels of the long side at which pictures are compared.
    """
    descriptors = patch_descriptors(sample.pictures.images, side)
    costs = [
        cost_volume([descriptors[index] for index in numbers], cameras_of(sample.pictures, indices), sample.near, sample.far)
        for indices, numbers in zip(sample.references, sample.references.tolist(), strict=True)
    ]
    own_estimate = [to_probability(one) for one in costs]
    if len(own_estimate) == 1:
        return own_estimate
    log_odds = [cross_view(one) for one in own_estimate]
    made = []
    for number, (one, own) in enumerate(zip(costs, own_estimate, strict=True)):
        correction = consistency(one, [other for k, other in enumerate(log_odds) if k != number], confident_points(one, own))
        made.append(to_probability(one, correction=correction))
    return made
