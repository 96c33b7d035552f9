"""Baking: a finished field as few, small, read-only arrays: what `baked.safetensors` and a browser's page hold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch

from fieldfuse.backends.constants import SOLID
from fieldfuse.backends.numba import common as K
from fieldfuse.backends.numba.march import mark_pass
from fieldfuse.backends.numba.volume import chessboard_distance
from fieldfuse.camera import Intrinsics
from fieldfuse.errors import InputError
from fieldfuse.nerfusion.decoder import Deferred
from fieldfuse.progress import SILENT, Progress
from fieldfuse.render.composite import RAW_MAX, STOP, UNITS
from fieldfuse.render.field import Field
from fieldfuse.render.numba_renderer import FARTHEST, decoder_arrays, make_space, make_volume
from fieldfuse.threads import share
from fieldfuse.volume.edit import corner_nodes, dilate, erase_empty_blocks, with_corner_blocks
from fieldfuse.volume.space import Space
from fieldfuse.volume.topology import VOXELS, Topology

Array = np.ndarray[Any, Any]
LEVELS = 255  # steps of a quantised value
FINER = 16  # entries of the table of optical thickness per step: interpolated densities lie between steps
CORNERS = 9  # corners along a block's side: those on its far faces are stored with it, so that no voxel needs a second block
CHUNK = 512  # blocks at a time
OUTLIERS = 1e-3  # share of the corners on either side whose values are clipped, so that few far values do not coarsen all others
MOST_CORNERS = 200_000  # that the range of values is taken from
SEEN = 0.01  # largest weight below which a voxel is excluded …
FIRM = 0.3  # … but for those beside one with as much: where thin surfaces have holes, renders from between the views see through them
MOST_RAYS = 2_000_000  # of all views together; of more pixels an even part is looked at


class Baked(NamedTuple):
    """A baked field's arrays. V: occupied voxels, R: stored corners, M: blocks that hold an occupied voxel."""

    table: Any  # (Sz, Sy, Sx) int32 slot or −1
    bricks: Any  # (B, B, B) uint8 distance in bricks to the nearest occupied one, with a margin of one
    bits: Any  # (M, 8) uint64 occupancy, one word a z-slice
    first: Any  # (M, 8) int32 number of occupied voxels before the z-slice
    packed: Any  # (V,) uint64: eight quantised raw densities, corner 0 in the lowest byte, x fastest
    rows: Any  # (M, 81) int32 corner row z · 9 + y: 9 bits say which corners are stored, above them how many are before in the block
    base: Any  # (M,) int32 stored corners before the block
    feature: Any  # (R, C) uint8
    thickness: Any  # (LEVELS · FINER + 1,) float32 σ of a quantised raw density
    scale: Any  # (C,) float32: feature = low + scale · value
    low: Any


