"""The paper's pruning rule: voxels that rays see through are dropped (section 3.4), here made free of scale."""

from __future__ import annotations

import math

from torch import Tensor

from fieldfuse.nerfusion.lattice import LatentVolume, cells


def solid(thickness: Tensor, gamma: float) -> Tensor:
    """(M · 512 + 1,) logarithm of a voxel's optical thickness → (M · 512,) bool: exp(−thickness) ≤ γ (the paper's pruning rule)."""
    return thickness[:-1].detach() >= least_thickness(gamma)


def least_thickness(gamma: float) -> float:
    """Logarithm of the optical thickness of a voxel with exp(−thickness) = γ."""
    return math.log(-math.log(gamma))


def solid_cells(volume: LatentVolume, thickness: Tensor, gamma: float | None) -> Tensor:
    """(M · 512,) bool: cells with eight known corners that are not see-through.

    Raw density is interpolated linearly, so its largest value in a cell is at a corner, and looking at the corners is exact.

    Args:
        thickness: (M · 512 + 1,) from the head.
        gamma: None: see-through cells stay.
    """
    known = volume.known
    whole = cells(volume.topology, known, every=True)
    return whole if gamma is None else whole & cells(volume.topology, known & solid(thickness, gamma), every=False)
