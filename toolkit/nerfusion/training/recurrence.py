"""The loop over key frames with gradients: one volume a level, as `fusion.py` keeps them at inference, but as ordinary values.

Each finer lattice works only in the cells that the coarser global volume does not see through, and starts there from what the coarser
one knows. What is taken over from a coarser level is not differentiated: each level has its own loss.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from fieldfuse.nerfusion.cameras import Cameras
from fieldfuse.nerfusion.extras.plane_sweep import Sweep
from fieldfuse.nerfusion.lattice import LatentVolume, Lattice, LocalVolume, cells
from fieldfuse.nerfusion.model import NerfusionModel
from fieldfuse.nerfusion.refine import adopt, children, solid_cells, split_volume, surface_cells
from fieldfuse.nerfusion.unproject import EncodedView
from fieldfuse.volume.topology import VOXELS

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
        self, model: NerfusionModel, views: Sequence[EncodedView], cameras: Cameras, swept: Sweep | None = None
    ) -> tuple[Recurrence, LocalVolume]:
        """The state after one more key frame, and its local volume on the coarsest lattice. `swept`: its sweep; None: made here, alone."""
        if swept is None:
            swept = model.sweep(views, cameras, self.near, self.far)
        local = model.local_volume(views, cameras, self.volumes[0].lattice, near=self.near, far=self.far, swept=swept)
        volumes = [model.fuse(self.volumes[0], local)]
        newest = local
        for before in self.volumes[1:]:
            part = _on_blocks_of(volumes[-1], newest)
            finer = split_volume(part, self._kept(model, part, newest.known))
            if finer.topology.blocks == 0:
                volumes += self.volumes[len(volumes) :]
                break
            state = adopt(before, finer)
            closer = model.local_volume(views, cameras, finer.lattice, finer.topology, finer.known, self.near, self.far, swept)
            volumes.append(model.fuse(state, closer))
            newest = closer
        return Recurrence(tuple(volumes), self.near, self.far, self.gamma, self.most), local

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
        kept = solid_cells(coarse, model.thickness(coarse), self.gamma)
        return children(coarse.topology, kept, self.volumes[level].topology)

    def detached(self) -> Recurrence:
        """Cut off from the graph (truncated back-propagation)."""
        return Recurrence(tuple(volume.detached() for volume in self.volumes), self.near, self.far, self.gamma, self.most)


def _on_blocks_of(volume: LatentVolume, other: LatentVolume) -> LatentVolume:
    """The part of `volume` on the blocks of `other` (all of which it has), without gradients."""
    slots = volume.topology.find(other.topology.keys)
    place = (slots[:, None] * VOXELS + torch.arange(VOXELS, device=slots.device)).view(-1)
    rows = volume.rows.detach()
    return LatentVolume(volume.lattice, other.topology, torch.cat([rows[place], rows[-1:]]), volume.count[place])