@dataclass(frozen=True)
class BakedField:
    """A baked field: arrays, decoder, and the space that they live in.

    Attributes:
        space, resolution, near, fine, table_origin: see `Field` and `Topology`.
        background: (3,) float32.
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
        return sum(array.nbytes for array in (*self.arrays, *self.decoder))

    def keys(self) -> Array:
        """(M, 3) int32 keys of the blocks in the lattice."""
        cells = np.argwhere(self.arrays.table >= 0)  # z, y, x
        out = np.empty((len(self.arrays.base), 3), np.int32)
        out[self.arrays.table[tuple(cells.T)]] = cells[:, ::-1] + self.table_origin
        return out

    def corner_densities(self) -> Array:
        """(R,) uint8 quantised raw density of every stored corner, in the order of `Baked.feature`."""
        arrays, occupied = self.arrays, occupied_voxels(self.arrays.bits)
        stored, out, done = stored_corners(arrays.rows), np.empty(self.corners, np.uint8), 0
        for start in range(0, len(occupied), CHUNK):
            part = occupied[start : start + CHUNK]
            first = int(arrays.first[start, 0])
            eight = np.asarray(arrays.packed[first : first + int(part.sum())]).view(np.uint8).reshape(-1, 8)
            grid = np.zeros((len(part), CORNERS, CORNERS, CORNERS), np.uint8)
            slot, cell = np.nonzero(part)
            z, y, x = cell >> 6, cell >> 3 & 7, cell & 7
            for corner in range(8):
                grid[slot, z + (corner >> 2), y + (corner >> 1 & 1), x + (corner & 1)] = eight[:, corner]
            values = grid.reshape(len(part), -1)[stored[start : start + CHUNK]]
            out[done : done + len(values)] = values
            done += len(values)
        return out

    def to_field(self) -> Field:
        """The field that the bytes stand for: it is rendered as any other."""
        arrays, own = self.arrays, len(self.arrays.base)
        occupied = torch.from_numpy(occupied_voxels(arrays.bits).reshape(-1))
        topology, occupied = with_corner_blocks(Topology(torch.from_numpy(self.keys())), occupied)
        stored, done = stored_corners(arrays.rows), 0
        density = np.zeros(topology.zero_row + 1, np.float32)
        feature = np.zeros((len(density), arrays.feature.shape[1]), np.float32)
        raw = np.log(np.maximum(arrays.thickness[::FINER] / UNITS, np.finfo(np.float32).tiny))[self.corner_densities()]
        for start in range(0, own, CHUNK):
            part = stored[start : start + CHUNK]
            at = topology.lookup_chunk(start, start + len(part)).numpy()[part]
            density[at] = raw[done : done + len(at)]
            feature[at] = arrays.low + arrays.scale * arrays.feature[done : done + len(at)]
            done += len(at)
        decoder = Deferred(feature.shape[1], len(self.decoder.b1))
        weights = ((self.decoder.w1_out, self.decoder.b1), (self.decoder.w2_out, self.decoder.b2), (self.decoder.w3, self.decoder.b3))
        with torch.no_grad():
            for layer, (weight, bias) in zip(decoder.layers, weights, strict=True):
                layer.weight.copy_(torch.from_numpy(weight))
                layer.bias.copy_(torch.from_numpy(bias))
        background, sky = torch.from_numpy(self.background), None if self.sky is None else torch.from_numpy(self.sky)
        values = topology, occupied, torch.from_numpy(density), torch.from_numpy(feature), decoder, background
        return Field(self.space, self.resolution, *values, self.near, self.fine, sky)


def occupied_voxels(bits: Array) -> Array:
    """(M, 8) uint64 → (M, 512) bool."""
    return np.unpackbits(np.ascontiguousarray(bits).view(np.uint8), axis=1, bitorder="little").astype(bool)


def stored_corners(rows: Array) -> Array:
    """(M, 81) int32 → (M, 729) bool."""
    return (rows[:, :, None] >> np.arange(CORNERS) & 1).astype(bool).reshape(len(rows), -1)


def bake(field: Field, keep: torch.Tensor | None = None, like: BakedField | None = None) -> BakedField:
    """Quantise a field: eight bits a feature and a corner's raw density, only what lies beside occupied voxels.

    Args:
        keep: (M · 512,) bool, the voxels that stay (see `seen_voxels`); None: all that are occupied.
        like: a baked field whose bytes are to mean the same as the new one's; None: the range of each value is taken from `field`.

    Raises:
        InputError: the decoder is not the deferred one, or nothing is left.
    """
    if not isinstance(field.decoder, Deferred):
        raise InputError("only a field with the deferred decoder can be baked; fit it with --decoder deferred")
    decoder = decoder_arrays(field.decoder)
    field = _ordered(field.to("cpu"), keep)
    if field.voxels == 0:
        raise InputError("the field holds no voxel that training views see, so there is nothing to bake; fit it for longer")
    topology = field.topology
    occupied = field.occupied.numpy().reshape(-1, VOXELS)
    occupied = occupied[: int(occupied.any(1).sum())]  # the blocks behind them only lend corners
    first, rows, base, total = counted(occupied)
    raw, values = field.density_rows.detach().numpy(), field.feature_rows.detach().numpy()
    if like is None:
        used = np.flatnonzero(corner_nodes(topology, field.occupied).numpy())
        used = used[:: max(1, len(used) // MOST_CORNERS)]
        (low_raw, low), (step, scale) = zip(_range(raw[used, None]), _range(values[used]), strict=True)
        thickness = np.exp(np.minimum(low_raw + step / FINER * np.arange(LEVELS * FINER + 1), RAW_MAX)) * UNITS
    else:
        low, scale, thickness = like.arrays.low, like.arrays.scale, like.arrays.thickness
        low_raw, above = np.log(np.maximum(thickness[[0, FINER]], np.finfo(np.float32).tiny) / UNITS)
        step = np.maximum(above - low_raw, 1e-6)
    packed, feature = np.empty(int(occupied.sum()), np.uint64), np.empty((total, values.shape[1]), np.uint8)
    done_voxels, done_corners, stored = 0, 0, stored_corners(rows)
    for start in range(0, len(occupied), CHUNK):
        part = occupied[start : start + CHUNK]
        at = topology.lookup_chunk(start, start + len(part)).numpy()
        shown = values[at[stored[start : start + CHUNK]]]
        feature[done_corners : done_corners + len(shown)] = np.rint(np.clip((shown - low) / scale, 0, LEVELS))
        done_corners += len(shown)
        levels = np.rint(np.clip((raw[at] - low_raw) / step, 0, LEVELS)).astype(np.uint8).reshape(-1, CORNERS, CORNERS, CORNERS)
        eight = [levels[:, z : z + 8, y : y + 8, x : x + 8].reshape(-1, VOXELS)[part] for z in (0, 1) for y in (0, 1) for x in (0, 1)]
        packed[done_voxels : done_voxels + len(eight[0])] = np.stack(eight, 1).view("<u8").reshape(-1)
        done_voxels += len(eight[0])
    bricks = np.where(field.grid.bricks.numpy() > 0, np.uint8(0), np.uint8(FARTHEST))
    chessboard_distance(bricks, FARTHEST)
    table = topology.table.numpy()
    arrays = Baked(
        table=np.where(table < len(occupied), table, np.int32(-1)),
        bricks=bricks,
        bits=np.packbits(occupied, axis=1, bitorder="little").view("<u8"),
        first=first,
        packed=packed,
        rows=rows,
        base=base,
        feature=feature,
        thickness=thickness.astype(np.float32),
        scale=scale,
        low=low,
    )
    x, y, z = topology.table_origin
    background, sky = field.background.numpy().astype(np.float32), None if field.sky is None else field.sky.numpy()
    return BakedField(field.space, field.resolution, field.near, field.fine, (x, y, z), background, arrays, decoder, sky)


def _ordered(field: Field, keep: torch.Tensor | None) -> Field:
    """The field with only what stays, blocks in Morton order: neighbours in space are neighbours in memory and in the file."""
    occupied = field.occupied if keep is None else field.occupied & keep.cpu()
    topology, occupied, rows = erase_empty_blocks(field.topology, occupied, [field.density_rows.detach(), field.feature_rows.detach()])
    key = topology.keys.numpy().astype(np.int64)
    code = np.zeros(len(key), np.int64)
    for bit in range(16):
        for axis in range(3):
            code |= ((key[:, axis] - key[:, axis].min(initial=0)) >> bit & 1) << (3 * bit + axis)
    # Blocks that only lend corners come last; their values are copied into the blocks that need them.
    order = np.lexsort((code, ~occupied.view(-1, VOXELS).any(1).numpy()))
    chosen = torch.from_numpy((order[:, None] * VOXELS + np.arange(VOXELS)).reshape(-1))
    density, feature = (values[torch.cat([chosen, torch.tensor([topology.zero_row])])] for values in rows)
    return replace(field, topology=Topology(topology.keys[order]), occupied=occupied[chosen], density_rows=density, feature_rows=feature)


def counted(occupied: Array) -> tuple[Array, Array, Array, int]:
    """(M, 512) bool → `first`, `rows` and `base` of `Baked`, and how many corners are stored.

    Raises:
        InputError: more corners than int32 numbers.
    """
    voxels = occupied.reshape(-1, 64).sum(1, dtype=np.int64)
    rows, counts = np.empty((len(occupied), CORNERS * CORNERS), np.int32), np.empty(len(occupied), np.int64)
    for start in range(0, len(occupied), CHUNK):
        cube = occupied[start : start + CHUNK].reshape(-1, 8, 8, 8)
        beside = np.zeros((len(cube), CORNERS, CORNERS, CORNERS), bool)
        for z, y, x in np.ndindex(2, 2, 2):
            beside[:, z : z + 8, y : y + 8, x : x + 8] |= cube
        mask = beside.reshape(-1, CORNERS * CORNERS, CORNERS)
        here = mask.sum(2)
        rows[start : start + CHUNK] = (mask << np.arange(CORNERS)).sum(2) | ((np.cumsum(here, 1) - here) << CORNERS)
        counts[start : start + CHUNK] = here.sum(1)
    total = int(counts.sum())
    if total >= 2**31:
        raise InputError(f"the field has {total} corners, more than a baked file holds; choose a lower resolution")
    first = (np.cumsum(voxels) - voxels).astype(np.int32).reshape(-1, 8)
    return first, rows, (np.cumsum(counts) - counts).astype(np.int32), total


def _range(values: Array) -> tuple[Array, Array]:
    """(N, C) → (C,) float32 lowest value and step, but for `OUTLIERS`."""
    low, high = np.quantile(values, [OUTLIERS, 1 - OUTLIERS], axis=0)
    return low.astype(np.float32), np.maximum((high - low) / LEVELS, 1e-6).astype(np.float32)


def seen_voxels(
    field: Field, intrinsics: Sequence[Intrinsics], world_from_camera: Array, least: float = SEEN, progress: Progress = SILENT
) -> torch.Tensor:
    """(M · 512,) bool: voxels that hold more than `least` of some pixel's light, over pinhole views (N, 4, 4), and those beside a voxel
    that holds more than `FIRM` of it. What no view saw was never fitted, and costs memory and time.

    Raises:
        Interrupted: the user asked to stop.
    """
    weight = seen_weights(field, intrinsics, world_from_camera, progress, least)
    return (weight > least) | (dilate(field.topology, weight > max(FIRM, least), 1, grow=False)[1] & field.occupied)


def seen_weights(
    field: Field, intrinsics: Sequence[Intrinsics], world_from_camera: Array, progress: Progress = SILENT, least: float = 0.0
) -> torch.Tensor:
    """(M · 512,) largest share of a pixel's light that a voxel holds, over pinhole views (N, 4, 4); 1 for the strongest of a ray that ends.
    Shares that are less than `least` may be missing: rays end where no more is left.

    Raises:
        Interrupted: the user asked to stop.
    """
    space, volume, threads = make_space(field), make_volume(field), torch.get_num_threads()
    cameras = np.array([(c.fx, c.fy, c.cx, c.cy, c.width, c.height) for c in intrinsics], np.float32).reshape(-1, 6)
    poses = np.ascontiguousarray(world_from_camera[:, :3], np.float32)
    stride = -(-sum(c.width * c.height for c in intrinsics) // MOST_RAYS) or 1
    marks, stop = np.zeros((threads, len(field.occupied)), np.uint16), np.float32(min(max(least, STOP), SOLID))

    def part(thread: int) -> None:
        for view in range(thread, len(cameras), threads):
            if progress.stopping():
                return
            if thread == 0:
                progress.update(view, len(cameras), "looking where training views look")
            mark_pass(space, volume, cameras, poses, view, view + 1, stride, stop, marks[thread])

    share(part, range(threads), threads)
    progress.check()
    return torch.from_numpy((marks.max(0) >> 4).astype(np.float32) / 4095)
