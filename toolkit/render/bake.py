"""Baking: a finished field as few, small, read-only arrays that a compiled kernel renders without unpacking them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from fieldfuse.backends.numba import common as K
from fieldfuse.backends.numba.baked import CORNERS, FINER, LEVELS, Baked
from fieldfuse.backends.numba.volume import chessboard_distance
from fieldfuse.errors import InputError
from fieldfuse.nerfusion.decoder import Deferred
from fieldfuse.render.composite import RAW_MAX, UNITS
from fieldfuse.render.field import Field
from fieldfuse.render.numba_renderer import FARTHEST, decoder_arrays
from fieldfuse.volume.edit import erase_empty_blocks
from fieldfuse.volume.space import Space
from fieldfuse.volume.topology import LOOKUP, VOXELS, Topology

Array = np.ndarray[Any, Any]
CHUNK = 512  # blocks at a time
OUTLIERS = 1e-3  # share of the corners on either side whose values are clipped, so that few far values do not coarsen all others


@dataclass(frozen=True)
class BakedField:
    """A baked field: arrays, decoder, and the space that they live in.

    Attributes:
        space, resolution, near, fine, table_origin: see `Field` and `Topology`.
        background: (3,) float32.
        arrays: see `baked_march.Baked`; they may be windows into a file.
        decoder: the weights, float32.
        sky: (9, 3) float32, see `Field`; None: there is none.
    """

    space: Space
    resolution: int
    near: float
    fine: int
    table_origin: tuple[int, int, int]
    background: Array
    arrays: Baked
    decoder: K.Decoder
    sky: Array | None = None

    @property
    def voxels(self) -> int:
        """Occupied voxels."""
        return len(self.arrays.packed)

    @property
    def corners(self) -> int:
        """Stored corners; one on a face between two blocks is stored with each."""
        return len(self.arrays.feature)

    @property
    def bytes(self) -> int:
        """Of all arrays."""
        return sum(array.nbytes for array in self.arrays) + sum(array.nbytes for array in self.decoder)

    def kernel_space(self) -> K.Space:
        """The scalars as the kernels take them."""
        f = np.float32
        extent = self.space.extent
        channels = self.arrays.feature.shape[1]
        centre, box = (tuple(f(v) for v in values) for values in (self.space.centre, self.space.box))
        scalars = (
            *centre,
            f(self.space.half),
            f(self.space.shell),
            f(extent),
            *box,
            f(2 * extent / self.resolution),
            f(self.near),
            self.fine,
            self.resolution,
            *self.table_origin,
            (0,) * channels,
        )
        return K.Space._make(scalars)


def bake(field: Field, keep: torch.Tensor | None = None) -> BakedField:
    """Quantise a field: eight bits a feature and a corner's raw density, only what lies beside occupied voxels.

    Args:
        keep: (M · 512,) bool, the voxels that stay (see `bake_views.seen_voxels`); None: all that are occupied.

    Raises:
        InputError: the decoder is not the deferred one, or nothing is left.
    """
    if not isinstance(field.decoder, Deferred):
        raise InputError("only a field with the deferred decoder can be baked; fit it with --decoder deferred")
    field = _ordered(field.to("cpu"), keep)
    if field.voxels == 0:
        raise InputError("the field holds no voxel that training views see, so there is nothing to bake; fit it for longer")
    topology = field.topology
    occupied = field.occupied.numpy().reshape(-1, VOXELS)
    occupied = occupied[: int(occupied.any(1).sum())]  # the blocks behind them only lend corners
    counts = occupied.reshape(-1, 64).sum(1, dtype=np.int64)
    rows, base, total = _corner_index(occupied)
    raw = field.density_rows.detach().numpy()
    low_raw, step = _density_range(field, raw)
    packed = np.empty(int(counts.sum()), np.uint64)
    feature = np.empty((total, field.feature_rows.shape[1]), np.uint8)
    low, scale = _feature_range(field)
    done_voxels, done_corners = 0, 0
    values = field.feature_rows.detach().numpy()
    for start in range(0, len(occupied), CHUNK):
        part = occupied[start : start + CHUNK]
        at = topology.lookup_chunk(start, start + len(part)).numpy()
        stored = values[at[_corners_beside(part).reshape(-1, LOOKUP)]]
        feature[done_corners : done_corners + len(stored)] = np.rint(np.clip((stored - low) / scale, 0, LEVELS))
        done_corners += len(stored)
        levels = np.rint(np.clip((raw[at] - low_raw) / step, 0, LEVELS)).astype(np.uint8).reshape(-1, CORNERS, CORNERS, CORNERS)
        eight = [levels[:, z : z + 8, y : y + 8, x : x + 8].reshape(-1, VOXELS)[part] for z in (0, 1) for y in (0, 1) for x in (0, 1)]
        packed[done_voxels : done_voxels + len(eight[0])] = np.stack(eight, 1).view("<u8").reshape(-1)
        done_voxels += len(eight[0])
    table = np.exp(np.minimum(low_raw + step / FINER * np.arange(LEVELS * FINER + 1), RAW_MAX)) * UNITS
    bricks = np.where(field.grid.bricks.numpy() > 0, np.uint8(0), np.uint8(FARTHEST))
    chessboard_distance(bricks, FARTHEST)
    arrays = Baked(
        table=np.where(topology.table.numpy() < len(occupied), topology.table.numpy(), np.int32(-1)),
        bricks=bricks,
        bits=np.packbits(occupied, axis=1, bitorder="little").view("<u8"),
        first=(np.cumsum(counts) - counts).astype(np.int32).reshape(-1, 8),
        packed=packed,
        rows=rows,
        base=base,
        feature=feature,
        thickness=table.astype(np.float32),
        scale=scale,
        low=low,
    )
    x, y, z = topology.table_origin
    background = field.background.numpy().astype(np.float32)
    assert isinstance(field.decoder, Deferred)
    sky = None if field.sky is None else field.sky.numpy()
    decoder = decoder_arrays(field.decoder)
    return BakedField(field.space, field.resolution, field.near, field.fine, (x, y, z), background, arrays, decoder, sky)


def _ordered(field: Field, keep: torch.Tensor | None) -> Field:
    """The field with only what stays, blocks in Morton order: neighbours in space are neighbours in memory and in the file."""
    occupied = field.occupied if keep is None else field.occupied & keep.cpu()
    rows = [field.density_rows.detach(), field.feature_rows.detach()]
    topology, occupied, rows = erase_empty_blocks(field.topology, occupied, rows)
    key = topology.keys.numpy().astype(np.int64)
    code = np.zeros(len(key), np.int64)
    for bit in range(16):
        for axis in range(3):
            code |= ((key[:, axis] - key[:, axis].min(initial=0)) >> bit & 1) << (3 * bit + axis)
    # Blocks that only lend corners come last; their values are copied into the blocks that need them.
    order = np.lexsort((code, ~occupied.view(-1, VOXELS).any(1).numpy()))
    chosen = torch.from_numpy((order[:, None] * VOXELS + np.arange(VOXELS)).reshape(-1))
    chosen = torch.cat([chosen, torch.tensor([topology.zero_row])])
    density, feature = (values[chosen] for values in rows)
    return replace(
        field, topology=Topology(topology.keys[order]), occupied=occupied[chosen[:-1]], density_rows=density, feature_rows=feature
    )


def _corners_beside(occupied: Array) -> Array:
    """(m, 512) bool → (m, 9, 9, 9) bool corners of occupied voxels."""
    out = np.zeros((len(occupied), CORNERS, CORNERS, CORNERS), bool)
    cube = occupied.reshape(-1, 8, 8, 8)
    for z in (0, 1):
        for y in (0, 1):
            for x in (0, 1):
                out[:, z : z + 8, y : y + 8, x : x + 8] |= cube
    return out


def _corner_index(occupied: Array) -> tuple[Array, Array, int]:
    """(M, 512) bool → rows (M, 81) int32 and base (M,) int32 of `Baked`, and how many corners are stored.

    Raises:
        InputError: more corners than int32 numbers.
    """
    rows = np.empty((len(occupied), CORNERS * CORNERS), np.int32)
    counts = np.empty(len(occupied), np.int64)
    for start in range(0, len(occupied), CHUNK):
        mask = _corners_beside(occupied[start : start + CHUNK]).reshape(-1, CORNERS * CORNERS, CORNERS)
        here = mask.sum(2)
        bits = (mask << np.arange(CORNERS)).sum(2)
        rows[start : start + CHUNK] = bits | ((np.cumsum(here, 1) - here) << CORNERS)
        counts[start : start + CHUNK] = here.sum(1)
    total = int(counts.sum())
    if total >= 2**31:
        raise InputError(f"the field has {total} corners, more than a baked file holds; choose a lower resolution")
    return rows, (np.cumsum(counts) - counts).astype(np.int32), total


def _density_range(field: Field, raw: Array) -> tuple[float, float]:
    """Lowest raw density and step of its quantisation, from the corners that are used."""
    low, high = _range(raw[_used_corners(field)][:, None])
    return float(low[0]), float(high[0])


def _feature_range(field: Field) -> tuple[Array, Array]:
    """(C,) lowest feature and step, from the corners that are used."""
    return _range(field.feature_rows.detach().numpy()[_used_corners(field)])


def _used_corners(field: Field, most: int = 200_000) -> Array:
    """Rows of corners beside occupied voxels; of many, a regular part."""
    from fieldfuse.volume.edit import corner_nodes

    rows = np.flatnonzero(corner_nodes(field.topology, field.occupied).numpy())
    return rows[:: max(1, len(rows) // most)]


def _range(values: Array) -> tuple[Array, Array]:
    """(N, C) → (C,) float32 lowest value and step, but for `OUTLIERS`."""
    low, high = np.quantile(values, [OUTLIERS, 1 - OUTLIERS], axis=0)
    return low.astype(np.float32), np.maximum((high - low) / LEVELS, 1e-6).astype(np.float32)
