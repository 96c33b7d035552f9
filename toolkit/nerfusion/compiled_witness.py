"""`cross_view_consistency.py` compiled for the CPU: log odds of surface read at points, or along the rays of another key frame."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

from fieldfuse.nerfusion.compiled import OPTIONS, F, array, between, spread


@njit(**OPTIONS)
def _ask(points: Any, says: Any, pose: Any, lens: Any, lowest: Any, step: Any, said: Any, seen: Any) -> None:
    """`CrossView.log_odds_at`."""
    height, width = F(says.shape[0]), F(says.shape[1])
    for n in range(len(points)):
        said[n], seen[n] = F(0), False
        px, py, pz = points[n, 0] - pose[0, 3], points[n, 1] - pose[1, 3], points[n, 2] - pose[2, 3]
        depth = px * pose[0, 2] + py * pose[1, 2] + pz * pose[2, 2]
        if not depth > F(1e-4):
            continue
        inverse = F(1) / depth
        u = ((px * pose[0, 0] + py * pose[1, 0] + pz * pose[2, 0]) * inverse * lens[0] + lens[2]) / lens[4]
        v = ((px * pose[0, 1] + py * pose[1, 1] + pz * pose[2, 1]) * inverse * lens[1] + lens[3]) / lens[5]
        if u >= F(0) and u <= F(1) and v >= F(0) and v <= F(1):
            seen[n] = True
            said[n] = between(says, u * width - F(0.5), v * height - F(0.5), (inverse - lowest) / step, 0)


def ask(points: Tensor, says: Tensor, pose: Tensor, lens: Tensor, lowest: float, step: float) -> tuple[Tensor, Tensor]:
    """(N,) what a witness says (D, h, w) of the points, and (N,) bool whether it sees them; pose and lens as in `look`."""
    given = [array(values) for values in (points, says.permute(1, 2, 0)[..., None], pose, lens)]
    said, seen = np.empty(len(points), np.float32), np.empty(len(points), np.bool_)
    spread(lambda n: _ask(given[0][n], *given[1:], F(lowest), F(step), said[n], seen[n]), len(points))
    return torch.from_numpy(said), torch.from_numpy(seen)


@njit(**OPTIONS)
def _question(
    rays: Any, inverses: Any, says: Any, turn: Any, shift: Any, lens: Any, lowest: Any, step: Any, by: Any, total: Any, count: Any
) -> None:
    """Add to `total` (P, D) what a witness says along rays, times `by`, and count in `count` where it looks."""
    height, width = F(says.shape[0]), F(says.shape[1])
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
                total[p, d] += by * between(says, u * width - F(0.5), v * height - F(0.5), place, 0)


class Question:
    """Asks witnesses about places along rays; `CrossView.log_odds_at` for all of them without writing them down.

    Args:
        rays: (P, 3) of unit depth of the one who asks, working axes.
        inverses: (D,) inverse depths.
        origin: (3,) where the rays begin.
    """

    def __init__(self, rays: Tensor, inverses: Tensor, origin: Tensor) -> None:
        self.rays, self.inverses, self.origin = array(rays), array(inverses), origin
        self.total, self.count = (np.zeros((len(rays), len(inverses)), np.float32) for _ in range(2))

    def put(self, says: Tensor, pose: Tensor, lens: Tensor, lowest: float, step: float, belief: float) -> None:
        """One more witness, believed so far; the rest as for `ask`."""
        turn = pose[:3, :3]
        given = [array(values) for values in (says.permute(1, 2, 0)[..., None], turn, (self.origin - pose[:3, 3]) @ turn, lens)]
        numbers = F(lowest), F(step), F(belief)
        spread(lambda p: _question(self.rays[p], self.inverses, *given, *numbers, self.total[p], self.count[p]), len(self.rays))

    def mean(self) -> Tensor:
        """(P, D) of those that look there; 0 where none does."""
        return torch.from_numpy(self.total / np.maximum(self.count, F(1)))
