"""Matching costs of a plane sweep (Collins 1996): neighbours seen through fronto-parallel planes, compared by normalised correlation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numba
import numpy as np

from fieldfuse.camera import Array, Intrinsics, invert
from fieldfuse.stereo.correlate import HALF, LANES, MIDDLE, NOISE, OPTIONS, WINDOW, F, correlate

UNKNOWN = 0.5  # cost where no neighbour shows anything, which is that of no correlation
GROUP = 16  # planes that are put into the volume at once: as many costs as a cache line holds


@dataclass(frozen=True)
class GreyView:
    """A picture for matching."""

    grey: Array  # (H, W) uint8
    camera: Intrinsics  # pinhole, of exactly this size
    world_from_camera: Array  # (4, 4) float64

    @cached_property
    def quads(self) -> Array:
        """(H, W) uint32: each pixel with its right, lower and lower right neighbours, from the lowest byte up, so that what lies between
        them is one look into memory. Of the last row and column nothing is asked."""
        wide = np.pad(self.grey, ((0, 1), (0, 1))).astype(np.uint32)
        return wide[:-1, :-1] | wide[:-1, 1:] << 8 | wide[1:, :-1] << 16 | wide[1:, 1:] << 24


def shrunk(picture: Array, camera: Intrinsics) -> Array:
    """(h, w, 3) uint8 at the size of the camera, each pixel the mean of what it covers."""
    if picture.shape[:2] != (camera.height, camera.width):
        picture = cv2.resize(picture, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(picture)


def grey_view(picture: Array, camera: Intrinsics, world_from_camera: Array) -> GreyView:
    """(h, w, 3) uint8 RGB, shrunk to the camera's size where it is larger."""
    grey = cv2.cvtColor(shrunk(picture, camera), cv2.COLOR_RGB2GRAY)
    return GreyView(np.asarray(grey), camera, np.asarray(world_from_camera, dtype=np.float64))


def plane_homography(view: GreyView, other: GreyView, inverse_depth: float) -> Array:
    """(3, 3) from pixels of `view` to pixels of `other` (whole numbers at centres) through the plane z = 1 / inverse_depth of `view`."""
    move = invert(other.world_from_camera) @ view.world_from_camera
    through = move[:3, :3].copy()
    through[:, 2] += move[:3, 3] * inverse_depth
    return np.asarray(other.camera.matrix_integer_centres() @ through @ np.linalg.inv(view.camera.matrix_integer_centres()))


def between(view: GreyView, other: GreyView) -> tuple[Array, Array]:
    """(3, 3) `plane_homography` to infinity, and (3,) what each unit of inverse depth adds to its last column; float32."""
    far = plane_homography(view, other, 0.0)
    return far.astype(np.float32), (plane_homography(view, other, 1.0) - far)[:, 2].astype(np.float32)


class Matcher:
    """Compares other pictures with one, window by window.

    The cost of one is (1 − zero-mean normalised cross-correlation) / 2: 0 alike, ½ unrelated, 1 inverted; brightness and contrast do not
    matter.

    Rows are kept `wide`: with `HALF` columns more before them and at least as many behind, where the ends are repeated, which makes them a
    multiple of `LANES` long.

    Args:
        others: K ≥ 0.
    """

    def __init__(self, view: GreyView, others: Sequence[GreyView]) -> None:
        self._others = [(other.quads, *between(view, other)) for other in others]
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
        out = self.room()
        self.costs(inverse_depth)
        best_half(self._each, out)
        return out[:, : self._width]

    def plane_cost(self, inverse_depth: float, out: Array) -> None:
        """`cost` of a plane, into the first columns of `out` (H, wide)."""
        best_half(self._compared(np.full(out.shape, inverse_depth, np.float32)), out)

    def room(self, *planes: int) -> Array:
        """(…, H, wide) float32."""
        return np.empty((*planes, *self._each.shape[1:]), np.float32)


