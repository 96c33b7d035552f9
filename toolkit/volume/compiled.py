"""Refining a lattice on the CPU, compiled: what `edit.py` does with whole tensors, voxel by voxel and only where something is.

A step to a finer lattice took a fifth of a short fit in tensors.
"""

from __future__ import annotations

import numpy as np
import torch

from fieldfuse.backends.numba import volume as kernels
from fieldfuse.memory import keep_only
from fieldfuse.volume.edit import corner_nodes
from fieldfuse.volume.host import Host, Hosted
from fieldfuse.volume.topology import Topology

Tensor = torch.Tensor


def finer_blocks(topology: Topology, occupied: Tensor, ratio: float) -> Tensor:
    """(N, 3) int32 keys of the blocks that a lattice finer by `ratio` needs: they hold children of occupied voxels, or corners of them."""
    keys = topology.keys.cpu().numpy().astype(np.int64)
    low = np.floor(keys.min(0) * ratio).astype(np.int64) - 1 if len(keys) else np.zeros(3, np.int64)
    high = np.ceil((keys.max(0) + 1) * ratio).astype(np.int64) + 1 if len(keys) else np.zeros(3, np.int64)
    size = high - low + 1
    place = np.zeros((size[2], size[1], size[0]), np.bool_)
    kernels.mark_blocks(keys, occupied.cpu().numpy(), ratio, low, place)
    z, y, x = np.nonzero(place)
    return torch.from_numpy(np.stack([x, y, z], 1) + low).int()


def refined(
    topology: Topology, occupied: Tensor, rows: tuple[Tensor, Tensor], ratio: float, host: Host, voxel_size: float
) -> tuple[Hosted, Tensor]:
    """The same field on a lattice that is finer by `ratio`, in rows of the host.

    A finer voxel is occupied when its centre lies in an occupied one. Corners of occupied voxels get the trilinear values of the
    coarser lattice's known corners; all others stay zero, and take no memory where a page of rows has none but such. `rows` may be the
    host's: they are read before it gives others, which voids what it gave before.

    Args:
        rows: densities (M · 512 + 1,) and features (M · 512 + 1, C) with the zero row.
        voxel_size: of the finer lattice, working units.

    Returns:
        the new rows, and (M' · 512,) bool.
    """
    keys = topology.keys.numpy().astype(np.int64)
    new_keys = finer_blocks(topology, occupied, ratio)
    known = corner_nodes(topology, occupied)
    source = known.nonzero().squeeze(1)
    index = torch.full((len(known),), -1, dtype=torch.int32)
    index[source] = torch.arange(len(source), dtype=torch.int32)
    values = (index.numpy(), *(of.detach()[source].numpy() for of in rows))
    del source
    hosted = host.allocate(new_keys, rows[1].shape[1], voxel_size)
    new = hosted.topology
    out = torch.zeros(new.zero_row, dtype=torch.bool)
    kernels.mark_children(keys, occupied.numpy(), ratio, new.table.numpy(), *new.table_origin, out.numpy())
    nodes = corner_nodes(new, out)
    into = (hosted.density.numpy(), hosted.feature.numpy())
    release_unused(nodes, hosted.density, hosted.feature)
    given = nodes.numpy(), 1 / ratio, topology.table.numpy()
    kernels.resample(new.keys.numpy().astype(np.int64), *given, *topology.table_origin, *values, *into)
    return hosted, out


def release_unused(nodes: Tensor, density: Tensor, feature: Tensor) -> None:
    """Give back the memory of rows that no voxel uses, page by page: of the corners of a block along a surface that is a third and more.

    Args:
        nodes: (M · 512,) bool, corners that are used. density: (M · 512 + 1,), feature: (M · 512 + 1, C): in memory of this process alone.
    """
    for rows in (density, feature):
        keep_only(rows.detach().numpy()[: len(nodes)], nodes.numpy())
