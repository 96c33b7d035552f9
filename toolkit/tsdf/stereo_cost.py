"""Matching costs of a plane sweep (Collins 1996): neighbours seen through fronto-parallel planes, compared by normalised correlation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numba
import numpy as np

from toolkit.camera import Array, Intrinsics, invert

WINDOW = 7  # pixels a side that are compared
NOISE = 4.0  # variance (grey levels²) below which a window holds nothing to compare: correlation is drawn to 0 there
OUTSIDE = 1e4  # what a warped picture holds where the neighbour shows nothing; far above any grey level
UNKNOWN = 0.5  # cost where no neighbour shows anything, which is that of no correlation


@dataclass(frozen=True)
class GreyView:
    """A picture for matching."""

    grey: Array  # (H, W) float32, 0 to 255, less 128 so that squares keep their digits
    camera: Intrinsics  # pinhole, of exactly this size
    world_from_camera: Array  # (4, 4) float64


def grey_view(picture: Array, camera: Intrinsics, world_from_camera: Array) -> GreyView:
    """(h, w, 3) uint8 RGB, shrunk to the camera's size where it is larger."""
    if picture.shape[:2] != (camera.height, camera.width):
        picture = cv2.resize(picture, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    grey = cv2.cvtColor(np.ascontiguousarray(picture), cv2.COLOR_RGB2GRAY).astype(np.float32) - 128
    return GreyView(grey, camera, np.asarray(world_from_camera, dtype=np.float64))


def plane_homography(view: GreyView, other: GreyView, inverse_depth: float) -> Array:
    """(3, 3) from pixels of `view` to pixels of `other` (whole numbers at centres) through the plane z = 1 / inverse_depth of `view`."""
    move = invert(other.world_from_camera) @ view.world_from_camera
    through = move[:3, :3].copy()
    through[:, 2] += move[:3, 3] * inverse_depth
    return np.asarray(other.camera.matrix_integer_centres() @ through @ np.linalg.inv(view.camera.matrix_integer_centres()))


def _mean(values: Array, window: int) -> Array:
    return np.asarray(cv2.boxFilter(values, cv2.CV_32F, (window, window), borderType=cv2.BORDER_REPLICATE))


class Matcher:
    """Compares warped pictures with one picture, window by window.

    The cost is (1 − zero-mean normalised cross-correlation) / 2: 0 alike, ½ unrelated, 1 inverted; brightness and contrast do not matter.
    """

    def __init__(self, grey: Array, window: int = WINDOW) -> None:
        self.grey, self.window = grey, window
        self.mean = _mean(grey, window)
        self.variance = np.maximum(_mean(grey * grey, window) - self.mean**2, 0) + NOISE

    def cost(self, warped: Array) -> Array:
        """(H, W) float32; −1 where `warped` holds nothing (`OUTSIDE`)."""
        outside = warped > 0.1 * OUTSIDE
        warped[outside] = 0
        mean = _mean(warped, self.window)
        variance = np.maximum(_mean(warped * warped, self.window) - mean * mean, 0) + NOISE
        product = _mean(self.grey * warped, self.window) - self.mean * mean
        cost = 0.5 - 0.5 * product / np.sqrt(self.variance * variance)
        cost[outside] = -1
        return np.asarray(cost)


@numba.njit(cache=True, nogil=True)
def best_half(costs: Array, out: Array) -> None:
    """(K, H, W) costs, −1 unknown → the mean of the better half of the known ones: the worse half may be hidden behind something."""
    count, height, width = costs.shape
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
    matcher = Matcher(view.grey, window)
    volume = np.empty((height, width, len(inverse_depths)), np.float32)
    costs = np.empty((len(others), height, width), np.float32)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    for d, inverse_depth in enumerate(inverse_depths):
        for k, other in enumerate(others):
            through = plane_homography(view, other, float(inverse_depth))
            warped = cv2.warpPerspective(
                other.grey, through, (width, height), flags=flags, borderMode=cv2.BORDER_CONSTANT, borderValue=OUTSIDE
            )
            costs[k] = matcher.cost(warped)
        best_half(costs, volume[:, :, d])
    return volume
