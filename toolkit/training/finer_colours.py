"""Colours finer than the shape they lie on: the networks' field, its colours looked up in the images on ever finer lattices.

The networks work on voxels of some pixels, since sparse convolutions cost most of direct inference. Shape is smooth at that scale, colours
are not, and to look them up (`render.color_backprojection`) costs little at any scale. So voxels that the images see are divided, which
leaves the field the function it was, and what the coarser lattice could not show is projected back to the finer one. Nothing is learned:
it is a fixed number of weighted means, from coarse to fine.
"""

from __future__ import annotations

import math

import numpy as np
import torch

from fieldfuse import memory
from fieldfuse.capture.types import Views
from fieldfuse.progress import SILENT, Progress
from fieldfuse.render.color_backprojection import recoloured
from fieldfuse.render.field import Field
from fieldfuse.training.levels import finer
from fieldfuse.training.silhouettes import inside_silhouettes
from fieldfuse.volume.edit import dilate
from fieldfuse.volume.host import TorchHost
from fieldfuse.volume.topology import BLOCK

Tensor = torch.Tensor
PIXELS = 1.5  # of the training views that a voxel at the median depth spans in the end …
PIXELS_WITHIN = 1.0  # … and where they have alpha, which shows edges of shape as finely
MOST_VOXELS = 3_000_000
MOST_RESOLUTION = 1024  # voxels along a side: what a ray needs to skip empty space is an array over all of the lattice
VOXEL_BYTES = 500  # at the worst: rows of half-empty blocks, those that replace them, sums over rays
SEEN = 0.02  # weight T·α below which no ray sees a voxel: it hides behind others, and is not divided
RELAXATION = 1.6  # of each back-projection: one is worth as much as two without
SILHOUETTE = 0.5  # voxels about a voxel's middle in which alpha must show nothing for it to go: what bulges over a silhouette costs most
STEP = 2.0  # most that a lattice is finer than the one before
LEAST_STEP = 1.2  # what is gained by less is not worth a lattice


@torch.no_grad()
def finer_colours(field: Field, views: Views, depth: float, progress: Progress = SILENT, engine: str = "auto") -> Field:
    """A field of about the same densities whose colours were looked up again on ever finer lattices, each at most twice as fine as the one
    before, until a voxel spans `PIXELS`, or with alpha `PIXELS_WITHIN`; on the last of them twice.

    Voxels that no ray of the images saw, nor lie beside one that a ray saw, are dropped on the way.

    Args:
        views: held-out ones are not looked at.
        depth: median depth, working units.
        engine: as for `recoloured`.

    Raises:
        Interrupted: the user asked to stop.
    """
    train = np.flatnonzero(~np.asarray(views.test))
    focal = float(np.median([views.intrinsics[index].fx for index in train]))
    host = TorchHost(field.device)
    most = memory.bounded(MOST_VOXELS * VOXEL_BYTES) // VOXEL_BYTES
    cut_out = any(alpha is not None for alpha in views.alpha)
    wanted = focal / depth / (PIXELS_WITHIN if cut_out else PIXELS)
    own = False  # whether the field's rows were made here
    while True:
        field, seen = recoloured(field, views, depth, progress, engine, RELAXATION, in_place=own)
        kept = dilate(field.topology, (seen > SEEN) & field.occupied, 1, grow=False)[1] & field.occupied
        resolution = _next(field, wanted, int(kept.sum()), most)
        if resolution is None:
            return recoloured(field, views, depth, progress, engine, RELAXATION, in_place=True).field
        field, own = finer(field, kept, resolution, host), True
        if cut_out:
            field = inside_silhouettes(field, views, SILHOUETTE)


def _next(field: Field, voxels: float, kept: int, most: int) -> int | None:
    """Resolution of the next lattice, None when this one is the last.

    Args:
        voxels: wanted to a working unit.
        kept: voxels that would be divided.
        most: voxels that there may be afterwards.
    """
    if kept == 0:
        return None
    whole, blocks = voxels * field.voxel_size, field.resolution / BLOCK
    if whole < LEAST_STEP:
        return None
    step = whole ** (1 / math.ceil(math.log(whole, STEP)))  # even ones
    wanted, allowed = round(step * blocks), math.floor((most / kept) ** (1 / 3) * blocks)
    resolution = min(BLOCK * min(wanted, allowed), MOST_RESOLUTION)
    return resolution if resolution >= LEAST_STEP * field.resolution else None
