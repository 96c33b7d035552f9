"""A field as numba's kernels read it, and renders of it: the CPU's fast path."""

from __future__ import annotations

import numpy as np
import torch

from fieldfuse.backends.numba import common as K
from fieldfuse.backends.numba.decode import layers_of, rays_of
from fieldfuse.backends.numba.render_rays import chessboard_distance, render_pass
from fieldfuse.nerfusion.decoder import Deferred
from fieldfuse.render.composite import STOP, THRESHOLD
from fieldfuse.render.field import Field
from fieldfuse.threads import share
from fieldfuse.volume.topology import VOXELS

Tensor = torch.Tensor
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


class NumbaRenderer:
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
