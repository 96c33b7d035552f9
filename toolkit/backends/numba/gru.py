"""What the GRU does between its convolutions: a pass over the rows each time, instead of one for each operation.

Rows that the key frame does not see cost a look. Latents are read where the volumes hold them, not gathered first. Values equal those of
`FusionGRU.forward` to rounding (tests compare them), whatever the number of threads. tanh is a quotient of polynomials, which the processor
computes for all channels at once; its error is below 3e-7.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

from fieldfuse.backends.numba.tensors import OPTIONS, F, array, spread

LARGE = F(4.5)  # half of where tanh is 1 in float32


@njit(**OPTIONS)
def tanh(x: Any) -> Any:
    """tanh x = 2t / (1 + t²) with t = tanh(x/2) by the continued fraction x / (1 + x² / (3 + x² / (5 + …))), cut off at 13."""
    h = min(max(F(0.5) * x, -LARGE), LARGE)
    s = h * h
    upper = h * (F(135135) + s * (F(17325) + s * (F(378) + s)))
    lower = F(135135) + s * (F(62370) + s * (F(3150) + s * F(28)))
    return min(max(F(2) * upper * lower / (lower * lower + upper * upper), F(-1)), F(1))


@njit(**OPTIONS)
def _average(state: Any, count: Any, local: Any, weight: Any, seen: Any, least: Any, most: Any, out: Any) -> None:
    """The weighted running mean where the key frame sees, zero elsewhere."""
    for i in range(len(count)):
        if seen[i] == F(0):
            out[i] = F(0)
            continue
        w = max(weight[i], least)
        z = w / (w + min(count[i], most))
        known = F(1) if count[i] > F(0) else F(0)
        for c in range(out.shape[1]):
            before = known * state[i, c]
            out[i, c] = before + z * (local[i, c] - before)


@njit(**OPTIONS)
def _beside(place: Any, state: Any, count: Any, local: Any, seen: Any, both: Any) -> None:
    """[H, V] of the rows `place`, zero where the key frame does not see."""
    channels = state.shape[1]
    for i in range(len(place)):
        row = place[i]
        if seen[row] == F(0):
            both[i] = F(0)
            continue
        known = F(1) if count[row] > F(0) else F(0)
        for c in range(channels):
            both[i, c] = known * state[row, c]
            both[i, channels + c] = local[row, c]


@njit(**OPTIONS)
def _forget(place: Any, state: Any, count: Any, seen: Any, reset: Any, both: Any) -> None:
    """H → r ∘ H in what `_beside` wrote."""
    for i in range(len(place)):
        row = place[i]
        if seen[row] == F(0) or count[row] == F(0):
            continue
        for c in range(state.shape[1]):
            both[i, c] = (F(0.5) + F(0.5) * tanh(F(0.5) * reset[i, c])) * state[row, c]


@njit(**OPTIONS)
def _step(
    place: Any, state: Any, count: Any, raw: Any, weight: Any, seen: Any, update: Any, candidate: Any, limits: Any, held: int, out: Any
) -> None:
    """H' into the rows `place` of `out`; `limits`: least w, most n, most that may be added to channel `held`."""
    channels = state.shape[1]
    learned = np.empty(channels, np.float32)
    least, most, change = limits[0], limits[1], limits[2]
    for i in range(len(place)):
        row = place[i]
        if seen[row] == F(0):
            continue
        learned[:] = candidate[i]
        learned[held] = change * tanh(learned[held] / change)
        if count[row] == F(0):  # nothing was known: z = 1
            for c in range(channels):
                out[row, c] = tanh(raw[row, c] + learned[c])
            continue
        w, n = max(weight[row], least), min(count[row], most)
        for c in range(channels):
            s = F(0.5) + F(0.5) * tanh(F(0.5) * update[i, c])
            z = s * w / (s * w + (F(1) - s) * n)  # σ(u + log(w / n))
            before = state[row, c]
            out[row, c] = before + z * (tanh(raw[row, c] + learned[c]) - before)


class Step:
    """One step of the recurrence, its convolutions left to the caller.

    Args:
        place: (M' · 512,) rows of the blocks that the networks work on.
        part: the global volume (H, n) on the blocks of the local one.
        local: V, V_raw, w, and the number of views that see a voxel.
        least, most: bounds of w and n.
    """

    def __init__(self, place: Tensor, part: Any, local: Any, least: float, most: float) -> None:
        self.place, self.state, self.count, self.local = array(place), array(part.rows), array(part.count), array(local.rows)
        self.raw, self.weight, self.seen = array(local.raw), array(local.weight), array(local.count)
        self.least, self.most = F(least), F(most)

    def average(self) -> Tensor:
        """(M · 512 + 1, C) the weighted running mean of the local volumes."""
        out = np.empty_like(self.state)
        out[-1] = 0
        given = self.state, self.count, self.local, self.weight, self.seen
        spread(lambda i: _average(*(values[i] for values in given), self.least, self.most, out[i]), len(self.count))
        return torch.from_numpy(out)

    def beside(self) -> Tensor:
        """(M' · 512 + 1, 2C) [H, V]."""
        both = np.empty((len(self.place) + 1, 2 * self.state.shape[1]), np.float32)
        both[-1] = 0
        spread(lambda i: _beside(self.place[i], self.state, self.count, self.local, self.seen, both[i]), len(self.place))
        return torch.from_numpy(both)

    def forget(self, reset: Tensor, both: Tensor) -> None:
        """[H, V] → [r ∘ H, V], in place; `reset`: M_r's."""
        gate, out = array(reset.float()), both.numpy()
        spread(lambda i: _forget(self.place[i], self.state, self.count, self.seen, gate[i], out[i]), len(self.place))

    def update(self, update: Tensor, candidate: Tensor, channel: int, change: float, rows: Tensor) -> None:
        """H' into `rows` (M · 512 + 1, C), in place.

        Args:
            update, candidate: M_z's, M_t's.
            channel, change: that of the latent to which at most so much is added.
        """
        z, t, out = array(update.float()), array(candidate.float()), rows.numpy()
        known, limits = (self.state, self.count, self.raw, self.weight, self.seen), np.array([self.least, self.most, change], np.float32)
        spread(lambda i: _step(self.place[i], *known, z[i], t[i], limits, channel, out), len(self.place))
