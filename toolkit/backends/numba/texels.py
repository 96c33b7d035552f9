"""The texels of a texture, compiled: what an image shows in them, their means, and their colours in the large.

All of them go through a triangle's half of its square in the texture, gutter included; see `export.atlas.Atlas` for the layout `corner`,
`length`, `way`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

F = np.float32
OPTIONS: Any = {"cache": True, "nogil": True, "error_model": "numpy"}


@njit(**OPTIONS)
def add_image(
    seen: Any, corners: Any, share: Any, corner: Any, length: Any, way: Any, image: Any, matrix: Any, texture: Any, total: Any
) -> None:
    """Add what an image shows to the texels of the triangles `seen`, by its `share` (T, 3) at their vertices."""
    height, width = image.shape[0], image.shape[1]
    one = F(1)
    for t in seen:
        reach = length[t] + 3
        for j in range(reach):
            for i in range(reach - j if way[t] > 0 else reach - 1 - j):
                b, c = F(i) / F(length[t]), F(j) / F(length[t])
                a = one - b - c
                amount = a * share[t, 0] + b * share[t, 1] + c * share[t, 2]
                if amount <= F(0):
                    continue
                x = a * corners[t, 0, 0] + b * corners[t, 1, 0] + c * corners[t, 2, 0]
                y = a * corners[t, 0, 1] + b * corners[t, 1, 1] + c * corners[t, 2, 1]
                z = a * corners[t, 0, 2] + b * corners[t, 1, 2] + c * corners[t, 2, 2]
                w = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z + matrix[2, 3]
                if w <= F(0):
                    continue
                u = (matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z + matrix[0, 3]) / w - F(0.5)
                v = (matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z + matrix[1, 3]) / w - F(0.5)
                if not (u >= F(0) and v >= F(0) and u <= F(width - 1) and v <= F(height - 1)):
                    continue
                left, top = min(int(u), width - 2), min(int(v), height - 2)
                if left < 0 or top < 0:
                    continue
                right, down = u - F(left), v - F(top)
                row, column = corner[t, 1] + way[t] * j, corner[t, 0] + way[t] * i
                total[row, column] += amount
                for k in range(3):
                    upper = F(image[top, left, k]) * (one - right) + F(image[top, left + 1, k]) * right
                    lower = F(image[top + 1, left, k]) * (one - right) + F(image[top + 1, left + 1, k]) * right
                    texture[row, column, k] += amount * (upper * (one - down) + lower * down)


@njit(**OPTIONS)
def finish(corners: Any, colours: Any, corner: Any, length: Any, way: Any, texture: Any, total: Any, means: Any) -> None:
    """Sums to means; texels that no image shows get the colours (T, 3, 3) of their triangle's vertices. `means` (T, 3) of triangles."""
    zero, one = F(0), F(1)
    for t in range(len(corners)):
        reach, count = length[t] + 3, 0
        for j in range(reach):
            for i in range(reach - j if way[t] > 0 else reach - 1 - j):
                row, column = corner[t, 1] + way[t] * j, corner[t, 0] + way[t] * i
                b, c = min(F(i) / F(length[t]), one), min(F(j) / F(length[t]), one)
                a = max(one - b - c, zero)
                for k in range(3):
                    if total[row, column] > F(1e-6):
                        texture[row, column, k] /= total[row, column]
                    else:
                        texture[row, column, k] = (a * colours[t, 0, k] + b * colours[t, 1, k] + c * colours[t, 2, k]) / (a + b + c)
                if i + j <= length[t]:
                    count += 1
                    for k in range(3):
                        means[t, k] += texture[row, column, k]
        for k in range(3):
            means[t, k] /= F(count)


@njit(**OPTIONS)
def shift(off: Any, corner: Any, length: Any, way: Any, texture: Any) -> None:
    """Add to the texels of each triangle what lies between `off` (T, 3, 3) of its vertices."""
    one = F(1)
    for t in range(len(off)):
        reach = length[t] + 3
        for j in range(reach):
            for i in range(reach - j if way[t] > 0 else reach - 1 - j):
                b, c = F(i) / F(length[t]), F(j) / F(length[t])
                row, column = corner[t, 1] + way[t] * j, corner[t, 0] + way[t] * i
                for k in range(3):
                    texture[row, column, k] += (one - b - c) * off[t, 0, k] + b * off[t, 1, k] + c * off[t, 2, k]
