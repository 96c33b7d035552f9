"""The space of a training sample: a region of interest around part of what its pictures show, and how fine the lattice in it is.

Regions differ on purpose, from a small object in front of a far background (which then lies in the contracted shell) to a box around
everything, as captures differ.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from fieldfuse.camera import Array
from fieldfuse.nerfusion.training.samples import Pictures
from fieldfuse.volume.space import Space

Tensor = torch.Tensor
SHELL = 1.0  # width of the contracted shell, as fits use it
MARGIN = 1.05
POINTS = 4000
LEAST, STEP = 32, 8  # of the resolution


def surface_points(pictures: Pictures, indices: Tensor, most: int = POINTS) -> Tensor:
    """(N, 3) evenly chosen points of the surfaces that the pictures at `indices` show, from their depth."""
    pictures = Pictures(
        pictures.images[indices], pictures.intrinsics[indices], pictures.world_from_camera[indices], pictures.depths[indices]
    )
    view, row, column = (pictures.depths > 0).nonzero(as_tuple=True)
    keep = torch.arange(0, len(view), max(1, len(view) // most), device=view.device)
    view, row, column = view[keep], row[keep], column[keep]
    depth = pictures.depths[view, row, column]
    fx, fy, cx, cy = pictures.intrinsics[view].unbind(1)
    local = torch.stack([(column + 0.5 - cx) / fx * depth, (row + 0.5 - cy) / fy * depth, depth], 1)
    pose = pictures.world_from_camera[view]
    return (pose[:, :3, :3] @ local[:, :, None])[:, :, 0] + pose[:, :3, 3]


def region_around(points: Tensor, fallback: tuple[Array, float], part: float, closed: bool) -> Space:
    """A region of interest.

    Args:
        points: (N, 3) of surfaces, working frame.
        fallback: centre (3,) and half size where there are no points.
        part: share of the points that the region holds, around their middle; the rest lies in the shell.
        closed: a bare box around nearly all points instead, with nothing beyond it.
    """
    if len(points) < 16:
        centre, half = fallback
        return Space(_triple(centre), float(half), SHELL)
    if closed:
        low, high = torch.quantile(points, points.new_tensor([0.005, 0.995]), dim=0)
        size = ((high - low) / 2 * MARGIN).clamp_min(1e-6)
        half = float(size.max())
        box = _triple((size / half).clamp_min(0.05).double().cpu().numpy())
        return Space(_triple(((low + high) / 2).double().cpu().numpy()), half, 0.0, box)
    middle = points.median(0).values
    reach = (points - middle).abs().amax(1)
    half = float(torch.quantile(reach, part).clamp_min(1e-6)) * MARGIN
    return Space(_triple(middle.double().cpu().numpy()), half, SHELL)


def lattice_resolution(space: Space, voxel_size: float, most: int) -> int:
    """Voxels along the side of the space's cube so that one inside the region is about `voxel_size`, a multiple of 8 up to `most`."""
    wanted = 2 * space.extent * space.half / voxel_size
    return int(np.clip(STEP * round(wanted / STEP), LEAST, most))


def draw_voxel(rng: np.random.Generator, depth: float, voxels_to_depth: Sequence[float]) -> float:
    """A voxel size such that `depth` is between the two numbers of voxels, evenly on a logarithmic scale."""
    low, high = voxels_to_depth
    return depth / math.exp(rng.uniform(math.log(low), math.log(high)))


def _triple(values: Array) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in values)
    return x, y, z
