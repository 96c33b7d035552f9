"""Which voxels rays do not see through: the paper's pruning rule (section 3.4), here made free of scale; and by it two lattices and more
(not in the paper, which has one), finer ones only where the coarser volume is not see-through."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from fieldfuse.backends import dispatch
from fieldfuse.nerfusion.lattice import LatentVolume, cells, corner_mask, rows_of, with_blocks
from fieldfuse.volume.edit import corner_nodes, doubled, split
from fieldfuse.volume.topology import BLOCK, VOXELS, Topology

INHERITED = 0.25  # weight of a latent taken over from the coarse volume


def least_thickness(gamma: float) -> float:
    """Logarithm of the optical thickness of a voxel with exp(−thickness) = γ."""
    return math.log(-math.log(gamma))


def solid_cells(volume: LatentVolume, thickness: Tensor, gamma: float | None) -> Tensor:
    """(M · 512,) bool: cells with eight known corners that are not see-through (exp(−thickness) ≤ γ).

    Raw density is interpolated linearly, so its largest value in a cell is at a corner, and looking at the corners is exact.

    Args:
        thickness: (M · 512 + 1,) logarithm of the optical thickness of a voxel, from the head.
        gamma: None: see-through cells stay.
    """
    known = volume.known
    whole = cells(volume.topology, known, every=True)
    if gamma is None:
        return whole
    return whole & cells(volume.topology, known & (thickness[:-1].detach() >= least_thickness(gamma)), every=False)


def surface_cells(volume: LatentVolume, seen: Tensor, thickness: Tensor, gamma: float) -> Tensor:
    """(M · 512,) bool: solid cells that a key frame sees, so those about surfaces and not what lies hidden behind them.

    Args:
        seen: (M · 512,) bool, corners known in its local volume, on the same blocks.
    """
    return solid_cells(volume, thickness, gamma) & cells(volume.topology, seen, every=False)


def split_volume(volume: LatentVolume, kept: Tensor) -> LatentVolume:
    """The cells `kept` (M · 512,) on the lattice of half the voxel size, latents interpolated; not differentiable.

    Known are exactly the corners of the kept cells' children. They count little, so that what is seen finer prevails.
    """
    if volume.topology.bounds is not None and dispatch.can_use_triton(volume.rows):
        from fieldfuse.backends.triton import blocks

        given = volume.topology, kept, volume.rows.detach(), doubled(*volume.topology.bounds), INHERITED
        return LatentVolume(volume.lattice.finer(), *blocks.split(*given))
    topology, occupied, (rows,) = split(volume.topology, kept, [volume.rows.detach()])
    return LatentVolume(volume.lattice.finer(), topology, rows, corner_nodes(topology, occupied).float() * INHERITED)


def adopt(state: LatentVolume, inherited: LatentVolume) -> LatentVolume:
    """A volume with what it inherits where nothing was known; what was known stays as it is, bit for bit."""
    if inherited.topology is state.topology:
        new = inherited.known & (state.count == 0)
        rows = torch.where(corner_mask(new), inherited.rows.to(state.rows.dtype), state.rows)
        return replace(state, rows=rows, count=torch.where(new, inherited.count, state.count))
    state, slots = with_blocks(state, inherited.topology.keys)
    place = rows_of(slots, 0)[:-1]
    new = (inherited.known & (state.count[place] == 0)).nonzero().view(-1)
    return replace(
        state,
        rows=state.rows.index_copy(0, place[new], inherited.rows[new].to(state.rows.dtype)),
        count=state.count.index_copy(0, place[new], inherited.count[new]),
    )


def allowed_cells(coarse: LatentVolume, thickness: Tensor, gamma: float, fine: Topology) -> Tensor:
    """(M' · 512,) bool, cells of `fine` whose parents are not see-through; `thickness` (M · 512 + 1,) is the coarse volume's."""
    kept = solid_cells(coarse, thickness, gamma)
    keys, half = fine.keys.long(), BLOCK // 2
    parent, octant = coarse.topology.find(keys >> 1), keys & 1
    cubes = torch.cat([kept, kept.new_zeros(VOXELS)]).view(-1, 2, half, 2, half, 2, half)  # the last block stands for absent parents
    cube = cubes[parent, octant[:, 2], :, octant[:, 1], :, octant[:, 0]]  # (M', 4, 4, 4) z, y, x
    for axis in (1, 2, 3):
        cube = cube.repeat_interleave(2, axis)
    return cube.reshape(-1)
