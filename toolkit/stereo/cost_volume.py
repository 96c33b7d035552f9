"""The cost volume of a plane sweep (Collins 1996), the smoothest way through it (Hirschmüller 2008), and depth between its planes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from fieldfuse.backends.numba.semi_global import add_paths, lowest_plane
from fieldfuse.backends.numba.stereo_cost import GROUP, HALF, LANES, MIDDLE, NOISE, WINDOW, best_half, correlate
from fieldfuse.camera import Array, Intrinsics, invert

SMALL_STEP = 0.03  # penalty of a change by one plane between neighbouring pixels, in units of the cost (0 to 1)
LARGE_STEP = 1.0  # penalty of any larger change on even ground
SOFT_EDGE = 8.0  # grey levels between two pixels that halve the large penalty: depth steps where colour does
# Directions that a path moves on by are taken together in two passes over the image, downwards and to the right, and back: along the row,
# and from the row before straight on and askew.
DOWN, UP = 1, -1
STRAIGHT = (0,)  # columns that a path moves by from row to row
ALL = (0, 1, -1)
EVEN = 5  # pixels a side of the median that a depth map is evened out with before images are warped by it
LEAST_BEND = 1e-4  # of the costs' parabola; flatter ones have no lowest point worth moving to


@dataclass(frozen=True)
class GreyView:
    """An image for matching."""

    grey: Array  # (H, W) uint8
    camera: Intrinsics  # pinhole, of exactly this size
    world_from_camera: Array  # (4, 4) float64

    @cached_property
    def quads(self) -> Array:
        """(H, W) uint32: each pixel with its right, lower and lower right neighbours, from the lowest byte up, so that what lies between
        them is one look into memory. The last row and column are not read."""
        wide = np.pad(self.grey, ((0, 1), (0, 1))).astype(np.uint32)
        return wide[:-1, :-1] | wide[:-1, 1:] << 8 | wide[1:, :-1] << 16 | wide[1:, 1:] << 24


def shrunk(image: Array, camera: Intrinsics) -> Array:
    """(h, w, 3) uint8 at the size of the camera, each pixel the mean of what it covers."""
    if image.shape[:2] != (camera.height, camera.width):
        image = cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(image)


def grey_view(image: Array, camera: Intrinsics, world_from_camera: Array) -> GreyView:
    """(h, w, 3) uint8 RGB, shrunk to the camera's size where it is larger."""
    grey = cv2.cvtColor(shrunk(image, camera), cv2.COLOR_RGB2GRAY)
    return GreyView(np.asarray(grey), camera, np.asarray(world_from_camera, dtype=np.float64))


def plane_homography(view: GreyView, other: GreyView, inverse_depth: float) -> Array:
    """(3, 3) from pixels of `view` to pixels of `other` (whole numbers at centres) through the plane z = 1 / inverse_depth of `view`."""
    move = invert(other.world_from_camera) @ view.world_from_camera
    through = move[:3, :3].copy()
    through[:, 2] += move[:3, 3] * inverse_depth
    return np.asarray(other.camera.matrix_integer_centres() @ through @ np.linalg.inv(view.camera.matrix_integer_centres()))


