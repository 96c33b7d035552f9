"""Matching costs of a plane sweep (Collins 1996): neighbours seen through fronto-parallel planes, compared by normalised correlation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numba
import numpy as np

from toolkit.camera import Array, Intrinsics, invert

WINDOW = 7  # pixels a side that are compared
NOISE = 4.0  # variance (grey levels²) below which a window holds nothing to compare: correlation is drawn to 0 there
UNKNOWN = 0.5  # cost where no neighbour shows anything, which is that of no correlation
F = np.float32
OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy"}  # exact: the same whichever way a loop becomes vectors


@dataclass(frozen=True)
class GreyView:
    """A picture for matching."""

    grey: Array  # (H, W) float32, 0 to 255, less 128 so that squares keep their digits
    camera: Intrinsics  # pinhole, of exactly this size
    world_from_camera: Array  # (4, 4) float64


def shrunk(picture: Array, camera: Intrinsics) -> Array:
    """(h, w, 3) uint8 at the size of the camera, each pixel the mean of what it covers."""
    if picture.shape[:2] != (camera.height, camera.width):
        picture = cv2.resize(picture, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(picture)


def grey_view(picture: Array, camera: Intrinsics, world_from_camera: Array) -> GreyView:
    """(h, w, 3) uint8 RGB, shrunk to the camera's size where it is larger."""
    grey = cv2.cvtColor(shrunk(picture, camera), cv2.COLOR_RGB2GRAY).astype(np.float32) - 128
    return GreyView(grey, camera, np.asarray(world_from_camera, dtype=np.float64))


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


@numba.njit(**OPTIONS)
def _places(other: Array, far: Array, move: Array, inverse: Array, v: int, place: Array, share: Array, inside: Array) -> None:
    """Where `other` (h, w) shows the points of row `v` with the inverse depths inverse[v]: upper left pixel, shares of its right and lower
    neighbours, and 1 where it is in the picture, 0 elsewhere. A loop of its own, because it becomes vectors, and what is read by it not."""
    zero, one, least = F(0), F(1), F(1e-6)
    bottom, right = F(other.shape[0] - 1), F(other.shape[1] - 1)
    bx, by, bz = far[0, 1] * F(v) + far[0, 2], far[1, 1] * F(v) + far[1, 2], far[2, 1] * F(v) + far[2, 2]
    ax, ay, az, mx, my, mz = far[0, 0], far[1, 0], far[2, 0], move[0], move[1], move[2]
    height, width = np.int32(other.shape[0]), np.int32(other.shape[1])
    for u in range(len(place)):
        depth = inverse[v, u]
        z = az * F(u) + bz + depth * mz
        scale = one / max(z, least)
        x, y = (ax * F(u) + bx + depth * mx) * scale, (ay * F(u) + by + depth * my) * scale
        x_in, y_in = min(max(x, zero), right), min(max(y, zero), bottom)
        inside[u] = one if (z > least) & (x == x_in) & (y == y_in) else zero
        # Whole numbers are bounded once more: what is no number (a camera out of this world) must not be read at.
        column = min(max(np.int32(min(x_in, right - one)), np.int32(0)), width - np.int32(2))
        row = min(max(np.int32(min(y_in, bottom - one)), np.int32(0)), height - np.int32(2))
        share[0, u], share[1, u] = x_in - F(column), y_in - F(row)
        place[u] = row * width + column


@numba.njit(**OPTIONS)
def _take(pixels: Array, width: int, place: Array, share: Array, inside: Array, out: Array) -> None:
    """Bilinear values of `pixels` (h · w,) at `_places`, 0 outside."""
    one, below = np.uintp(1), np.uintp(width)
    for u in range(len(place)):
        at = np.uintp(place[u])
        left, right, lower_left, lower_right = pixels[at], pixels[at + one], pixels[at + below], pixels[at + below + one]
        upper = left + share[0, u] * (right - left)
        lower = lower_left + share[0, u] * (lower_right - lower_left)
        out[u] = upper + share[1, u] * (lower - upper) if inside[u] > F(0) else F(0)


@numba.njit(**OPTIONS)
def _sum_across(values: Array, out: Array) -> None:
    """Sums of values[x …] over as many neighbours as `values` is longer than `out`, and one."""
    for x in range(len(out)):
        out[x] = values[x]
    for shift in range(1, len(values) - len(out) + 1):
        for x in range(len(out)):
            out[x] += values[x + shift]


