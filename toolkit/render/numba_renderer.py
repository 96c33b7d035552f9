"""A field as numba's kernels read it, and renders of it: the CPU's fast path."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import torch

from fieldfuse.backends.numba import common as K
from fieldfuse.backends.numba import decode, per_sample, render
from fieldfuse.backends.numba.volume import chessboard_distance
from fieldfuse.nerfusion.decoder import Deferred
from fieldfuse.render.composite import STOP, THRESHOLD
from fieldfuse.render.field import Field
from fieldfuse.render.march import MarchGrid
from fieldfuse.threads import share
from fieldfuse.volume.topology import VOXELS

Tensor = torch.Tensor
Array = np.ndarray[Any, Any]
FARTHEST = 15  # bricks; distances are capped here
PIECE = 4096  # rays that a thread takes at a time


def decoder_arrays(decoder: Deferred) -> K.Decoder:
    """Copies of the weights."""
    first, second, last = decoder.layers
    w1, w2, w3 = (np.array(layer.weight.detach().cpu().numpy(), dtype=np.float32) for layer in (first, second, last))
    b1, b2, b3 = (np.array(layer.bias.detach().cpu().numpy(), dtype=np.float32) for layer in (first, second, last))
    return K.Decoder(np.ascontiguousarray(w1.T), w1, b1, np.ascontiguousarray(w2.T), w2, b2, w3, b3)


def make_space(field: Field) -> K.Space:
    """The field's scalars."""
    space, f = field.space, np.float32
    cx, cy, cz = (f(c) for c in space.centre)
    bx, by, bz = (f(b) for b in space.box)
    ox, oy, oz = (int(c) for c in field.topology.table_origin)
    size = (f(field.grid.voxel), f(field.near), int(field.fine), int(field.resolution))
    width = (0,) * field.feature_rows.shape[1]
    return K.Space(cx, cy, cz, f(space.half), f(space.shell), f(space.extent), bx, by, bz, *size, ox, oy, oz, width)


def make_volume(field: Field) -> K.Volume:
    """The field's arrays; densities and features are the field's own memory, so what a fit changes is seen here at once."""
    filled = field.grid.bricks.numpy() > 0
    if field.outer is None:
        table, bits, upper = np.empty((0, 0, 0), np.int32), np.empty((0, 8), np.uint64), np.empty((0, 8), np.int32)
        outer = K.Outer(table, bits, upper, np.empty(0, np.float32), np.empty((0, 1), np.float32), 0, 0, 0, np.float32(0))
    else:
        around = field.outer
        x, y, z = (int(c) for c in around.topology.table_origin)
        outer = K.Outer(*_arrays(around), x, y, z, np.float32(around.resolution / field.resolution))
        filled = filled | _on_finer_bricks(around.grid, len(filled))
    bricks = np.where(filled, np.uint8(0), np.uint8(FARTHEST))
    chessboard_distance(bricks, FARTHEST)
    table, bits, upper, density, feature = _arrays(field)
    return K.Volume(table, bricks, bits, upper, density, feature, outer)


def _arrays(field: Field) -> tuple[Array, Array, Array, Array, Array]:
    """Table, bits, upper, density and feature of `common.Volume`."""
    topology = field.topology
    upper = topology.around[:, [13, 14, 16, 17, 22, 23, 25, 26]]
    upper = torch.where(upper < 0, topology.blocks, upper).to(torch.int32).contiguous()
    bits = np.packbits(field.occupied.numpy().reshape(-1, VOXELS), axis=1, bitorder="little").view(np.uint64)
    return topology.table.numpy(), bits, upper.numpy(), field.density_rows.detach().numpy(), field.feature_rows.detach().numpy()


@lru_cache(maxsize=1)  # the outer field stays the same while a cell is fitted
def _on_finer_bricks(grid: MarchGrid, width: int) -> Array:
    """The bricks of a lattice that hold something, with a margin of one → those of a finer one, (width,) × 3, that touch any of them."""
    filled = grid.bricks.numpy() > 0
    ratio = (len(filled) - 2) / (width - 2)
    place = np.arange(width) - 1
    low, high = np.floor(place * ratio).astype(int) + 1, np.ceil((place + 1) * ratio).astype(int)
    low, high = (np.clip(ends, 0, len(filled) - 1) for ends in (low, high))
    for axis in range(3):
        filled = np.take(filled, low, axis) | np.take(filled, high, axis)
    return filled


class NumbaRenderer:
    """Renders rays of one field on the CPU; makes the kernels' arrays once.

    Args:
        weights: the decoder's as the kernels have them (`decode.Layers` or `per_sample.Net`), which stay the caller's; None: a copy.
    """

    def __init__(self, field: Field, threads: int | None = None, weights: decode.Layers | per_sample.Net | None = None) -> None:
        self.space, self.volume, self.background = make_space(field), make_volume(field), field.background.numpy().astype(np.float32)
        self.threads = threads or torch.get_num_threads()
        self.weights: Any
        self._pass: Any
        self._room: Any
        if isinstance(field.decoder, Deferred):
            self.weights = weights or decode.layers_of(decoder_arrays(field.decoder))
            self._pass, self._room, self.threshold = render.render_pass, decode.rays_of, THRESHOLD
        else:
            self.weights = weights or per_sample.net_of(field.decoder)
            self._pass, self._room, self.threshold = per_sample.render_pass, per_sample.make_tape, per_sample.NEGLIGIBLE

    def render(self, origins: Tensor, directions: Tensor) -> Tensor:
        """(B, 3), (B, 3) → (B, 5): colour, distance, opacity. The same whatever the number of threads."""
        out = np.empty((len(origins), 5), np.float32)
        lines = origins.float().contiguous().numpy(), directions.float().contiguous().numpy()
        fixed, limits = (self.space, self.volume, self.weights), (np.float32(STOP), np.float32(self.threshold))

        def part(piece: slice) -> None:
            self._pass(*fixed, self._room(self.weights), self.background, lines[0][piece], lines[1][piece], *limits, out[piece])

        size = max(min(PIECE, len(out) // self.threads), 1)
        share(part, [slice(start, start + size) for start in range(0, len(out), size)], self.threads)
        return torch.from_numpy(out)
