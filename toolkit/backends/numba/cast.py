"""First hits of rays on convex solids: boxes, rooms (a box seen from inside), ellipsoids and cylinders, sorted by kind in this order."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

F = np.float32
FAR, NEAREST, PARALLEL, SMALLEST = F(1e9), F(1e-5), F(1e-8), F(1e-12)  # metres but for the last two: nothing is hit nearer than `NEAREST`
OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy"}


@njit(**OPTIONS)
def _slab(start: Any, slope: Any, half: Any) -> Any:
    """Entry and exit of the space between −half and half along one axis."""
    inverse = F(1) / max(abs(slope), PARALLEL)
    middle = -start * (inverse if slope >= F(0) else -inverse)
    return middle - inverse * half, middle + inverse * half


@njit(**OPTIONS)
def _own(turn: Any, x: Any, y: Any, z: Any) -> Any:
    """A vector in a solid's own axes, the columns of `turn`."""
    return (
        x * turn[0, 0] + y * turn[1, 0] + z * turn[2, 0],
        x * turn[0, 1] + y * turn[1, 1] + z * turn[2, 1],
        x * turn[0, 2] + y * turn[1, 2] + z * turn[2, 2],
    )


@njit(**OPTIONS)
def _interval(axes: int, sx: Any, sy: Any, sz: Any, rx: Any, ry: Any, rz: Any, half: Any) -> Any:
    """Entry and exit of a solid that is round in its first `axes` axes (0, 2 or 3) and flat in the others; entry after exit: missed."""
    enter, leave = F(-FAR), FAR
    if axes == 0:
        enter, leave = _slab(sx, rx, half[0])
        near, far = _slab(sy, ry, half[1])
        enter, leave = max(enter, near), min(leave, far)
    else:
        # By the distance of the centre from the ray, not by a difference of squares: that loses the digits of small, far balls.
        ox, oy, dx, dy = sx / half[0], sy / half[1], rx / half[0], ry / half[1]
        oz, dz = (sz / half[2], rz / half[2]) if axes == 3 else (F(0), F(0))
        length = max(dx * dx + dy * dy + dz * dz, SMALLEST)
        closest = -(ox * dx + oy * dy + oz * dz) / length
        mx, my, mz = ox + closest * dx, oy + closest * dy, oz + closest * dz
        miss = mx * mx + my * my + mz * mz
        if miss >= F(1):
            return FAR, F(-FAR)
        reach = np.sqrt((F(1) - miss) / length)
        enter, leave = closest - reach, closest + reach
    if axes < 3:
        near, far = _slab(sz, rz, half[2])
        enter, leave = max(enter, near), min(leave, far)
    return enter, leave


@njit(**OPTIONS)
def cast(
    origins: Any, directions: Any, centres: Any, halves: Any, turns: Any, radii: Any, ends: Any, distance: Any, number:
    Any
) -> None:
    """The nearest solid of each ray, −1 and a distance of `FAR` where there is none. A solid that a ray starts in is not seen, but rooms
    are.

    Args:
        origins: (N, 3), or (1, 3) for rays from one place; directions: (N, 3) unit vectors.
        centres, halves, turns, radii: (P, 3), (P, 3), (P, 3, 3) and (P,), the last of spheres around solids, infinite for rooms.
        ends: (4,) past-the-last number of boxes, rooms, ellipsoids and cylinders.
        distance, number: (N,) float32 and int64 results.
    """
    for n in range(len(directions)):
        start, ray = origins[n if len(origins) > 1 else 0], directions[n]
        best, which = FAR, -1
        for p in range(len(centres)):
            x, y, z = start[0] - centres[p, 0], start[1] - centres[p, 1], start[2] - centres[p, 2]
            along = -(x * ray[0] + y * ray[1] + z * ray[2])
            if along - radii[p] >= best or along + radii[p] <= F(0):
                continue
            mx, my, mz = x + along * ray[0], y + along * ray[1], z + along * ray[2]
            if mx * mx + my * my + mz * mz > radii[p] * radii[p]:
                continue
            axes = 0 if p < ends[1] else (3 if p < ends[2] else 2)
            sx, sy, sz = _own(turns[p], x, y, z)
            rx, ry, rz = _own(turns[p], ray[0], ray[1], ray[2])
            enter, leave = _interval(axes, sx, sy, sz, rx, ry, rz, halves[p])
            reached = leave if ends[0] <= p < ends[1] else enter
            if enter <= leave and NEAREST < reached < best:
                best, which = reached, p
        distance[n], number[n] = best, which
