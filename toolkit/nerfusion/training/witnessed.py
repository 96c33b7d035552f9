"""Sweeps of a sample's key frames that are each other's witnesses, as in direct inference (`networks/witness.py`, not in the paper)."""

from __future__ import annotations

import torch

from fieldfuse.nerfusion.cameras import Cameras
from fieldfuse.nerfusion.extras.cross_view_consistency import certain, evidence, witness
from fieldfuse.nerfusion.extras.matching import SIDE, describe
from fieldfuse.nerfusion.extras.plane_sweep import Sweep, compare, decide
from fieldfuse.nerfusion.training.samples import Pictures, Sample

Tensor = torch.Tensor


def cameras_of(pictures: Pictures, indices: Tensor) -> Cameras:
    """The networks' cameras of some pictures."""
    height, width = pictures.images.shape[2:]
    return Cameras.same_size(pictures.intrinsics[indices], pictures.world_from_camera[indices], width, height)


@torch.no_grad()
def sweeps_of(sample: Sample, side: int = SIDE) -> list[Sweep]:
    """The sweep of each key frame, held against those of all others; alone where there is one key frame.

    Nothing in a sweep is learned, so whichever key frames come later may be asked before they are fused, as `key_sweeps` does.

    Args:
        side: pixels of the long side at which pictures are compared.
    """
    described = describe(sample.pictures.images, side)
    compared = [
        compare([described[index] for index in numbers], cameras_of(sample.pictures, indices), sample.near, sample.far)
        for indices, numbers in zip(sample.references, sample.references.tolist(), strict=True)
    ]
    alone = [decide(one) for one in compared]
    if len(alone) == 1:
        return alone
    says = [witness(one) for one in alone]
    made = []
    for number, (one, own) in enumerate(zip(compared, alone, strict=True)):
        said = evidence(one, [other for k, other in enumerate(says) if k != number], certain(one, own))
        made.append(decide(one, said=said))
    return made
