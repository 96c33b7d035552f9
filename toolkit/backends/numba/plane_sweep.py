"""The plane sweep of the networks, pixel by pixel (`nerfusion/extras/plane_sweep.py` in tensors, to rounding).

In tensors a sweep writes what another view shows of every pixel at every plane, 21 numbers each, and reads it back; here they are compared
where they are looked up. Volumes lie in memory pixel by pixel, planes next to each other, since all that follows goes along planes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

from fieldfuse.backends.numba.tensors import OPTIONS, F, array, spread

COLOURS, PATCH = 3, 18  # of a descriptor
WIDE, WHOLE = 24, 28  # here: patches and zeros up to whole vectors, then colours


@njit(**OPTIONS)
def _compare(
    own: Any, other: Any, rays: Any, turn: Any, shift: Any, lens: Any, inverses: Any, gain: Any, cost: Any, least: Any, seen: Any
) -> None:
    """Add to `cost`, lower `least` and count in `seen` (P, D) how the other view differs where it sees a pixel at a plane."""
    height, width = other.shape[0], other.shape[1]
    fx, fy, cx, cy, across, down = lens[0], lens[1], lens[2], lens[3], lens[4], lens[5]
    for p in range(len(own)):
        rx, ry, rz = rays[p, 0], rays[p, 1], rays[p, 2]
        ax = rx * turn[0, 0] + ry * turn[1, 0] + rz * turn[2, 0]
        ay = rx * turn[0, 1] + ry * turn[1, 1] + rz * turn[2, 1]
        az = rx * turn[0, 2] + ry * turn[1, 2] + rz * turn[2, 2]
        mine = own[p]
        for d in range(len(inverses)):
            z = az + inverses[d] * shift[2]
            if not z > F(1e-4):
                continue
            u = ((ax + inverses[d] * shift[0]) / z * fx + cx) / across
            v = ((ay + inverses[d] * shift[1]) / z * fy + cy) / down
            if not (u >= F(0) and u <= F(1) and v >= F(0) and v <= F(1)):
                continue
            x = min(max(u * F(width) - F(0.5), F(0)), F(width - 1))
            y = min(max(v * F(height) - F(0.5), F(0)), F(height - 1))
            left, upper = int(x), int(y)
            right, lower = min(left + 1, width - 1), min(upper + 1, height - 1)
            sx, sy = x - F(left), y - F(upper)
            w00, w01, w10, w11 = (F(1) - sx) * (F(1) - sy), sx * (F(1) - sy), (F(1) - sx) * sy, sx * sy
            a, b, c, e = other[upper, left], other[upper, right], other[lower, left], other[lower, right]
            patch = F(0)
            for k in range(WIDE):
                apart = w00 * a[k] + w01 * b[k] + w10 * c[k] + w11 * e[k] - mine[k]
                patch += apart * apart
            colour = F(0)
            for k in range(WIDE, WIDE + COLOURS):
                colour += abs(w00 * a[k] + w01 * b[k] + w10 * c[k] + w11 * e[k] - mine[k])
            value = F(0.5) * (min(colour * (gain / F(COLOURS)), F(1)) + min(patch * F(0.5 / PATCH), F(1)))
            cost[p, d] += value
            least[p, d] = min(least[p, d], value)
            seen[p, d] += 1


@njit(**OPTIONS)
def _combine(cost: Any, least: Any, seen: Any, unknown: Any) -> None:
    """`matching.together`, into `cost`."""
    for p in range(len(cost)):
        for d in range(cost.shape[1]):
            cost[p, d] = F(0.5) * (cost[p, d] / F(seen[p, d]) + least[p, d]) if seen[p, d] else unknown


def _widened(descriptors: Tensor) -> Any:
    """(..., 21) descriptors as they are compared here, (..., 28)."""
    out = descriptors.new_zeros((*descriptors.shape[:-1], WHOLE))
    out[..., :PATCH], out[..., WIDE : WIDE + COLOURS] = descriptors[..., COLOURS:], descriptors[..., :COLOURS]
    return array(out)


def costs(descriptors: Sequence[Tensor], cameras: Any, inverses: Tensor, rays: Tensor, own: Tensor, gain: float, unknown: float) -> Tensor:
    """(P, D) of pixels of the first view.

    Args:
        descriptors: K ≥ 2 times (21, h, w), of any sizes; cameras: K.
        inverses: (D,) inverse depths of planes; rays: (P, 3) of unit depth, working axes; own: (P, 21).
        gain: of a mean difference in colour; unknown: the cost where no view sees the place.
    """
    mine, given, inverses = _widened(own), array(rays), array(inverses)
    shape = (len(own), len(inverses))
    cost, least, seen = np.zeros(shape, np.float32), np.ones(shape, np.float32), np.zeros(shape, np.uint16)
    for view in range(1, len(descriptors)):
        axes = cameras.world_from_camera[view, :3, :3]
        shift = (cameras.positions[0] - cameras.positions[view]) @ axes
        other = _widened(descriptors[view].permute(1, 2, 0))
        turn, moved, lens = array(axes), array(shift), array(cameras.lens(view))

        def part(p: slice, other: Any = other, turn: Any = turn, moved: Any = moved, lens: Any = lens) -> None:
            _compare(mine[p], other, given[p], turn, moved, lens, inverses, F(gain), cost[p], least[p], seen[p])

        spread(part, len(own))
    _combine(cost, least, seen, F(unknown))
    return torch.from_numpy(cost)


@njit(**OPTIONS)
def _carve(likely: Any, empty: Any, lost: Any, out: Any) -> None:
    """`plane_sweep.carved` of pixels (P, D) into `out`."""
    planes = likely.shape[1]
    for p in range(len(likely)):
        own, left = likely[p], out[p]
        total, places = F(0), 0
        for d in range(planes):
            free = empty[p, d] == 0
            left[d] = own[d] if free else F(0)
            total += left[d]
            places += free
        if places == 0:
            left[0] = F(1)
        elif total > lost:
            for d in range(planes):
                left[d] /= total
        else:
            for d in range(planes):
                left[d] = F(0) if empty[p, d] else F(1) / F(places)


def carved(likely: Tensor, empty: Tensor, lost: float) -> Tensor:
    """`plane_sweep.carved` of likelihoods (D, h, w); `lost` is what is left of a pixel where nothing is known any more."""
    planes, height, width = likely.shape
    given = array(likely.permute(1, 2, 0).reshape(-1, planes)), array(empty.permute(1, 2, 0).reshape(-1, planes).view(torch.uint8))
    out = np.empty((height * width, planes), np.float32)
    spread(lambda p: _carve(given[0][p], given[1][p], F(lost), out[p]), height * width)
    return torch.from_numpy(out).view(height, width, planes).permute(2, 0, 1)


@njit(**OPTIONS)
def _fill(likely: Any, step: Any, width: int, table: Any) -> None:
    """Likelihoods (P, D) → `table` (P, D, 3)."""
    planes = likely.shape[1]
    behind = np.zeros(planes + 1, np.float32)  # likelihood of this plane and all nearer ones
    for p in range(len(likely)):
        own, out = likely[p], table[p]
        for d in range(planes - 1, -1, -1):
            behind[d] = behind[d + 1] + own[d]
        sure = F(0)
        for d in range(planes - width + 1):
            sure = max(sure, behind[d] - behind[d + width])
        after, last = F(0), F(0)
        for d in range(planes):
            nearer = F(0.5) * (behind[d] + behind[d + 1])  # the surface lies anywhere about its plane
            after += F(0.5) * (last + nearer) * step if d > 0 else F(0)
            out[d, 0], out[d, 1], out[d, 2] = nearer, after, sure
            last = nearer


def table(likely: Tensor, step: float, peak: int) -> Tensor:
    """The table (3, D, h, w) of likelihoods (D, h, w), in memory (h, w, D, 3)."""
    planes, height, width = likely.shape
    given = array(likely.permute(1, 2, 0).reshape(-1, planes))
    out = np.empty((height * width, planes, 3), np.float32)
    spread(lambda p: _fill(given[p], F(step), min(2 * peak + 1, planes), out[p]), height * width)
    return torch.from_numpy(out).view(height, width, planes, 3).permute(3, 2, 0, 1)
