"""From a coarse volume to a finer one: the networks work fine only where the coarse volume says that something may be."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from fieldfuse.backends import dispatch
from fieldfuse.nerfusion.lattice import LatentVolume, cells
from fieldfuse.volume.edit import corner_nodes, doubled, split
from fieldfuse.volume.topology import BLOCK, VOXELS, Topology

INHERITED = 0.25  # weight of a latent taken over from the coarse volume


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


def surface_cells(volume: LatentVolume, seen: Tensor, thickness: Tensor, gamma: float) -> Tensor:
    """(M · 512,) bool: solid cells that a key frame sees, so those about surfaces and not what lies hidden behind them.

    Args:
        seen: (M · 512,) bool, corners that its local volume knows, on the same blocks.
    """
    return solid_cells(volume, thickness, gamma) & cells(volume.topology, seen, every=False)


def split_volume(volume: LatentVolume, kept: Tensor) -> LatentVolume:
    """The cells `kept` (M · 512,) on the lattice of half the voxel size, latents interpolated; not differentiable.

    Known are exactly the corners of the kept cells' children. They count little, so that what is seen finer prevails.
    """
    if volume.topology.bounds is not None and dispatch.can_use_triton(volume.rows):
        from fieldfuse.volume import split_gpu

        given = volume.topology, kept, volume.rows.detach(), doubled(*volume.topology.bounds), INHERITED
        return LatentVolume(volume.lattice.finer(), *split_gpu.split(*given))
    topology, occupied, (rows,) = split(volume.topology, kept, [volume.rows.detach()])
    return LatentVolume(volume.lattice.finer(), topology, rows, corner_nodes(topology, occupied).float() * INHERITED)


def adopt(state: LatentVolume, inherited: LatentVolume) -> LatentVolume:
    """A volume that also knows what it inherits; what it knows already stays as it is, bit for bit."""
    if inherited.topology is state.topology:
        new = inherited.known & (state.count == 0)
        rows = torch.where(_mask(new), inherited.rows.to(state.rows.dtype), state.rows)
        return replace(state, rows=rows, count=torch.where(new, inherited.count, state.count))
    state, slots = with_blocks(state, inherited.topology.keys)
    place = (slots[:, None] * VOXELS + torch.arange(VOXELS, device=slots.device)).view(-1)
    new = (inherited.known & (state.count[place] == 0)).nonzero().view(-1)
    return replace(
        state,
        rows=state.rows.index_copy(0, place[new], inherited.rows[new].to(state.rows.dtype)),
        count=state.count.index_copy(0, place[new], inherited.count[new]),
    )


def part(volume: LatentVolume, topology: Topology) -> LatentVolume:
    """A copy of some blocks of a volume; where it has no such block, nothing is known."""
    slots = volume.topology.slots_of(topology)
    if volume.topology.blocks and dispatch.can_use_triton(volume.rows):
        from fieldfuse.volume import blocks_gpu as blocks

        return LatentVolume(volume.lattice, topology, *blocks.take(volume.rows, volume.count, slots.int(), topology))
    place = (slots.clamp_min(0)[:, None] * VOXELS + torch.arange(VOXELS, device=slots.device)).view(-1)
    here = (slots >= 0).repeat_interleave(VOXELS)
    if volume.topology.blocks == 0:
        place = torch.zeros_like(place)
    count = torch.cat([volume.count, volume.count.new_zeros(1)])[place] * here
    rows = volume.rows[place] * here[:, None]
    return LatentVolume(volume.lattice, topology, torch.cat([rows, rows.new_zeros((1, rows.shape[1]))]), count)


def merged(before: LatentVolume, after: LatentVolume, changed: Tensor) -> LatentVolume:
    """`after` where `changed` (M · 512,), else `before`; both have the same blocks."""
    if dispatch.can_use_triton(before.rows, after.rows):
        from fieldfuse.networks.gpu import volumes

        rows, count = volumes.merge(before.rows, before.count, after.rows, after.count, changed)
        return replace(before, rows=rows, count=count)
    return replace(before, rows=torch.where(_mask(changed), after.rows, before.rows), count=torch.where(changed, after.count, before.count))


def _mask(corners: Tensor) -> Tensor:
    """(M · 512,) bool → (M · 512 + 1, 1), false in the zero row."""
    return torch.cat([corners, corners.new_zeros(1)])[:, None]


def with_blocks(state: LatentVolume, keys: Tensor) -> tuple[LatentVolume, Tensor]:
    """The volume with at least these blocks — its own keep their slots, new ones follow, of which nothing is known — and their slots."""
    slots = state.topology.find(keys)
    fresh = (slots < 0).nonzero().view(-1)
    if len(fresh) == 0:
        return state, slots
    slots[fresh] = state.topology.blocks + torch.arange(len(fresh), device=keys.device)
    new = len(fresh) * VOXELS
    rows, count = state.rows, state.count
    return (
        replace(
            state,
            topology=state.topology.alike(torch.cat([state.topology.keys, keys[fresh].to(torch.int32)])),
            rows=torch.cat([rows[:-1], rows.new_zeros((new + 1, rows.shape[1]))]),
            count=torch.cat([count, count.new_zeros(new)]),
        ),
        slots,
    )


def children(coarse: Topology, kept: Tensor, fine: Topology) -> Tensor:
    """Cells of a lattice of half the voxel size whose parents are `kept`.

    Args:
        kept: (M · 512,) bool, cells of `coarse`.

    Returns:
        (M' · 512,) bool, cells of `fine`.
    """
    keys = fine.keys.long()
    parent = coarse.find(keys >> 1)
    octant = keys & 1
    half = BLOCK // 2
    cubes = torch.cat([kept, kept.new_zeros(VOXELS)]).view(-1, 2, half, 2, half, 2, half)  # the last block stands for absent parents
    cube = cubes[parent, octant[:, 2], :, octant[:, 1], :, octant[:, 0]]  # (M', 4, 4, 4) z, y, x
    for axis in (1, 2, 3):
        cube = cube.repeat_interleave(2, axis)
    return cube.reshape(-1)
