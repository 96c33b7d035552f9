"""The global volumes of `fusion.fuse_key_frame` as ordinary values, so that gradients flow through the loop over key frames.

What is taken over from a coarser level is not differentiated: each level has its own loss.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch

from fieldfuse.nerfusion.cameras import Cameras
from fieldfuse.nerfusion.extras.plane_sweep import DepthDistribution
from fieldfuse.nerfusion.extras.two_lattices import allowed_cells, surface_cells
from fieldfuse.nerfusion.fusion import fuse_key_frame
from fieldfuse.nerfusion.lattice import LatentVolume, Lattice, LocalVolume, cells
from fieldfuse.nerfusion.model import NerfusionModel
from fieldfuse.nerfusion.store import ValueStore
from fieldfuse.nerfusion.unproject import EncodedView, KeyFrame

Tensor = torch.Tensor


@dataclass(frozen=True)
class Recurrence:
    """The global volumes, coarsest first, and how they are made.

    Attributes:
        gamma: coarse cells in which exp(−optical thickness) exceeds this are not looked at finer.
        most: coarse cells that are split a key frame at most; when more are solid, the thickest ones are.
    """

    volumes: tuple[LatentVolume, ...]
    near: float
    far: float
    gamma: float = 0.95
    most: int = 6000

    @classmethod
    def start(
        cls, model: NerfusionModel, lattice: Lattice, levels: int, near: float, far: float, gamma: float = 0.95, most: int = 6000
    ) -> Recurrence:
        """Before the first key frame; `lattice` is the coarsest."""
        volumes = []
        for _ in range(levels):
            volumes.append(model.start(lattice))
            lattice = lattice.finer()
        return cls(tuple(volumes), near, far, gamma, most)

    def add(
        self, model: NerfusionModel, views: Sequence[EncodedView], cameras: Cameras, distribution: DepthDistribution | None = None
    ) -> tuple[Recurrence, LocalVolume]:
        """The state after one more key frame, and its local volume on the coarsest lattice. `swept`: its sweep; None: made here, alone."""
        if distribution is None:
            distribution = model.sweep_planes(views, cameras, self.near, self.far)
        stores = [ValueStore(volume) for volume in self.volumes]
        frame = KeyFrame(views, cameras, self.near, self.far, distribution)
        local = fuse_key_frame(model, frame, stores, None, partial(self._kept, model))
        return replace(self, volumes=tuple(store.volume() for store in stores)), local

    @torch.no_grad()
    def _kept(self, model: NerfusionModel, part: LatentVolume, seen: Tensor) -> Tensor:
        """(M · 512,) bool, cells that are looked at finer."""
        thickness = model.thickness(part)
        kept = surface_cells(part, seen, thickness, self.gamma)
        if int(kept.sum()) > self.most:
            # A cell is as thick as its thickest corner; the threshold that leaves `most` of them is that quantile of its values.
            values = torch.where(part.known, thickness[:-1], torch.full_like(thickness[:-1], -torch.inf))
            level = torch.topk(values, min(self.most // 4, len(values))).values[-1]
            kept &= cells(part.topology, part.known & (values >= level), every=False)
        return kept

    @torch.no_grad()
    def allowed(self, model: NerfusionModel, level: int) -> Tensor | None:
        """(M · 512,) bool, cells of a level's volume whose coarser ones are not see-through; None: all (the coarsest level)."""
        if level == 0:
            return None
        coarse = self.volumes[level - 1]
        return allowed_cells(coarse, model.thickness(coarse), self.gamma, self.volumes[level].topology)

    def detached(self) -> Recurrence:
        """Cut off from the graph (truncated back-propagation)."""
        return replace(self, volumes=tuple(volume.detached() for volume in self.volumes))

