"""Depth that is nearly right, such as a field's, moved to where pictures agree best: the last step of matching without its search."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.capture.types import Views
from fieldfuse.stereo.cost import GreyView, grey_view
from fieldfuse.stereo.match import inverse_depths, usable_neighbours
from fieldfuse.stereo.refine import refined
from fieldfuse.stereo.settle import same_place

NEIGHBOURS = 6  # pictures that a view is compared with
RECOGNISED = 0.3  # matching cost up to which a pixel was recognised in its neighbours; others keep the depth they had


class Polisher:
    """Polishes depth maps of some views by the pictures of all of them.

    Args:
        views: pictures that may be looked at; leave held-out ones out before.
        cameras: pinhole of each view, of the size that its depth maps have.
        near, far: nearest and farthest depth, working units; they tell how far a step of depth moves a pixel.
        median_depth: what parallax and overlap of pictures are judged at.
    """

    def __init__(self, views: Views, cameras: Sequence[Intrinsics], near: float, far: float, median_depth: float) -> None:
        self._views, self._cameras, self._range = views, [camera.pinhole() for camera in cameras], (near, far)
        self._grey: dict[int, GreyView] = {}
        self._neighbours = usable_neighbours(views.world_from_camera, self._cameras, median_depth, NEIGHBOURS) if len(views) > 1 else [[]]

    def polished(self, index: int, depth: Array, measured: Array | None = None) -> tuple[Array, Array]:
        """(H, W) float32 depth of the view `index` along z, 0 = missing; moved by at most about a pixel of parallax, or as it was.

        And (H, W) bool, where it was recognised in other pictures: elsewhere, on bare walls, these tell nothing of the depth.

        Args:
            measured: (H, W), in whatever size, a sensor's depth that `depth` knew, 0 = missing. Where it measured the same place nothing is
                moved: what errors poses and lenses have draw pictures away from it, and the surface is to lie on the sensor's.
        """
        near, far = self._range
        known = np.isfinite(depth) & (depth > 0)
        others = [self._picture(other) for other in self._neighbours[index]]
        if not others or not known.any() or not 0 < near < far:
            return np.asarray(depth, dtype=np.float32), np.zeros(depth.shape, bool)
        view = self._picture(index)
        planes = inverse_depths(view, others, near, far)
        start = 1 / np.where(known, depth, np.median(depth[known]))
        inverse, cost = refined(view, others, start, float(planes[1] - planes[0]))
        moved = known & (cost <= RECOGNISED) & (inverse > 0) & ~same_place(depth, measured)
        return np.where(moved, 1 / np.maximum(inverse, 1e-12), np.where(known, depth, 0)).astype(np.float32), moved

    def _picture(self, index: int) -> GreyView:
        if index not in self._grey:
            self._grey[index] = grey_view(self._views.images[index], self._cameras[index], self._views.world_from_camera[index])
        return self._grey[index]