class Matcher:
    """Compares other images with one, window by window.

    The cost of one is (1 − zero-mean normalised cross-correlation) / 2: 0 alike, ½ unrelated, 1 inverted; brightness and contrast do not
    matter. Rows are padded at both ends, which repeat the border, to a multiple of `LANES`.

    Args:
        others: K ≥ 0.
    """

    def __init__(self, view: GreyView, others: Sequence[GreyView]) -> None:
        self._others = []
        for other in others:
            far = plane_homography(view, other, 0.0)
            move = (plane_homography(view, other, 1.0) - far)[:, 2]  # of a point, for each unit of inverse depth
            self._others.append((other.quads, far.astype(np.float32), move.astype(np.float32)))
        height, self._width = view.grey.shape
        wide = -(-(self._width + 2 * HALF) // LANES) * LANES
        own = view.grey.astype(np.float32) - MIDDLE
        mean = self._mean(own)
        steep = 1 / np.sqrt(np.maximum(self._mean(own * own) - mean**2, 0) + np.float32(NOISE))
        self._columns = np.clip(np.arange(-HALF, wide - HALF), 0, self._width - 1)
        windows = (np.pad(of, ((0, 0), (0, wide - self._width))) for of in (mean, steep))
        self._own = (np.take(own, self._columns, axis=1), *windows, self._columns.astype(np.float32))
        self._each = np.empty((len(others), height, wide), np.float32)

    @staticmethod
    def _mean(values: Array) -> Array:
        return np.asarray(cv2.boxFilter(values, cv2.CV_32F, (WINDOW, WINDOW), borderType=cv2.BORDER_REPLICATE))

    def _compared(self, inverse_depth: Array) -> Array:
        """(K, H, wide) costs at inverse depths (H, wide)."""
        for (quads, far, move), out in zip(self._others, self._each, strict=True):
            if min(quads.shape) < 2:  # nothing lies between its pixels
                out[:] = -1
            else:
                correlate(*self._own, quads, far, move, inverse_depth, out)
        return self._each

    def costs(self, inverse_depth: Array) -> Array:
        """(K, H, W) float32 costs of the others where they show the points at `inverse_depth` (H, W); −1 where they do not. Valid until the
        next call."""
        return self._compared(np.take(np.asarray(inverse_depth, np.float32), self._columns, axis=1))[:, :, : self._width]

    def cost(self, inverse_depth: Array) -> Array:
        """(H, W) float32 `best_half` of `costs`."""
        self.costs(inverse_depth)
        out = np.empty(self._each.shape[1:], np.float32)
        best_half(self._each, out)
        return out[:, : self._width]

    def volume(self, inverse_depths: Array) -> Array:
        """(H, W, D) float32 `cost` of the planes at `inverse_depths` (D,)."""
        height, wide = self._each.shape[1:]
        out = np.empty((height, self._width, len(inverse_depths)), np.float32)
        group = np.empty((GROUP, height, wide), np.float32)
        for first in range(0, len(inverse_depths), GROUP):
            some = inverse_depths[first : first + GROUP]
            for inverse_depth, costs in zip(some, group, strict=False):
                best_half(self._compared(np.full((height, wide), inverse_depth, np.float32)), costs)
            out[:, :, first : first + len(some)] = group[: len(some), :, : self._width].transpose(1, 2, 0)
        return out


def summed_paths(cost: Array, grey: Array, small: float, large: float, slants: tuple[int, ...], ways: Sequence[int] = (DOWN, UP)) -> Array:
    """(H, W, D) float32: costs aggregated along the rows and, from row to row, along each of `slants` (`STRAIGHT` or `ALL`), there and
    back, summed; `ways` may name one of both. Other arguments as in `smoothed_planes`."""
    total = np.zeros(cost.size, np.float32)
    for way in ways:
        add_paths(cost.reshape(-1), grey, way, slants, small, large, SOFT_EDGE, total)
    return total.reshape(cost.shape)


def smoothed_planes(cost: Array, grey: Array, small: float = SMALL_STEP, large: float = LARGE_STEP) -> Array:
    """(H, W) float32 number, with its fraction, of the plane of each pixel that fits best together with its neighbours.

    Args:
        cost: (H, W, D) float32 matching costs, 0 to 1, at least three planes.
        grey: (H, W) image, 0 to 255.
    """
    grey = np.ascontiguousarray(grey, dtype=np.float32)
    plane = np.empty(grey.shape, np.float32)
    lowest_plane(summed_paths(np.ascontiguousarray(cost, dtype=np.float32), grey, small, large, ALL), plane)
    return plane


def refined(view: GreyView, others: Sequence[GreyView], inverse_depth: Array, step: float, rounds: int = 2) -> tuple[Array, Array]:
    """Each pixel moved to the lowest point of a parabola through three costs; the first round reaches half a `step` (the planes' distance)
    to either side, each next one half as far. Images are warped by the depth map itself, so that windows follow the slope of the surface.

    Returns:
        (H, W) float32 inverse depth, and (H, W) float32 the lowest of the last round's costs.
    """
    matcher = Matcher(view, others)
    now = inverse_depth.astype(np.float32)
    three = np.empty((3, *now.shape), np.float32)
    for number in range(rounds):
        reach = np.float32(0.5 * step / 2**number)
        even = cv2.medianBlur(now, EVEN)
        for place, side in enumerate((-1, 0, 1)):
            three[place] = matcher.cost(even + side * reach)
        low, mid, high = three
        bend = low - 2 * mid + high
        shift = np.clip(0.5 * (low - high) / np.maximum(bend, LEAST_BEND), -1, 1)
        now = even + np.where(bend > LEAST_BEND, shift, 0).astype(np.float32) * reach
    return np.asarray(cv2.medianBlur(now, 3)), three.min(axis=0)