@numba.njit(**OPTIONS)
def _compare(
    grey: Array, mean: Array, variance: Array, half: int, other: Array, far: Array, move: Array, inverse: Array, out: Array
) -> None:
    """`Matcher.cost`, a row at a time: what was warped stays in the cache until all windows that hold it are done."""
    height, width = grey.shape
    window = 2 * half + 1
    pixels = other.reshape(-1)
    place, share, warped = np.empty(width, np.int32), np.empty((2, width), np.float32), np.empty(width, np.float32)
    wide = np.empty((3, width + 2 * half), np.float32)
    inside, sums = np.empty((window, width), np.float32), np.empty((window, 3, width), np.float32)
    total = np.empty((3, width), np.float32)
    zero, part_of = F(0), F(1 / (window * window))
    for ahead in range(height + half):
        if ahead < height:
            newest = sums[ahead % window]
            _places(other, far, move, inverse, ahead, place, share, inside[ahead % window])
            _take(pixels, other.shape[1], place, share, inside[ahead % window], warped)
            own, first, second, third = grey[ahead], wide[0, half:], wide[1, half:], wide[2, half:]
            for x in range(width):
                first[x] = warped[x]
                second[x] = warped[x] * warped[x]
                third[x] = warped[x] * own[x]
            for part in range(3):
                for x in range(half):  # the ends are repeated
                    wide[part, x], wide[part, half + width + x] = wide[part, half], wide[part, half + width - 1]
                _sum_across(wide[part], newest[part])
        y = ahead - half
        if y < 0:
            continue
        total[:] = zero
        for near in range(y - half, y + half + 1):
            row = sums[min(max(near, 0), height - 1) % window]
            for part in range(3):
                for x in range(width):
                    total[part, x] += row[part, x]
        seen, result = inside[y % window], out[y]
        for x in range(width):
            their = total[0, x] * part_of
            spread = max(total[1, x] * part_of - their * their, zero) + F(NOISE)
            product = total[2, x] * part_of - mean[y, x] * their
            value = F(0.5) - F(0.5) * product / np.sqrt(variance[y, x] * spread)
            result[x] = value if seen[x] > zero else F(-1)


class Matcher:
    """Compares other pictures with one, window by window.

    The cost is (1 − zero-mean normalised cross-correlation) / 2: 0 alike, ½ unrelated, 1 inverted; brightness and contrast do not matter.
    """

    def __init__(self, view: GreyView, window: int = WINDOW) -> None:
        self.view, self.half = view, window // 2
        self.mean = self._mean(view.grey)
        self.variance = np.maximum(self._mean(view.grey * view.grey) - self.mean**2, 0) + np.float32(NOISE)

    def _mean(self, values: Array) -> Array:
        window = 2 * self.half + 1
        return np.asarray(cv2.boxFilter(values, cv2.CV_32F, (window, window), borderType=cv2.BORDER_REPLICATE))

    def cost(self, other: Array, way: tuple[Array, Array], inverse_depth: Array, out: Array | None = None) -> Array:
        """(H, W) float32 costs of the picture `other` where it shows the points at `inverse_depth` (H, W); −1 where it does not.

        Args:
            other: (h, w) float32 grey levels as in `GreyView`.
            way: `between` the matcher's view and the other's.
            out: (H, W) float32 to be filled.
        """
        out = np.empty(self.view.grey.shape, np.float32) if out is None else out
        if min(other.shape) < 2:  # nothing lies between its pixels
            out[:] = -1
            return out
        _compare(self.view.grey, self.mean, self.variance, self.half, other, *way, inverse_depth, out)
        return out


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


@numba.njit(cache=True, nogil=True)
def best_half(costs: Array, out: Array) -> None:
    """(K, H, W) costs, −1 unknown → the mean of the better half of the known ones: the worse half may be hidden behind something."""
    count, height, width = costs.shape
    if count == 4:
        _best_of_four(costs, out)
        return
    values = np.empty(count, np.float32)
    for y in range(height):
        for x in range(width):
            known = 0
            for k in range(count):
                value = costs[k, y, x]
                if value >= 0:
                    place = known
                    while place > 0 and values[place - 1] > value:
                        values[place] = values[place - 1]
                        place -= 1
                    values[place] = value
                    known += 1
            if known == 0:
                out[y, x] = UNKNOWN
                continue
            half = (known + 1) // 2
            total = np.float32(0)
            for k in range(half):
                total += values[k]
            out[y, x] = total / half


def sweep(view: GreyView, others: Sequence[GreyView], inverse_depths: Array, window: int = WINDOW) -> Array:
    """(H, W, D) float32 costs of the planes at `inverse_depths` (D,)."""
    height, width = view.grey.shape
    matcher = Matcher(view, window)
    ways = [between(view, other) for other in others]
    volume = np.empty((height, width, len(inverse_depths)), np.float32)
    costs = np.empty((len(others), height, width), np.float32)
    for d, inverse_depth in enumerate(inverse_depths):
        plane = np.full((height, width), inverse_depth, np.float32)
        for k, other in enumerate(others):
            matcher.cost(other.grey, ways[k], plane, costs[k])
        best_half(costs, volume[:, :, d])
    return volume
