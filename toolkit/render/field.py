"""The radiance field: sparse blocks of density and features, a decoder, and the space that they live in."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from toolkit.networks.decoder import Deferred, PerSample
from toolkit.render.march import MarchGrid
from toolkit.volume.space import Space
from toolkit.volume.topology import VOXELS, Topology

Tensor = torch.Tensor

DENSITY_VOXEL = 1 / 32  # σ is counted per this length of normalised space, so raw densities mean the same at every resolution
RAW_MAX = 12.0  # exp(12) is opaque over a thousandth of a voxel; the clamp keeps forward values and gradients finite


def density(raw: Tensor) -> Tensor:
    """Raw density → σ ≥ 0 per normalised unit: exp, clamped in its forward value (a zero-length interval must not meet an infinite σ)."""
    return torch.exp(raw.clamp_max(RAW_MAX)) / DENSITY_VOXEL


@dataclass
class Field:
    """A sparse voxel field in the working frame.

    Attributes:
        space: region of interest and contraction.
        resolution: voxels along the lattice's cube; lattice corner (0, 0, 0) is its low corner, keys count from there.
        topology: blocks; also those that only hold corners of occupied voxels.
        occupied: (M · 512,) bool, voxels that are sampled.
        density_rows: (M · 512 + 1,) float32 raw density at lattice corners; the last is the zero row of absent blocks.
        feature_rows: (M · 512 + 1, C) float32.
        decoder: deferred or per sample.
        background: (3,) colour behind everything.
        near: distance before which nothing is sampled.
    """

    space: Space
    resolution: int
    topology: Topology
    occupied: Tensor
    density_rows: Tensor
    feature_rows: Tensor
    decoder: Deferred | PerSample
    background: Tensor
    near: float = 0.0
    fine: int = 4

    def __post_init__(self) -> None:
        self.grid = MarchGrid(self.space, self.resolution, self.topology, self.occupied)

    @property
    def device(self) -> torch.device:
        return self.density_rows.device

    @property
    def voxel_size(self) -> float:
        """Side of a voxel inside the region of interest, working units."""
        return 2 * self.space.extent / self.resolution * self.space.half

    @property
    def blocks(self) -> int:
        return self.topology.blocks

    @property
    def voxels(self) -> int:
        """Occupied voxels."""
        return int(self.occupied.sum())

    @property
    def bytes(self) -> int:
        """Memory of blocks, features, densities and occupancy."""
        return self.blocks * (VOXELS * (4 * (self.feature_rows.shape[1] + 1) + 1) + 12)

    def to(self, device: torch.device | str) -> Field:
        """The same field on another device."""
        return Field(
            self.space,
            self.resolution,
            self.topology.to(device),
            self.occupied.to(device),
            self.density_rows.to(device),
            self.feature_rows.to(device),
            self.decoder.to(device),
            self.background.to(device),
            self.near,
            self.fine,
        )
