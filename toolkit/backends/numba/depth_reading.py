"""Depth distributions and log odds of surface read between pixels and planes (`DepthDistribution.look`, `CrossView` in tensors)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

from fieldfuse.backends.numba.tensors import OPTIONS, F, array, spread


@njit(**OPTIONS)
def _between(table: Any, x: Any, y: Any, d: Any, channel: int) -> Any:
    """Trilinear value of (h, w, D, C) at pixels and planes with whole numbers at their centres; beyond the border the border's."""
    height, width, planes = table.shape[0], table.shape[1], table.shape[2]
    x, y, d = min(max(x, F(0)), F(width - 1)), min(max(y, F(0)), F(height - 1)), min(max(d, F(0)), F(planes - 1))
    # Whole numbers are bounded once more: what is no number must not be read at.
    left, upper, first = min(max(int(x), 0), width - 1), min(max(int(y), 0), height - 1), min(max(int(d), 0), planes - 1)
    right, lower, second = min(left + 1, width - 1), min(upper + 1, height - 1), min(first + 1, planes - 1)
    sx, sy, sd = x - F(left), y - F(upper), d - F(first)
    value = F(0)
    for corner in range(4):
        row, column = upper if corner < 2 else lower, left if corner % 2 == 0 else right
        weight = (F(1) - sy if corner < 2 else sy) * (F(1) - sx if corner % 2 == 0 else sx)
        value += weight * ((F(1) - sd) * table[row, column, first, channel] + sd * table[row, column, second, channel])
    return value


@njit(**OPTIONS)
def _look(points: Any, truncation: Any, table: Any, pose: Any, lens: Any, lowest: Any, step: Any, out: Any) -> None:
    """`DepthDistribution.look`: expected SDF, visibility, confidence into `out` (N, 3)."""
    height, width = F(table.shape[0]), F(table.shape[1])
    for n in range(len(points)):
        px, py, pz = points[n, 0] - pose[0, 3], points[n, 1] - pose[1, 3], points[n, 2] - pose[2, 3]
        depth = max(px * pose[0, 2] + py * pose[1, 2] + pz * pose[2, 2], F(1e-6))
        inverse = F(1) / depth
        x = ((px * pose[0, 0] + py * pose[1, 0] + pz * pose[2, 0]) * inverse * lens[0] + lens[2]) / lens[4] * width - F(0.5)
        y = ((px * pose[0, 1] + py * pose[1, 1] + pz * pose[2, 1]) * inverse * lens[1] + lens[3]) / lens[5] * height - F(0.5)
        half = inverse * min(truncation[n] / depth, F(0.9))
        near, far = (inverse + half - lowest) / step, (inverse - half - lowest) / step
        nearer = _between(table, x, y, near, 0)
        first = _between(table, x, y, near, 1) - max(-near, F(0)) * step
        last = _between(table, x, y, far, 1) - max(-far, F(0)) * step
        out[n, 0] = min(max(F(1) - (first - last) / half, F(-1)), F(1))
        out[n, 1] = min(max(F(1) - nearer, F(0)), F(1))
        out[n, 2] = min(max(_between(table, x, y, near, 2), F(0)), F(1))


def look(points: Tensor, truncation: Tensor, table: Tensor, camera: Any, lowest: float, step: float) -> Tensor:
    """(3, N): `DepthDistribution.look` at voxels (N, 3) with a truncation (N,) each, from a table (3, D, h, w)."""
    given = [array(values) for values in (points, truncation.expand(len(points)), table.permute(2, 3, 1, 0), *_lens(camera))]
    out = np.empty((len(points), 3), np.float32)
    spread(lambda n: _look(given[0][n], given[1][n], *given[2:], F(lowest), F(step), out[n]), len(points))
    return torch.from_numpy(out).T


def _lens(camera: Any) -> tuple[Tensor, Tensor]:
    """(4, 4) pose, and (6,) fx, fy, cx, cy, width and height of one camera."""
    return camera.world_from_camera[0], camera.lens(0)


