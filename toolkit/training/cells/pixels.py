"""Which rays see what: the work that blocks make, and the pixels of a cell, which are those whose rays it holds some light of.

Rays of every `STRIDE`-th pixel of every `STRIDE`-th row stand for those around them, so a cell's pixels reach a little beyond them.
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
import torch

from fieldfuse.backends.constants import STOP
from fieldfuse.backends.numba.cells import light_held
from fieldfuse.camera import Array, Intrinsics, rays
from fieldfuse.capture.types import Views
from fieldfuse.render.composite import THRESHOLD
from fieldfuse.render.field import Field
from fieldfuse.render.numba_renderer import make_space, make_volume
from fieldfuse.threads import share
from fieldfuse.training.cells.partition import Cells
from fieldfuse.training.pixels import PixelPool

STRIDE = 4
WIDER = 1  # such places about one at which a cell is seen that are its pixels, too: its halo is seen there
LEAST = 0.05  # of the light that a ray loses, be it little, as before a sky: what a cell holds less of, others explain


class Sight:
    """What rays of a coarse field see of its blocks."""

    def __init__(self, field: Field, threads: int | None = None) -> None:
        self.field, self.space, self.volume = field, make_space(field), make_volume(field)
        self.threads = threads or torch.get_num_threads()

    def rays_of_blocks(self, views: Views) -> Array:
        """(M,) int64: how many of the rays tried see each block."""
        owner, counts = np.arange(self.field.blocks, dtype=np.int32), np.zeros((self.threads, self.field.blocks), np.int64)
        none, each = np.zeros((0, 0), np.bool_), np.array_split(np.arange(len(views)), self.threads)

        def part(thread: int) -> None:
            for index in each[thread]:
                self._look(_lines(views, int(index))[0], owner, counts[thread], none)

        share(part, list(range(self.threads)), self.threads)
        return np.asarray(counts.sum(0))

    def cells_of_pixels(self, views: Views, cells: Cells) -> Iterator[Array]:
        """For each view (C, h, w) bool: the places, `STRIDE` pixels a side, that each cell is seen at, or one beside them."""
        for index in range(len(views)):
            lines, (high, wide) = _lines(views, index)
            out = np.zeros((len(lines), cells.count), np.bool_)
            pieces = [slice(start, start + 4096) for start in range(0, len(lines), 4096)]
            share(lambda piece: self._look(lines[piece], cells.owner, np.zeros(cells.count, np.int64), out[piece]), pieces, self.threads)  # noqa: B023
            seen = np.ascontiguousarray(out.reshape(high, wide, cells.count).transpose(2, 0, 1)).view(np.uint8)
            yield np.array([cv2.dilate(one, np.ones((2 * WIDER + 1,) * 2, np.uint8)) for one in seen]).astype(bool)

    def _look(self, lines: Array, owner: Array, counts: Array, out: Array) -> None:
        limits = np.float32(STOP), np.float32(THRESHOLD)
        light_held(self.space, self.volume, lines, *limits, owner, np.float32(LEAST), counts, out)


def _lines(views: Views, index: int) -> tuple[Array, tuple[int, int]]:
    """(B, 6) float32 rays of a view, and how many rows and columns of them there are."""
    camera = views.intrinsics[index]
    high, wide = _grid(camera)
    row, column = np.mgrid[:high, :wide]
    pixels = np.stack([column, row], 2).reshape(-1, 2) * STRIDE + 0.5 * STRIDE
    origins, directions, _ = rays(camera, views.world_from_camera[index], pixels)
    return np.concatenate([origins.numpy(), directions.numpy()], 1).astype(np.float32), (high, wide)


def _grid(camera: Intrinsics) -> tuple[int, int]:
    return -(-camera.height // STRIDE), -(-camera.width // STRIDE)


def pools(views: Views, cells: Cells, sight: Sight, depth: bool) -> Iterator[PixelPool]:
    """The pixels of each cell, one after the other.

    Args:
        views: training views alone.
        depth: distances of known surfaces are stored, too.
    """
    seen = [np.packbits(one, axis=0) for one in sight.cells_of_pixels(views, cells)]
    whole = PixelPool(views, depth=depth)
    for cell in range(cells.count):
        held = ((bits[cell // 8] >> (7 - cell % 8) & 1).astype(bool) for bits in seen)
        yield whole.some([(view, _pixels(places, views.intrinsics[view].width)) for view, places in enumerate(held) if places.any()])


def _pixels(places: Array, width: int) -> torch.Tensor:
    """(h, w) bool by places → (≥ H · W,) bool, the pixels of an image so wide, row after row."""
    return torch.from_numpy(places.repeat(STRIDE, 0).repeat(STRIDE, 1)[:, :width].reshape(-1))
