"""A scene cut into cells: blocks of a coarse field along the Morton order, each owned by exactly one cell.

A cell refines what it owns and a halo around that; everything else it sees as the coarse field, which stays as it is (`Field.outer`).
Neighbours along the Morton order are neighbours in space, so a run of them is compact, and the order does not depend on who fits what.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
import torch

from fieldfuse.render.field import Field
from fieldfuse.volume.topology import BLOCK

Array = np.ndarray[Any, Any]
HALO = 2  # blocks about what a cell owns that it fits as well
BITS = 21  # of each coordinate in a Morton code


@dataclass(frozen=True)
class Cells:
    """Which cell owns which block.

    Attributes:
        keys: (M, 3) int32 blocks of the coarse field, in its order.
        owner: (M,) int32 cell of each.
        count: cells.
    """

    keys: Array
    owner: Array
    count: int

    @cached_property
    def _table(self) -> tuple[Array, Array]:
        """Owners by place (x, y, z), −1 where there is no block, with a margin of one; and the place of key (0, 0, 0)."""
        low = self.keys.min(0) - 1
        table = np.full(self.keys.max(0) - low + 2, -1, np.int32)
        table[tuple((self.keys - low).T)] = self.owner
        return table, -low

    def owner_of(self, keys: Array, ratio: int) -> Array:
        """(N, 3) blocks of a lattice finer by `ratio` → (N,) their cells, −1 where the coarse field has no block."""
        table, origin = self._table
        place = np.clip(np.floor_divide(keys, ratio) + origin, 0, np.array(table.shape) - 1)
        return np.asarray(table[tuple(place.T)])

    def in_region(self, keys: Array, ratio: int, cell: int) -> Array:
        """(N, 3) blocks of a lattice finer by `ratio` → (N,) bool: owned by `cell`, or at most `HALO` blocks from one that is."""
        near = np.zeros(len(keys), bool)
        for shift in product(range(-HALO, HALO + 1), repeat=3):
            near |= self.owner_of(keys + shift, ratio) == cell
        return near


def morton(keys: Array) -> Array:
    """(M, 3) integers → (M,) uint64 codes that sort them along a curve through space, bits of x, y and z in turns; counted from the lowest
    of each coordinate."""
    code = np.zeros(len(keys), np.uint64)
    for axis, values in enumerate((keys - keys.min(0)).astype(np.uint64).T):
        for bit in range(BITS):
            code |= ((values >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return code


def cut(keys: Array, work: Array, count: int) -> Cells:
    """At most `count` cells of the blocks `keys` (M, 3), with about equal sums of `work` (M,) ≥ 0."""
    order = np.argsort(morton(keys), kind="stable")
    before = np.cumsum(work[order]) - 0.5 * work[order]
    place = np.minimum((before * count / max(float(work.sum()), 1e-9)).astype(np.int64), count - 1)
    used, numbers = np.unique(place, return_inverse=True)  # where one block has more than its share, a cell may get none
    owner = np.empty(len(keys), np.int32)
    owner[order] = numbers
    return Cells(np.asarray(keys, np.int32), owner, len(used))


def region_mask(field: Field, cells: Cells, cell: int, coarse: int, resolution: int) -> torch.Tensor:
    """(M · 512,) bool: the occupied voxels of `field` that lie in the region of `cell` on the lattice of `resolution`.

    Args:
        coarse: resolution of the lattice that the cells are cut on; `resolution` is at most 8 times the field's.
    """
    parts = resolution // field.resolution  # blocks of that lattice along the side of one of the field's
    shifts = np.array([(x, y, z) for z, y, x in product(range(parts), repeat=3)])
    keys = (field.topology.keys.numpy().astype(np.int64)[:, None] * parts + shifts).reshape(-1, 3)
    inside = torch.from_numpy(cells.in_region(keys, resolution // coarse, cell)).view(-1, parts, 1, parts, 1, parts, 1)
    side = BLOCK // parts
    voxels = inside.expand(-1, parts, side, parts, side, parts, side).reshape(-1)
    return voxels & field.occupied
