# mypy: disable-error-code="no-untyped-def,untyped-decorator,misc"
"""What the GRU does between its convolutions on CUDA, a launch each (`FusionGRU.forward` in tensors)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
import triton.language as tl
from torch import Tensor

from fieldfuse.backends.constants import VOXELS
from fieldfuse.backends.triton.launch import kernel, pieces, power_of_two
from fieldfuse.backends.triton.volumes import tanh

if TYPE_CHECKING:
    from fieldfuse.nerfusion.lattice import LatentVolume, LocalVolume

BLOCK = 64  # rows at a time


@kernel("state", "local", "out")
def _average(
    state, count, local, weight, seen, out, out_count, rows, least, most, CHANNELS: tl.constexpr, WIDE: tl.constexpr, BLOCK: tl.constexpr
):  # fmt: skip
    """The weighted running mean where the key frame sees, zero elsewhere; and what is known then."""
    n = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    c = tl.arange(0, WIDE)[None, :]
    looks = tl.load(seen + n, n < rows, 0.0) > 0
    known = tl.load(count + n, looks, 0.0)
    added = tl.load(weight + n, n < rows, 0.0)
    w = tl.maximum(added, least)
    z = w / (w + tl.minimum(known, most))
    at = n[:, None] * CHANNELS + c
    here = looks[:, None] & (c < CHANNELS)
    before = tl.load(state + at, here & (known > 0)[:, None], 0.0)
    value = tl.where(looks[:, None], before + z[:, None] * (tl.load(local + at, here, 0.0) - before), 0.0)
    tl.store(out + at, value, (n <= rows)[:, None] & (c < CHANNELS))
    tl.store(out_count + n, known + added, n < rows)


@kernel("among", "state", "local", "both")
def _beside(
    among, state, count, local, seen, gates, both, inside, rows,
    FORGET: tl.constexpr, CHANNELS: tl.constexpr, WIDE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """[H, V] and where the key frame sees or, with FORGET, the first half of [r ∘ H, V], of the rows of blocks `among`; zero where the key
    frame does not see."""
    n = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    c = tl.arange(0, WIDE)[None, :]
    row = tl.load(among + n // 512, n < rows, 0) * 512 + n % 512
    looks = (tl.load(seen + row, n < rows, 0.0) > 0) & (n < rows)
    known = looks & (tl.load(count + row, looks, 0.0) > 0)
    mask = (n <= rows)[:, None] & (c < CHANNELS)
    value = tl.load(state + row[:, None] * CHANNELS + c, known[:, None] & (c < CHANNELS), 0.0)
    out = both + n[:, None] * (2 * CHANNELS) + c
    if FORGET:
        gate = tl.load(gates + n[:, None] * (2 * CHANNELS) + CHANNELS + c, known[:, None] & (c < CHANNELS), 0.0).to(tl.float32)
        tl.store(out, (value / (1 + tl.exp(-gate))).to(both.dtype.element_ty), mask)
    else:
        tl.store(out, value.to(both.dtype.element_ty), mask)
        value = tl.load(local + row[:, None] * CHANNELS + c, looks[:, None] & (c < CHANNELS), 0.0)
        tl.store(out + CHANNELS, value.to(both.dtype.element_ty), mask)
        tl.store(inside + n, looks.to(tl.uint8), n < rows)


@kernel("among", "state", "raw", "gates", "candidate", "out")
def _step(
    among, state, count, raw, weight, seen, gates, candidate, out, rows, least, most, held, change,
    CHANNELS: tl.constexpr, WIDE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """H' into the rows of blocks `among` of `out`."""
    n = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    c = tl.arange(0, WIDE)[None, :]
    row = tl.load(among + n // 512, n < rows, 0) * 512 + n % 512
    looks = (tl.load(seen + row, n < rows, 0.0) > 0) & (n < rows)
    known = tl.load(count + row, looks, 0.0)
    w = tl.maximum(tl.load(weight + row, looks, 1.0), least)
    at, of = row[:, None] * CHANNELS + c, n[:, None] * CHANNELS + c
    here = looks[:, None] & (c < CHANNELS)
    learned = tl.load(candidate + of, here, 0.0).to(tl.float32)
    learned = tl.where(c == held, change * tanh(learned / change), learned)
    after = tanh(tl.load(raw + at, here, 0.0) + learned)
    s = 1 / (1 + tl.exp(-tl.load(gates + n[:, None] * (2 * CHANNELS) + c, here, 0.0).to(tl.float32)))
    known = tl.minimum(known, most)[:, None]
    z = tl.where(known > 0, s * w[:, None] / (s * w[:, None] + (1 - s) * known), 1.0)  # σ(u + log(w / n))
    before = tl.load(state + at, here & (known > 0), 0.0)
    tl.store(out + at, before + z * (after - before), here)


class Step:
    """One step of the recurrence on a local volume's blocks.

    Args:
        part: the global volume on these blocks.
        least: of a local volume's weight; most: cap on n.
    """

    def __init__(self, part: LatentVolume, local: LocalVolume, least: float, most: float) -> None:
        self.among, self.state, self.count, self.local = local.slots, part.rows.contiguous(), part.count, local.rows.contiguous()
        self.raw, self.weight, self.seen = local.raw.contiguous(), local.weight, local.count
        self.least, self.most = least, float(most)
        self.channels = self.state.shape[1]
        self.rows = local.slots.shape[0] * VOXELS
        self._sizes = {"CHANNELS": self.channels, "WIDE": power_of_two(self.channels), "BLOCK": BLOCK}
        self._grid = (pieces(self.rows + 1, BLOCK),)

    def average(self) -> tuple[Tensor, Tensor]:
        """(M · 512 + 1, C) the weighted running mean of the local volumes, and (M · 512,) weights so far."""
        out, count, rows = torch.empty_like(self.state), torch.empty_like(self.count), self.count.shape[0]
        given = self.state, self.count, self.local, self.weight, self.seen
        _average[(pieces(rows + 1, BLOCK),)](*given, out, count, rows, self.least, self.most, **self._sizes)
        return out, count

    def beside(self, kind: torch.dtype) -> tuple[Tensor, Tensor]:
        """(M' · 512 + 1, 2C) [H, V] in the numbers that convolutions compute in, and (M' · 512,) bool, the voxels of the local volume."""
        both = self.state.new_empty((self.rows + 1, 2 * self.channels), dtype=kind)
        inside = self.state.new_empty(self.rows, dtype=torch.bool)
        self._beside(both, both, inside, False)
        return both, inside

    def forget(self, gates: Tensor, both: Tensor) -> None:
        """[H, V] → [r ∘ H, V], in place; `gates` (M' · 512 + 1, 2C): M_z's, then M_r's."""
        self._beside(gates, both, both, True)

    def _beside(self, gates: Tensor, both: Tensor, inside: Tensor, forget: bool) -> None:
        given = self.among, self.state, self.count, self.local, self.seen
        _beside[self._grid](*given, gates, both, inside.view(torch.uint8), self.rows, FORGET=forget, **self._sizes)

    def update(self, gates: Tensor, candidate: Tensor, channel: int, change: float, rows: Tensor) -> None:
        """H' into `rows` (M · 512 + 1, C), in place; see `numba.gru.Step.update`."""
        given = self.among, self.state, self.count, self.raw, self.weight, self.seen
        _step[self._grid](*given, gates, candidate, rows, self.rows, self.least, self.most, channel, change, **self._sizes)
