# mypy: disable-error-code="no-untyped-def,untyped-decorator,misc"
"""What the GRU does between its convolutions on CUDA, a launch each (`FusionGRU.forward` in tensors, `compiled_gru.py` on the CPU)."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from toolkit.gpu import kernel
from toolkit.networks.lattice import LatentVolume, LocalVolume

BLOCK = 64  # rows at a time


@triton.jit
def _tanh(x):
    return 2 / (1 + tl.exp(-2 * tl.minimum(tl.maximum(x, -15.0), 15.0))) - 1


@kernel("state", "local", "out")
def _average(state, count, local, weight, seen, out, rows, least, most, CHANNELS: tl.constexpr, WIDE: tl.constexpr, BLOCK: tl.constexpr):
    """The weighted running mean where the key frame sees, zero elsewhere."""
    n = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    c = tl.arange(0, WIDE)[None, :]
    looks = tl.load(seen + n, n < rows, 0.0) > 0
    known = tl.load(count + n, looks, 0.0)
    w = tl.maximum(tl.load(weight + n, looks, 1.0), least)
    z = w / (w + tl.minimum(known, most))
    at = n[:, None] * CHANNELS + c
    here = looks[:, None] & (c < CHANNELS)
    before = tl.load(state + at, here & (known > 0)[:, None], 0.0)
    value = before + z[:, None] * (tl.load(local + at, here, 0.0) - before)
    tl.store(out + at, value, (n <= rows)[:, None] & (c < CHANNELS))


@kernel("state", "local", "both")
def _beside(
    place, state, count, local, seen, reset, both, rows,
    FORGET: tl.constexpr, CHANNELS: tl.constexpr, WIDE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """[H, V] or, with FORGET, the first half of [r ∘ H, V] of the rows `place`, zero where the key frame does not see."""
    n = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    c = tl.arange(0, WIDE)[None, :]
    row = tl.load(place + n, n < rows, 0)
    looks = (tl.load(seen + row, n < rows, 0.0) > 0) & (n < rows)
    known = looks & (tl.load(count + row, looks, 0.0) > 0)
    mask = (n <= rows)[:, None] & (c < CHANNELS)
    value = tl.load(state + row[:, None] * CHANNELS + c, known[:, None] & (c < CHANNELS), 0.0)
    out = both + n[:, None] * (2 * CHANNELS) + c
    if FORGET:
        gate = tl.load(reset + n[:, None] * CHANNELS + c, known[:, None] & (c < CHANNELS), 0.0).to(tl.float32)
        tl.store(out, (value / (1 + tl.exp(-gate))).to(both.dtype.element_ty), mask)
    else:
        tl.store(out, value.to(both.dtype.element_ty), mask)
        value = tl.load(local + row[:, None] * CHANNELS + c, looks[:, None] & (c < CHANNELS), 0.0)
        tl.store(out + CHANNELS, value.to(both.dtype.element_ty), mask)


@kernel("state", "raw", "update", "candidate", "out")
def _step(
    place, state, count, raw, weight, seen, update, candidate, out, rows, least, most, held, change,
    CHANNELS: tl.constexpr, WIDE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """H' into the rows `place` of `out`."""
    n = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    c = tl.arange(0, WIDE)[None, :]
    row = tl.load(place + n, n < rows, 0)
    looks = (tl.load(seen + row, n < rows, 0.0) > 0) & (n < rows)
    known = tl.load(count + row, looks, 0.0)
    w = tl.maximum(tl.load(weight + row, looks, 1.0), least)
    at, of = row[:, None] * CHANNELS + c, n[:, None] * CHANNELS + c
    here = looks[:, None] & (c < CHANNELS)
    learned = tl.load(candidate + of, here, 0.0).to(tl.float32)
    learned = tl.where(c == held, change * _tanh(learned / change), learned)
    after = _tanh(tl.load(raw + at, here, 0.0) + learned)
    s = 1 / (1 + tl.exp(-tl.load(update + of, here, 0.0).to(tl.float32)))
    known = tl.minimum(known, most)[:, None]
    z = tl.where(known > 0, s * w[:, None] / (s * w[:, None] + (1 - s) * known), 1.0)  # σ(u + log(w / n))
    before = tl.load(state + at, here & (known > 0), 0.0)
    tl.store(out + at, before + z * (after - before), here)


class Step:
    """As `compiled_gru.Step`."""

    def __init__(self, place: Tensor, part: LatentVolume, local: LocalVolume, least: float, most: float) -> None:
        self.place, self.state, self.count, self.local = place, part.rows.contiguous(), part.count, local.rows.contiguous()
        self.raw, self.weight, self.seen = local.raw.contiguous(), local.weight, local.count
        self.least, self.most = least, float(most)
        self.channels = self.state.shape[1]
        self._sizes = {"CHANNELS": self.channels, "WIDE": triton.next_power_of_2(self.channels), "BLOCK": BLOCK}
        self._grid = (triton.cdiv(len(place) + 1, BLOCK),)

    def average(self) -> Tensor:
        """(M · 512 + 1, C) the weighted running mean of the local volumes."""
        out, rows = torch.empty_like(self.state), len(self.count)
        given = self.state, self.count, self.local, self.weight, self.seen
        _average[(triton.cdiv(rows + 1, BLOCK),)](*given, out, rows, self.least, self.most, **self._sizes)
        return out

    def beside(self, kind: torch.dtype) -> Tensor:
        """(M' · 512 + 1, 2C) [H, V] in the numbers that convolutions compute in."""
        both = self.state.new_empty((len(self.place) + 1, 2 * self.channels), dtype=kind)
        self._beside(both, both, False)
        return both

    def forget(self, reset: Tensor, both: Tensor) -> None:
        """[H, V] → [r ∘ H, V], in place; `reset`: M_r's."""
        self._beside(reset.contiguous(), both, True)

    def _beside(self, reset: Tensor, both: Tensor, forget: bool) -> None:
        given = self.place, self.state, self.count, self.local, self.seen
        _beside[self._grid](*given, reset, both, len(self.place), FORGET=forget, **self._sizes)

    def update(self, update: Tensor, candidate: Tensor, channel: int, change: float, rows: Tensor) -> None:
        """H' into `rows` (M · 512 + 1, C), in place; see `compiled_gru.Step.update`."""
        given = self.place, self.state, self.count, self.raw, self.weight, self.seen
        learned = update.contiguous(), candidate.contiguous()
        _step[self._grid](*given, *learned, rows, len(self.place), self.least, self.most, channel, change, **self._sizes)
