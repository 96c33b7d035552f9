"""A field as the compiled kernels see it, and pictures of it through them: the CPU's fast path for rendering."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import njit

from fieldfuse.nerfusion.decoder import Deferred
from fieldfuse.render import kernels as K
from fieldfuse.render.composite import STOP, THRESHOLD
from fieldfuse.render.field import Field
from fieldfuse.render.kernels_decode import RAYS, decode, encode_direction, layers_of, rays_of
from fieldfuse.render.kernels_lookup import gather_row
from fieldfuse.render.kernels_march import march_ray
from fieldfuse.render.kernels_row import add_to
from fieldfuse.threads import share
from fieldfuse.volume.topology import VOXELS

Tensor = torch.Tensor
MOST_KEPT = 1024  # samples of one ray whose weight exceeds the threshold: they sum to at most 1
FARTHEST = 15  # bricks; distances are capped here
PIECE = 4096  # rays that a thread takes at a time


def decoder_arrays(decoder: Deferred) -> K.Decoder:
    """Copies of the weights."""
    first, second, last = decoder.layers
    w1, w2, w3 = (np.array(layer.weight.detach().cpu().numpy(), dtype=np.float32) for layer in (first, second, last))
    b1, b2, b3 = (np.array(layer.bias.detach().cpu().numpy(), dtype=np.float32) for layer in (first, second, last))
    return K.Decoder(np.ascontiguousarray(w1.T), w1, b1, np.ascontiguousarray(w2.T), w2, b2, w3, b3)


@njit(**K.OPTIONS)
def chessboard_distance(bricks: Any, most: Any) -> None:
    """In place: 0 where something is, else `most` → distance along the longest axis, capped; two sweeps are exact for it.

    Each sweep takes rows from four rows that it has been to, many bricks at a time, and then goes along the row.
    """
    a, b, c = bricks.shape
    far, one = np.uint8(most), np.uint8(1)
    near = np.empty(c + 2, np.uint8)  # the nearest of the four rows, with a margin
    for sweep in range(2):
        way = 1 if sweep == 0 else -1
        for i0 in range(a):
            i = i0 if sweep == 0 else a - 1 - i0
            for j0 in range(b):
                j = j0 if sweep == 0 else b - 1 - j0
                row = bricks[i, j]
                near[:] = far
                for side in range(4):
                    p, q = (i, j - way) if side == 3 else (i - way, j + side - 1)
                    if 0 <= p < a and 0 <= q < b:
                        other = bricks[p, q]
                        for k in range(c):
                            here, there = near[k + 1], other[k]
                            near[k + 1] = there if there < here else here
                for k in range(c):
                    left, here, right = near[k], near[k + 1], near[k + 2]
                    here = left if left < here else here
                    here = np.uint8((right if right < here else here) + one)
                    row[k] = here if here < row[k] else row[k]
                last = far
                for k0 in range(c):
                    k = k0 if sweep == 0 else c - 1 - k0
                    step, here = np.uint8(last + one), row[k]
                    last = step if step < here else here
                    row[k] = last


def make_space(field: Field) -> K.Space:
    """The field's scalars."""
    space, f = field.space, np.float32
    cx, cy, cz = (f(c) for c in space.centre)
    bx, by, bz = (f(b) for b in space.box)
    ox, oy, oz = (int(c) for c in field.topology.table_origin)
    channels = field.feature_rows.shape[1]
    return K.Space(
        *(cx, cy, cz, f(space.half), f(space.shell), f(space.extent), bx, by, bz),
        voxel=f(field.grid.voxel),
        near=f(field.near),
        fine=int(field.fine),
        resolution=int(field.resolution),
        ox=ox,
        oy=oy,
        oz=oz,
        width=(0,) * channels,
    )


