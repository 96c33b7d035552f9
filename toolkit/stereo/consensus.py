"""What several pictures agree on: depth maps carried into another camera, and the nearest surface that enough of them tell of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np

from fieldfuse.camera import Array, Intrinsics, invert
from fieldfuse.stereo.check import numbers

AGREED = 3  # pictures that must tell the same
SAME = 0.04  # share of depth within which points are of one surface


@dataclass(frozen=True)
class Consensus:
    """What other pictures say stands in each pixel of one."""

    count: Array  # (H, W) int32 pictures that agree, 0 below `AGREED`
    depth: Array  # (H, W) float32 mean of theirs, 0 = unknown
    colour: Array  # (H, W, 3) float32 mean of theirs, levels
    scatter: Array  # (H, W) float32 standard deviation of theirs, levels


def consensus(
    camera: Intrinsics, pose: Array, depths: Sequence[Array], pictures: Sequence[Array], lenses: Sequence[Intrinsics], poses: Array
) -> Consensus:
    """What the pictures with these depths, carried into the camera at `pose` (4, 4), agree on.

    Args:
        depths: (h, w) float32 along z, 0 = missing.
        pictures: (h, w, 3) uint8 of the depth maps' sizes, `lenses` their cameras.
        poses: (N, 4, 4) world from camera of these.
    """
    height, width = camera.height, camera.width
    carried = np.zeros((len(depths), height, width), np.float32)
    colours = np.zeros((len(depths), height, width, 3), np.uint8)
    for number, (depth, picture, lens) in enumerate(zip(depths, pictures, lenses, strict=True)):
        there = invert(pose) @ poses[number]
        source = np.ascontiguousarray(depth, dtype=np.float32)
        _carry(source, picture, numbers(lens), numbers(camera), there, carried[number], colours[number])
    out = Consensus(
        np.zeros((height, width), np.int32),
        np.zeros((height, width), np.float32),
        np.zeros((height, width, 3), np.float32),
        np.zeros((height, width), np.float32),
    )
    _agree(carried, colours, AGREED, SAME, out.count, out.depth, out.colour, out.scatter)
    return out


def warm_up() -> None:
    """Have the kernels compiled, or loaded."""
    camera = Intrinsics(8, 6, 8.0, 8.0, 4.0, 3.0)
    depth, picture = np.ones((6, 8), np.float32), np.zeros((6, 8, 3), np.uint8)
    consensus(camera, np.eye(4), [depth], [picture], [camera], np.eye(4)[None])


@numba.njit(cache=True, nogil=True)
def _carry(depth: Array, picture: Array, camera: Array, target: Array, there: Array, out: Array, colours: Array) -> None:
    """Put each point of a depth map on the four pixels around it in another camera; the nearest one stays."""
    fx, fy, cx, cy = camera
    gx, gy, ox, oy = target
    height, width = out.shape
    for y in range(depth.shape[0]):
        for x in range(depth.shape[1]):
            z = depth[y, x]
            if z <= 0:
                continue
            px, py = (x + 0.5 - cx) / fx * z, (y + 0.5 - cy) / fy * z
            qz = there[2, 0] * px + there[2, 1] * py + there[2, 2] * z + there[2, 3]
            if qz <= 0:
                continue
            qx = there[0, 0] * px + there[0, 1] * py + there[0, 2] * z + there[0, 3]
            qy = there[1, 0] * px + there[1, 1] * py + there[1, 2] * z + there[1, 3]
            u, v = qx / qz * gx + ox - 0.5, qy / qz * gy + oy - 0.5
            if not (-1 < u < width and -1 < v < height):
                continue
            left, top = int(np.floor(u)), int(np.floor(v))
            for row in range(max(top, 0), min(top + 2, height)):
                for column in range(max(left, 0), min(left + 2, width)):
                    if out[row, column] == 0 or qz < out[row, column]:
                        out[row, column] = qz
                        for channel in range(3):
                            colours[row, column, channel] = picture[y, x, channel]


@numba.njit(cache=True, nogil=True)
def _agree(depths: Array, colours: Array, least: int, same: float, count: Array, depth: Array, colour: Array, scatter: Array) -> None:
    """The nearest surface that at least `least` of the maps agree on, pixel by pixel."""
    number, height, width = depths.shape
    order = np.empty(max(number, 1), np.int64)
    for y in range(height):
        for x in range(width):
            known = 0
            for k in range(number):
                z = depths[k, y, x]
                if z > 0:  # sorted in, nearest first
                    at = known
                    while at > 0 and depths[order[at - 1], y, x] > z:
                        order[at] = order[at - 1]
                        at -= 1
                    order[at] = k
                    known += 1
            for first in range(known - least + 1):
                farthest = depths[order[first], y, x] * (1 + same)
                last = first
                while last < known and depths[order[last], y, x] <= farthest:
                    last += 1
                if last - first < least:
                    continue
                agree = last - first
                spread = 0.0
                for channel in range(3):
                    total, squares = 0.0, 0.0
                    for k in range(first, last):
                        value = float(colours[order[k], y, x, channel])
                        total += value
                        squares += value * value
                    mean = total / agree
                    colour[y, x, channel] = mean
                    spread += max(squares / agree - mean * mean, 0.0)
                total = 0.0
                for k in range(first, last):
                    total += depths[order[k], y, x]
                count[y, x] = agree
                depth[y, x] = total / agree
                scatter[y, x] = np.sqrt(spread / 3)
                break
