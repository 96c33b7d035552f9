"""Depth maps of several views compared, warped into each other, and held against planes; values spread along an image."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

HIDDEN = 0.03  # share of a point's depth by which another view's surface before it hides its colour
OPTIONS: dict[str, Any] = {"cache": True, "nogil": True}
FAST: dict[str, Any] = {**OPTIONS, "error_model": "numpy"}  # a division that may be by zero does not become vectors otherwise
F = np.float32


@njit(**OPTIONS)
def _moved(move: Any, x: float, y: float, z: float) -> Any:
    """A point in the frame that `move` (4, 4) leads to."""
    return (
        move[0, 0] * x + move[0, 1] * y + move[0, 2] * z + move[0, 3],
        move[1, 0] * x + move[1, 1] * y + move[1, 2] * z + move[1, 3],
        move[2, 0] * x + move[2, 1] * y + move[2, 2] * z + move[2, 3],
    )


@njit(**FAST)
def _seen_at(depth: Any, y: int, onto: Any, columns: int, rows: int, place: Any, away: Any) -> None:
    """Where another view of this size sees the points of the row `y`: its pixel `place`, row by row, and the depth `away` there, 0: not
    at all. A loop of its own, because it becomes vectors, and what is read at these places not."""
    zero, one, half = F(0), F(1), F(0.5)
    ax, ay, az, mx, my, mz = onto[0, 0], onto[1, 0], onto[2, 0], onto[0, 3], onto[1, 3], onto[2, 3]
    v = F(y) + half
    bx, by, bz = onto[0, 1] * v + onto[0, 2], onto[1, 1] * v + onto[1, 2], onto[2, 1] * v + onto[2, 2]
    across, right, bottom = np.int32(columns), F(columns), F(rows)
    for x in range(len(depth)):
        z, u = depth[x], F(np.int32(x)) + half
        qz = (az * u + bz) * z + mz
        scale = one / max(qz, F(1e-12))
        column, row = ((ax * u + bx) * z + mx) * scale, ((ay * u + by) * z + my) * scale
        inside = (z > zero) & (qz > zero) & (column >= zero) & (column < right) & (row >= zero) & (row < bottom)
        away[x] = qz if inside else zero
        place[x] = np.int32(row) * across + np.int32(column) if inside else np.int32(0)


@njit(**FAST)
def compare(depth: Any, other: Any, onto: Any, back: Any, tolerance: float, noise: float, agree: Any, through: Any, total: Any) -> None:
    """Count for each pixel whether one other view confirms its depth or sees through it, and sum up the inverse depths that confirm it.

    Args:
        depth, other: (H, W) and (h, w) float32 depth of the view and of the other.
        onto: (3, 4) float32 from u, v, 1 (both from the corner of the image) times depth, and 1, to the other's pixel times its depth.
        back: (4,) float32 the depth in the view of what the other sees: from u, v, 1 times depth there, and 1.
        total: (H, W) float64; or of height 0, if sums are not wanted.
    """
    height, width = depth.shape
    rows, columns = other.shape
    one, half, same, rough = F(1), F(0.5), F(tolerance), F(noise)
    place, away = np.empty(width, np.int32), np.empty(width, np.float32)
    maps = other.reshape(-1)
    for y in range(height):
        _seen_at(depth[y], y, onto, columns, rows, place, away)
        for x in range(width):
            qz = away[x]
            if qz <= F(0):
                continue
            seen = maps[np.uintp(place[x])]
            if seen <= F(0):
                continue
            if abs(seen - qz) <= max(same, rough * seen) * qz:
                row = place[x] // columns
                u, v = F(place[x] - row * columns) + half, F(row) + half
                there = (back[0] * u + back[1] * v + back[2]) * seen + back[3]
                if there > F(0):
                    agree[y, x] += 1
                    if len(total) > 0:
                        total[y, x] += one / there
            elif seen > qz:
                through[y, x] += 1


@njit(**FAST)
def compare_colours(depth: Any, other: Any, onto: Any, image: Any, other_image: Any, out: Any) -> None:
    """(H, W) mean difference of the colours of what nothing stands before in another view, whether the depth there is known or not; other
    pixels stay. `image`, `other_image`: (…, 3) uint8 of the sizes of the depth maps; others as in `compare`."""
    height, width = depth.shape
    rows, columns = other.shape
    place, away = np.empty(width, np.int32), np.empty(width, np.float32)
    for y in range(height):
        _seen_at(depth[y], y, onto, columns, rows, place, away)
        for x in range(width):
            row = place[x] // columns
            column = place[x] - row * columns
            if away[x] <= F(0) or F(0) < other[row, column] < F(1 - HIDDEN) * away[x]:
                continue
            difference = F(0)
            for channel in range(3):
                difference += abs(F(image[y, x, channel]) - F(other_image[row, column, channel]))
            out[y, x] = difference / F(3)


@njit(**OPTIONS)
def warp(depth: Any, image: Any, camera: Any, target: Any, there: Any, out: Any, colours: Any) -> None:
    """Put each point of a depth map on the four pixels around it in another camera; the nearest one stays."""
    fx, fy, cx, cy = camera
    gx, gy, ox, oy = target
    height, width = out.shape
    for y in range(depth.shape[0]):
        for x in range(depth.shape[1]):
            z = depth[y, x]
            if z <= 0:
                continue
            qx, qy, qz = _moved(there, (x + 0.5 - cx) / fx * z, (y + 0.5 - cy) / fy * z, z)
            if qz <= 0:
                continue
            u, v = qx / qz * gx + ox - 0.5, qy / qz * gy + oy - 0.5
            if not (-1 < u < width and -1 < v < height):
                continue
            left, top = int(np.floor(u)), int(np.floor(v))
            for row in range(max(top, 0), min(top + 2, height)):
                for column in range(max(left, 0), min(left + 2, width)):
                    if out[row, column] == 0 or qz < out[row, column]:
                        out[row, column] = qz
                        for channel in range(3):
                            colours[row, column, channel] = image[y, x, channel]


@njit(**OPTIONS)
def nearest_agreed(
    depths: Any, colours: Any, least: int, same: float, count: Any, depth: Any, colour: Any, scatter: Any
) -> None:
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


@njit(**OPTIONS)
def _inverse_on(planes: Any, which: Any, x: float, y: float, slant: float) -> float:
    """Inverse depth of the plane `which` on the ray (x, y, 1), 0: behind the camera, or too much aslant."""
    along = planes[which, 0] * x + planes[which, 1] * y + planes[which, 2]
    offset = planes[which, 3]
    if along * offset <= 0 or abs(along) <= slant * np.sqrt(x * x + y * y + 1):
        return 0.0
    return float(along / offset)


@njit(**OPTIONS)
def plane_numbers(depth: Any, camera: Any, planes: Any, on: float, slant: float, out: Any) -> None:
    fx, fy, cx, cy = camera
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            out[v, u] = -1
            z = depth[v, u]
            if z <= 0:
                continue
            out[v, u] = len(planes)
            for plane in range(len(planes)):
                inverse = _inverse_on(planes, plane, (u + 0.5 - cx) / fx, (v + 0.5 - cy) / fy, slant)
                if inverse > 0 and abs(inverse * z - 1) < on:
                    out[v, u] = plane
                    break


@njit(**OPTIONS)
def plane_depths(which: Any, camera: Any, planes: Any, slant: float, out: Any) -> None:
    fx, fy, cx, cy = camera
    for v in range(which.shape[0]):
        for u in range(which.shape[1]):
            if which[v, u] >= 0:
                inverse = _inverse_on(planes, np.int64(which[v, u]), (u + 0.5 - cx) / fx, (v + 0.5 - cy) / fy, slant)
                if inverse > 0:
                    out[v, u] = 1 / inverse


@njit(**OPTIONS)
def pass_on(values: Any, keep: Any) -> None:
    """Along the second axis of values (A, B, C, K), there and back, every value becomes (1 − keep) of itself and keep[·, b, ·] of the one
    before it; keep (A, B − 1, C)."""
    lines, length, beside, channels = values.shape
    for a in range(lines):
        for b in range(1, length):
            for c in range(beside):
                share = keep[a, b - 1, c]
                for k in range(channels):
                    values[a, b, c, k] += share * (values[a, b - 1, c, k] - values[a, b, c, k])
        for b in range(length - 2, -1, -1):
            for c in range(beside):
                share = keep[a, b, c]
                for k in range(channels):
                    values[a, b, c, k] += share * (values[a, b + 1, c, k] - values[a, b, c, k])
