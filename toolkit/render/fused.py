"""From a latent volume to a radiance field: the head's values in the field's units, and which voxels are worth sampling."""

from __future__ import annotations

import math
from dataclasses import replace

import torch

from fieldfuse.nerfusion.extras.two_lattices import solid_cells
from fieldfuse.nerfusion.lattice import LatentVolume
from fieldfuse.nerfusion.model import NerfusionModel
from fieldfuse.render.composite import UNITS
from fieldfuse.render.field import Field
from fieldfuse.volume.edit import erase_empty_blocks

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

    A cell takes part when all its eight corners are known and, with `gamma`, when it is not see-through: the paper's pruning rule, made
    free of scale (gone when exp(−optical thickness of the voxel) exceeds γ everywhere in it).

    Args:
        background: (3,) colour behind everything.
        gamma: pruning threshold; None: no pruning.
        near, fine: see `Field`.
        allowed: (M · 512,) bool, cells that may take part at all; None: every one.
    """
    thickness, features = model.head(volume)
    occupied = solid_cells(volume, thickness, gamma)
    if allowed is not None:
        occupied &= allowed
    # A voxel's optical thickness is σ · side, and σ = exp(raw) · UNITS per normalised unit.
    raw = thickness - math.log(volume.lattice.voxel * UNITS)
    lattice = volume.lattice
    return Field(lattice.space, lattice.resolution, volume.topology, occupied, raw, features, model.decoder, background, near, fine)


def without_empty_blocks(field: Field) -> Field:
    """The field without the blocks that pruning left empty. Not differentiable."""
    topology, occupied, (density, features) = erase_empty_blocks(
        field.topology, field.occupied, [field.density_rows.detach(), field.feature_rows.detach()]
    )
    return replace(field, topology=topology, occupied=occupied, density_rows=density, feature_rows=features)
