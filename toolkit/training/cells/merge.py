"""The cells' fields as one: every block comes from the cell that owns it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from fieldfuse.errors import FieldfuseError
from fieldfuse.render.field import Field
from fieldfuse.training.cells.partition import Cells
from fieldfuse.training.levels import in_rows
from fieldfuse.volume.edit import corner_nodes
from fieldfuse.volume.host import Hosted, plain_rows
from fieldfuse.volume.topology import VOXELS, Topology

Array = np.ndarray[Any, Any]


class NotCoveredError(FieldfuseError):
    """A part of the scene is missing from what the cells gave."""


def merged(coarse: Field, cells: Cells, load: Callable[[int], Field]) -> Field:
    """One field of those of all cells, each with the halo that it was fitted with. One cell at a time is in memory.

    A corner of a voxel that lies on a border belongs to the block it lies in, and so to that block's owner; where the owner has no use for
    it (its own voxels there are empty), the neighbour's value stays.

    Args:
        load: gives the field of a cell, each twice.
    """
    keys = np.concatenate([load(cell).topology.keys.numpy() for cell in range(cells.count)])
    topology = Topology(torch.from_numpy(np.unique(keys, axis=0)))
    rows: Hosted | None = None
    occupied, final = (torch.zeros(topology.zero_row, dtype=torch.bool) for _ in range(2))
    for cell in range(cells.count):
        field = load(cell)
        rows = rows or plain_rows(topology, field.feature_rows.shape[1], spill=True)
        slots = topology.find(field.topology.keys)
        mine = torch.from_numpy(cells.owner_of(field.topology.keys.numpy(), field.resolution // coarse.resolution) == cell)
        used = corner_nodes(field.topology, field.occupied).view(-1, VOXELS)
        for owned in (False, True):
            place = (used & (mine == owned)[:, None]).nonzero()
            source, target = place[:, 0] * VOXELS + place[:, 1], slots[place[:, 0]] * VOXELS + place[:, 1]
            if owned:
                final[target] = True
            else:
                source, target = source[~final[target]], target[~final[target]]
            rows.density[target], rows.feature[target] = field.density_rows[source], field.feature_rows[source]
        occupied.view(-1, VOXELS)[slots[mine]] = field.occupied.view(-1, VOXELS)[mine]
        resolution = field.resolution
    assert rows is not None
    return in_rows(coarse, rows, occupied, resolution).settled()


def check_coverage(coarse: Field, seen: Array, cells: Cells, result: Field) -> list[str]:
    """Every block of the coarse field that training rays saw has to be there in the result.

    Args:
        seen: (M,) rays that saw each block of the coarse field.

    Returns:
        a sentence where single blocks were found empty by their cell.

    Raises:
        NotCoveredError: a cell has lost half of what rays saw in it, or more.
    """
    ratio = result.resolution // coarse.resolution
    filled = result.topology.keys[result.occupied.view(-1, VOXELS).any(1)]
    slots = coarse.topology.find(torch.div(filled, ratio, rounding_mode="floor")).numpy()
    there = np.zeros(coarse.blocks, bool)
    there[slots[slots >= 0]] = True
    for cell in range(cells.count):
        own = cells.owner == cell
        kept, all_of_it = int(seen[own & there].sum()), int(seen[own].sum())
        if 2 * kept <= all_of_it and all_of_it:
            share = f"{kept / all_of_it:.0%} of what training rays see in it"
            raise NotCoveredError(f"cell {cell + 1} of {cells.count} came back with {share}; please report this")
    lost = (seen > 0) & ~there
    if not lost.any():
        return []
    rays = f"{seen[lost].sum() / seen.sum():.1%} of the rays"
    return [f"cells: {lost.sum()} of {(seen > 0).sum()} blocks that the coarse field has ({rays}) were found to be empty"]