@numba.njit(**OPTIONS)
def _best_of_four(costs: Array, out: Array) -> None:
    """`best_half` of four; comparisons without a branch become vectors."""
    zero, never, half = F(0), F(1e3), F(0.5)
    for y in range(costs.shape[1]):
        for x in range(costs.shape[2]):
            a, b, c, d = costs[0, y, x], costs[1, y, x], costs[2, y, x], costs[3, y, x]
            a, b = a if a >= zero else never, b if b >= zero else never
            c, d = c if c >= zero else never, d if d >= zero else never
            low, high, lower, higher = min(a, b), max(a, b), min(c, d), max(c, d)
            first, second = min(low, lower), min(max(low, lower), min(high, higher))
            third = max(max(low, lower), min(high, higher))
            value = first if third >= never else half * (first + second)
            out[y, x] = value if first < never else F(UNKNOWN)


@numba.njit(**OPTIONS)
def _into_order(low: Array, high: Array) -> None:
    """The smaller of each two values into `low`, the larger into `high`."""
    for x in range(len(low)):
        one, other = low[x], high[x]
        low[x], high[x] = min(one, other), max(one, other)


@numba.njit(**OPTIONS)
def best_half(costs: Array, out: Array) -> None:
    """(K, H, W) costs, −1 unknown → (H, W) the mean of the better half of the known ones: the worse half may be hidden behind something.

    Rows are sorted against each other, all their pixels at once: sorting pixel by pixel takes ten times as long.
    """
    count, height, width = costs.shape
    if count == 4:
        _best_of_four(costs, out)
        return
    zero, never = F(0), F(1e3)
    rows, known = np.empty((count, width), np.float32), np.empty(width, np.int32)
    for y in range(height):
        known[:] = 0
        for k in range(count):
            row, given = rows[k], costs[k, y]
            for x in range(width):
                row[x] = given[x] if given[x] >= zero else never
                known[x] += np.int32(given[x] >= zero)
        for turn in range(count):  # odd-even transposition sort
            for k in range(turn & 1, count - 1, 2):
                _into_order(rows[k], rows[k + 1])
        total = out[y]
        total[:] = zero
        for k in range((count + 1) // 2):
            row = rows[k]
            for x in range(width):
                total[x] += row[x] if k < (known[x] + 1) // 2 else zero
        for x in range(width):
            total[x] = total[x] / F((known[x] + 1) // 2) if known[x] > 0 else F(UNKNOWN)


@numba.njit(**OPTIONS)
def _put(costs: Array, first: int, volume: Array) -> None:
    """Costs of some planes (G, H, wide) into volume[:, :, first …], pixel by pixel: plane by plane each would go to a line of its own."""
    planes, height, width = costs.shape[0], volume.shape[0], volume.shape[1]
    for y in range(height):
        for start in range(0, width, LANES):
            count = min(LANES, width - start)
            if planes == GROUP and count == LANES:  # of known length, so it becomes loads and stores without loops
                for x in range(LANES):
                    for d in range(GROUP):
                        volume[y, start + x, first + d] = costs[d, y, start + x]
            else:
                for x in range(count):
                    for d in range(planes):
                        volume[y, start + x, first + d] = costs[d, y, start + x]


def sweep(view: GreyView, others: Sequence[GreyView], inverse_depths: Array) -> Array:
    """(H, W, D) float32 costs of the planes at `inverse_depths` (D,)."""
    matcher = Matcher(view, others)
    volume = np.empty((*view.grey.shape, len(inverse_depths)), np.float32)
    group = matcher.room(GROUP)
    for first in range(0, len(inverse_depths), GROUP):
        some = inverse_depths[first : first + GROUP]
        for inverse_depth, out in zip(some, group, strict=False):
            matcher.plane_cost(float(inverse_depth), out)
        _put(group[: len(some)], first, volume)
    return volume