def make_volume(field: Field) -> K.Volume:
    """The field's arrays; densities and features are the field's own memory, so what a fit changes is seen here at once."""
    topology = field.topology
    assert topology.table is not None
    upper = topology.around[:, [13, 14, 16, 17, 22, 23, 25, 26]]
    upper = torch.where(upper < 0, topology.blocks, upper).to(torch.int32).contiguous()
    bricks = np.where(field.grid.bricks.numpy() > 0, np.uint8(0), np.uint8(FARTHEST))
    chessboard_distance(bricks, FARTHEST)
    bits = np.packbits(field.occupied.numpy().reshape(-1, VOXELS), axis=1, bitorder="little").view(np.uint64)
    return K.Volume(
        topology.table.numpy(), bricks, bits, upper.numpy(), field.density_rows.detach().numpy(), field.feature_rows.detach().numpy()
    )


@njit(**K.OPTIONS)
def render_pass(
    space: Any, volume: Any, layers: Any, tape: Any, background: Any, origins: Any, directions: Any, stop: Any, threshold: Any, out: Any
) -> None:
    """Deferred rendering: origins, directions (B, 3) → out (B, 5) colour, distance, opacity. `tape` is this thread's own."""
    channels = len(space.width)
    cells, values = np.empty(MOST_KEPT, np.int32), np.empty((MOST_KEPT, K.VALUES), np.float32)
    rows, weights = np.empty((MOST_KEPT, 8), np.int32), np.empty((MOST_KEPT, 8), np.float32)
    features, mean, result = np.empty((MOST_KEPT, channels), np.float32), np.empty(channels, np.float32), np.empty(4, np.float32)
    marks, feature, given, colour = np.empty(0, np.uint16), volume.feature, tape.given, tape.colour
    for begin in range(0, len(origins), RAYS):
        count = min(RAYS, len(origins) - begin)
        for one in range(count):
            ray = begin + one
            ox, oy, oz = origins[ray, 0], origins[ray, 1], origins[ray, 2]
            dx, dy, dz = directions[ray, 0], directions[ray, 1], directions[ray, 2]
            kept = march_ray(space, volume, ox, oy, oz, dx, dy, dz, K.ZERO, stop, threshold, marks, K.START, cells, rows, values, result)
            for c in range(channels):
                mean[c] = K.ZERO
            opacity = K.ZERO
            for i in range(kept):
                gather_row(space.width, feature, rows, values, weights, features, i)
                weight = values[i, K.WEIGHT]
                opacity += weight
                add_to(space.width, mean, features, i, weight)
            share = K.ONE / max(opacity, K.F(1e-6))
            for c in range(channels):
                given[one, c] = mean[c] * share
            encode_direction(dx, dy, dz, given, one, channels)
            out[ray, 3], out[ray, 4] = result[0], opacity
        decode(layers, tape, count)
        for one in range(count):
            opacity = out[begin + one, 4]
            for k in range(3):
                out[begin + one, k] = min(max(colour[one, k] * opacity + (K.ONE - opacity) * background[k], K.ZERO), K.ONE)


class CompiledRenderer:
    """Renders rays of one field (CPU, deferred decoder); makes the kernels' arrays once."""

    def __init__(self, field: Field, threads: int | None = None) -> None:
        assert isinstance(field.decoder, Deferred)
        self.space, self.volume, self.layers = make_space(field), make_volume(field), layers_of(decoder_arrays(field.decoder))
        self.background = field.background.numpy().astype(np.float32)
        self.threads = threads or torch.get_num_threads()

    def render(self, origins: Tensor, directions: Tensor, threshold: float = THRESHOLD) -> Tensor:
        """(B, 3), (B, 3) → (B, 5): colour, distance, opacity. The same whatever the number of threads."""
        out = np.empty((len(origins), 5), np.float32)
        given = origins.float().contiguous().numpy(), directions.float().contiguous().numpy()

        def part(piece: slice) -> None:
            arguments = (given[0][piece], given[1][piece], np.float32(STOP), np.float32(threshold), out[piece])
            render_pass(self.space, self.volume, self.layers, rays_of(self.layers), self.background, *arguments)

        size = max(min(PIECE, len(out) // self.threads), 1)
        pieces = [slice(start, start + size) for start in range(0, len(out), size)]
        share(part, pieces, self.threads)
        return torch.from_numpy(out)
