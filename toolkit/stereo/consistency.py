"""Which depths of several views agree: what other views do not confirm is dropped, what they do is averaged with theirs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from fieldfuse.backends.numba.depth_maps import compare, compare_colours
from fieldfuse.camera import Array, Intrinsics, invert

TOLERANCE = 0.02  # share of depth by which two views may differ
SPECKLE = 1 / 2000  # share of the image: smaller patches of kept depth are dropped
NO_SUMS = np.empty((0, 0))


@dataclass(frozen=True)
class DepthMaps:
    """Depth of several views."""

    depths: Sequence[Array]  # (H, W) along z, 0 = missing
    cameras: Sequence[Intrinsics]  # pinhole, of the depth maps' sizes
    world_from_camera: Array  # (N, 4, 4)


@dataclass(frozen=True)
class Agreement:
    """How other views compare with each pixel of a depth map."""

    agree: Array  # (H, W) int32 how many have the same point …
    through: Array  # … and how many see through it
    total: Array  # (H, W) float64 sum of the inverse depths of the pixel itself and of those that agree; or of height 0
    colours: Array  # (others or 0, H, W) float32 how much the colours there differ, in levels; NaN: hidden, or out of sight


def confirmed(index: int, others: Sequence[int], maps: DepthMaps, needed: int = 2, noise: float = 0.0) -> tuple[Array, Array]:
    """The depth map `index` checked against the maps `others`.

    A depth is kept when at least `needed` others have the same point, and more of them than see through it; it becomes the mean, over
    inverse depths, of its own value and theirs. Small patches are dropped.

    Args:
        noise: inverse depth by which two views may differ where that is more than `TOLERANCE`: what is far moves by fewer pixels, so it
            cannot be measured as well (`StereoDepth.noise`).

    Returns:
        (H, W) float32 depth, 0 where it is not kept, and (H, W) float32 confidence in [0, 1): a / (a + t + 1) for a others that agree and t
        that see through the point.
    """
    found = agreement(index, others, maps, noise, sums=True)
    kept = (maps.depths[index] > 0) & (found.agree >= needed) & (found.agree > found.through)
    mean = np.where(kept, (found.agree + 1) / np.maximum(found.total, 1e-12), 0)
    kept &= ~_speckles(mean)
    confidence = np.where(kept, found.agree / (found.agree + found.through + 1), 0)
    return np.where(kept, mean, 0).astype(np.float32), confidence.astype(np.float32)


def agreement(
    index: int, others: Sequence[int], maps: DepthMaps, noise: float = 0.0, images: Sequence[Array] | None = None, sums: bool = False
) -> Agreement:
    """How the views `others` compare with each pixel of the depth map `index`.

    Args:
        noise: as in `confirmed`.
        images: (H, W, 3) uint8 of all views, of the size of their depth maps; None: colours are not compared.
        sums: `Agreement.total` is wanted.
    """
    depth = np.ascontiguousarray(maps.depths[index], np.float32)
    agree, through = np.zeros(depth.shape, np.int32), np.zeros(depth.shape, np.int32)
    total = np.where(depth > 0, 1 / np.maximum(depth, 1e-12, dtype=np.float64), 0) if sums else NO_SUMS
    colours = np.full((len(others) if images else 0, *depth.shape), np.nan, np.float32)
    here = _ray_matrix(maps.cameras[index])
    for number, other in enumerate(others):
        theirs = np.ascontiguousarray(maps.depths[other], np.float32)
        there, away = invert(maps.world_from_camera[other]) @ maps.world_from_camera[index], _ray_matrix(maps.cameras[other])
        onto = np.column_stack([maps.cameras[other].matrix() @ there[:3, :3] @ here, maps.cameras[other].matrix() @ there[:3, 3]])
        home = invert(there)
        back = np.append(home[2, :3] @ away, home[2, 3]).astype(np.float32)
        onto = np.ascontiguousarray(onto, np.float32)
        compare(depth, theirs, onto, back, TOLERANCE, noise, agree, through, total)
        if images:
            compare_colours(depth, theirs, onto, images[index], images[other], colours[number])
    return Agreement(agree, through, total, colours)


def _ray_matrix(camera: Intrinsics) -> Array:
    """(3, 3) from u, v, 1 to the ray of depth 1 through that place of the image."""
    return np.asarray(np.linalg.inv(camera.matrix()))


def numbers(camera: Intrinsics) -> Array:
    """(4,) fx, fy, cx, cy for kernels."""
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy])


def _speckles(depth: Array) -> Array:
    """(H, W) bool: pixels of patches (pixels that differ by little from a neighbour) smaller than `SPECKLE` of the image."""
    known = depth > 0
    if not known.any():
        return known
    # The filter takes 16-bit whole numbers; steps of the logarithm make its one threshold a share of depth everywhere.
    steps = np.log(np.where(known, depth, 1.0))
    low = float(steps[known].min())
    unit = max(TOLERANCE / 4, (float(steps[known].max()) - low) / 30000)
    out = np.where(known, np.round((steps - low) / unit) + 1, 0).astype(np.int16)
    cv2.filterSpeckles(out, 0, int(np.ceil(SPECKLE * depth.size)), round(3 * TOLERANCE / unit))
    return np.asarray((out == 0) & known)
