"""From a latent volume to a radiance field: the head's values in the field's units, and which voxels are worth sampling."""

from __future__ import annotations

import math

import torch

from toolkit.networks.lattice import LatentVolume, cells
from toolkit.networks.model import NerfusionModel
from toolkit.render.composite import UNITS
from toolkit.render.field import Field
from toolkit.volume.edit import erase_empty_blocks

Tensor = torch.Tensor
GAMMA = 0.6  # the paper's pruning threshold


def make_field(
    model: NerfusionModel,
    volume: LatentVolume,
    background: Tensor,
    gamma: float | None = None,
    near: float = 0.0,
    fine: int = 4,
    allowed: Tensor | None = None,
) -> Field:
    """The field of a local or global volume. Gradients flow from its rows to the networks; it shares the model's decoder.

    A cell takes part when all its eight corners are known. With `gamma`, cells are pruned by the paper's rule, made free of scale: gone
    when exp(−optical thickness of the voxel) exceeds γ everywhere in it. Raw density is interpolated linearly, so its largest value in a
    cell is at a corner, and looking at the corners is exact.

    Args:
        background: (3,) colour behind everything.
        gamma: pruning threshold; None: no pruning.
        near, fine: see `Field`.
        allowed: (M · 512,) bool, cells that may take part at all; None: every one.
    """
    thickness, features = model.head(volume)
    occupied = cells(volume.topology, volume.known, every=True)
    if allowed is not None:
        occupied &= allowed
    if gamma is not None:
        occupied &= cells(volume.topology, volume.known & solid(thickness, gamma), every=False)
    # A voxel's optical thickness is σ · side, and σ = exp(raw) · UNITS per normalised unit.
    raw = thickness - math.log(volume.lattice.voxel * UNITS)
    lattice = volume.lattice
    return Field(lattice.space, lattice.resolution, volume.topology, occupied, raw, features, model.decoder, background, near, fine)


def solid(thickness: Tensor, gamma: float) -> Tensor:
    """(M · 512 + 1,) logarithm of optical thickness → (M · 512,) bool: exp(−thickness) ≤ γ."""
    return thickness[:-1].detach() >= math.log(-math.log(gamma))


def without_empty_blocks(field: Field) -> Field:
    """The field without the blocks that pruning left empty. Not differentiable."""
    topology, occupied, (density, features) = erase_empty_blocks(
        field.topology, field.occupied, [field.density_rows.detach(), field.feature_rows.detach()]
    )
    return Field(
        field.space, field.resolution, topology, occupied, density, features, field.decoder, field.background, field.near, field.fine
    )