@njit(**OPTIONS)
def _log_odds(points: Any, odds: Any, pose: Any, lens: Any, lowest: Any, step: Any, found: Any, seen: Any) -> None:
    """`CrossView.log_odds_at`."""
    height, width = F(odds.shape[0]), F(odds.shape[1])
    for n in range(len(points)):
        found[n], seen[n] = F(0), False
        px, py, pz = points[n, 0] - pose[0, 3], points[n, 1] - pose[1, 3], points[n, 2] - pose[2, 3]
        depth = px * pose[0, 2] + py * pose[1, 2] + pz * pose[2, 2]
        if not depth > F(1e-4):
            continue
        inverse = F(1) / depth
        u = ((px * pose[0, 0] + py * pose[1, 0] + pz * pose[2, 0]) * inverse * lens[0] + lens[2]) / lens[4]
        v = ((px * pose[0, 1] + py * pose[1, 1] + pz * pose[2, 1]) * inverse * lens[1] + lens[3]) / lens[5]
        if u >= F(0) and u <= F(1) and v >= F(0) and v <= F(1):
            seen[n] = True
            found[n] = _between(odds, u * width - F(0.5), v * height - F(0.5), (inverse - lowest) / step, 0)


def log_odds_at(points: Tensor, one: Any) -> tuple[Tensor, Tensor]:
    """(N,) log odds of a `CrossView` at points (N, 3), and (N,) bool whether it sees them."""
    given = [array(values) for values in (points, one.log_odds.permute(1, 2, 0)[..., None], *_lens(one.camera))]
    found, seen = np.empty(len(points), np.float32), np.empty(len(points), np.bool_)
    spread(lambda n: _log_odds(given[0][n], *given[1:], F(one.lowest), F(one.step), found[n], seen[n]), len(points))
    return torch.from_numpy(found), torch.from_numpy(seen)


@njit(**OPTIONS)
def _along_rays(
    rays: Any, inverses: Any, odds: Any, turn: Any, shift: Any, lens: Any, lowest: Any, step: Any, by: Any, total: Any, count: Any
) -> None:
    """Add to `total` (P, D) the log odds of one key frame along rays, times `by`, and count in `count` where it looks."""
    height, width = F(odds.shape[0]), F(odds.shape[1])
    for p in range(len(rays)):
        rx, ry, rz = rays[p, 0], rays[p, 1], rays[p, 2]
        ax = rx * turn[0, 0] + ry * turn[1, 0] + rz * turn[2, 0]
        ay = rx * turn[0, 1] + ry * turn[1, 1] + rz * turn[2, 1]
        az = rx * turn[0, 2] + ry * turn[1, 2] + rz * turn[2, 2]
        for d in range(len(inverses)):
            inverse = inverses[d]
            z = az + inverse * shift[2]  # the depth there over the depth here
            if not z > F(1e-4) * inverse:
                continue
            u = ((ax + inverse * shift[0]) / z * lens[0] + lens[2]) / lens[4]
            v = ((ay + inverse * shift[1]) / z * lens[1] + lens[3]) / lens[5]
            if u >= F(0) and u <= F(1) and v >= F(0) and v <= F(1):
                count[p, d] += F(1)
                place = (inverse / z - lowest) / step
                total[p, d] += by * _between(odds, u * width - F(0.5), v * height - F(0.5), place, 0)


def mean_log_odds(rays: Tensor, inverses: Tensor, origin: Tensor, others: Sequence[Any], reliabilities: Sequence[float]) -> Tensor:
    """(P, D) mean log odds of those of `others` (`CrossView`) that look there, 0 where none does, each by its reliability.

    Args:
        rays: (P, 3) of unit depth, working axes, that begin at `origin` (3,); inverses: (D,) inverse depths along them.
    """
    given = array(rays), array(inverses)
    total, count = (np.zeros((len(rays), len(inverses)), np.float32) for _ in range(2))
    for one, reliability in zip(others, reliabilities, strict=True):
        pose, lens = _lens(one.camera)
        turn = pose[:3, :3]
        odds = [array(values) for values in (one.log_odds.permute(1, 2, 0)[..., None], turn, (origin - pose[:3, 3]) @ turn, lens)]
        numbers = F(one.lowest), F(one.step), F(reliability)

        def part(p: slice, odds: Any = odds, numbers: Any = numbers) -> None:
            _along_rays(given[0][p], given[1], *odds, *numbers, total[p], count[p])

        spread(part, len(rays))
    return torch.from_numpy(total / np.maximum(count, F(1)))
