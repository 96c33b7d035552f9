# mypy: disable-error-code="no-untyped-def,untyped-decorator,misc"
"""What is done with the rows of local and global volumes between and within the networks on CUDA, a launch each."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from fieldfuse.backends.constants import CHANGE, INSIDE, VOXELS
from fieldfuse.backends.triton.launch import kernel, pieces, power_of_two

if TYPE_CHECKING:
    from fieldfuse.volume.topology import Topology

BLOCK = 64  # rows at a time


@triton.jit
def tanh(x):
    return 2 / (1 + tl.exp(-2 * tl.minimum(tl.maximum(x, -15.0), 15.0))) - 1


@kernel("start", "learned", "raw", "out")
def _settle(
    start, learned, busy, raw, out, rows, held, change, CHANNELS: tl.constexpr, WIDE: tl.constexpr, BLOCK: tl.constexpr
):  # fmt: skip
    n = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    c = tl.arange(0, WIDE)[None, :]
    slot = tl.load(busy + n // 512, n < rows, -1)
    mask = (n <= rows)[:, None] & (c < CHANNELS)
    at = n[:, None] * CHANNELS + c
    of = (slot.to(tl.int64) * 512 + n % 512)[:, None] * CHANNELS + c
    added = tl.load(learned + of, mask & (slot >= 0)[:, None], 0.0).to(tl.float32)
    added = tl.where(c == held, change * tanh(added / change), added)
    value = tl.where((n < rows)[:, None], tl.load(start + at, mask, 0.0) + added, 0.0)
    tl.store(raw + at, value, mask)
    tl.store(out + at, tanh(value), mask)


def settle(start: Tensor, learned: Tensor, busy: Tensor) -> tuple[Tensor, Tensor]:
    """A local volume's rows before and after tanh, (F · 512 + 1, C), from `start` and what the networks add in busy blocks.

    Args:
        start: (F · 512 + 1, C).
        learned: (B · 512 + 1, C).
        busy: (F,) int32 slot of each block among the busy ones, −1 where it is not.
    """
    raw, out = torch.empty_like(start), torch.empty_like(start)
    rows, channels = busy.shape[0] * VOXELS, start.shape[1]
    sizes = {"CHANNELS": channels, "WIDE": power_of_two(channels), "BLOCK": BLOCK}
    _settle[(pieces(rows + 1, BLOCK),)](start, learned, busy, raw, out, rows, INSIDE, CHANGE, **sizes)
    return raw, out


@kernel("before", "after", "out")
def _merge(
    before, before_count, after, after_count, changed, out, out_count, rows, CHANNELS: tl.constexpr, WIDE: tl.constexpr, BLOCK: tl.constexpr
):  # fmt: skip
    n = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    c = tl.arange(0, WIDE)[None, :]
    new = tl.load(changed + n, n < rows, 0) != 0
    mask = (n <= rows)[:, None] & (c < CHANNELS)
    at = n[:, None] * CHANNELS + c
    value = tl.load(before + at, mask & (n < rows)[:, None] & (~new)[:, None], 0.0) + tl.load(after + at, mask & new[:, None], 0.0)
    tl.store(out + at, value, mask)
    count = tl.load(before_count + n, (n < rows) & (~new), 0.0) + tl.load(after_count + n, new, 0.0)
    tl.store(out_count + n, count, n < rows)


def merge(before: Tensor, before_count: Tensor, after: Tensor, after_count: Tensor, changed: Tensor) -> tuple[Tensor, Tensor]:
    """Rows (M · 512 + 1, C) and counts (M · 512,) after where `changed` (M · 512,) bool, else before."""
    out, count = torch.empty_like(before), torch.empty_like(before_count)
    rows, channels = count.shape[0], before.shape[1]
    sizes = {"CHANNELS": channels, "WIDE": power_of_two(channels), "BLOCK": BLOCK}
    _merge[(pieces(rows + 1, BLOCK),)](
        before, before_count, after, after_count, changed.view(torch.uint8), out, count, rows, **sizes
    )
    return out, count


@kernel("latent", "weight")
def _solid(
    latent, count, weight, bias, density, added, steep, out, rows, start, scale, change, inside, least,
    CHANNELS: tl.constexpr, WIDE: tl.constexpr, HIDDEN: tl.constexpr, LAYER: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Corners that are known and of which a voxel is not see-through (`FieldHead.thickness`)."""
    n = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    c, h = tl.arange(0, WIDE), tl.arange(0, LAYER)
    some = n < rows
    values = tl.load(latent + n[:, None] * CHANNELS + c[None, :], some[:, None] & (c < CHANNELS)[None, :], 0.0)
    layer = tl.load(weight + h[None, :] * CHANNELS + c[:, None], (h < HIDDEN)[None, :] & (c < CHANNELS)[:, None], 0.0)
    hidden = tl.dot(values, layer, input_precision="tf32x3") + tl.load(bias + h, h < HIDDEN, 0.0)[None, :]
    learned = tl.sum(tl.maximum(hidden, 0.0) * tl.load(density + h, h < HIDDEN, 0.0)[None, :], 1) + tl.load(added)
    learned = change * tanh(learned / change)
    signed = tl.sum(tl.where((c == inside)[None, :], values, 0.0), 1)
    thickness = start + scale * (learned + tl.load(steep) * signed)
    known = tl.load(count + n, some, 0.0) > 0
    tl.store(out + n, (known & (thickness >= least)).to(tl.uint8), some)


@kernel("around", "out")
def _surface(count, solid, seen, around, out):
    """Cells of one block with eight known corners, one of them solid and one of them seen."""
    block = tl.program_id(0)
    voxel = tl.arange(0, 512)
    z, y, x = voxel // 64, (voxel // 8) % 8, voxel % 8
    whole = tl.full((512,), 1, tl.int32)
    thick, looked = tl.zeros((512,), tl.int32), tl.zeros((512,), tl.int32)
    for k in range(8):
        nz, ny, nx = z + k // 4, y + (k // 2) % 2, x + k % 2
        slot = tl.load(around + block * 27 + ((nz // 8 + 1) * 3 + ny // 8 + 1) * 3 + nx // 8 + 1)
        row = slot * 512 + (nz % 8 * 8 + ny % 8) * 8 + nx % 8
        whole = whole & (tl.load(count + row, slot >= 0, 0.0) > 0).to(tl.int32)
        thick = thick | tl.load(solid + row, slot >= 0, 0).to(tl.int32)
        looked = looked | tl.load(seen + row, slot >= 0, 0).to(tl.int32)
    tl.store(out + block.to(tl.int64) * 512 + voxel, (whole & thick & looked).to(tl.uint8))


def surface_cells(topology: Topology, rows: Tensor, count: Tensor, seen: Tensor, head: Any, least: float) -> Tensor:
    """`two_lattices.surface_cells` of a head's thickness.

    Args:
        rows, count: (M · 512 + 1, C) and (M · 512,) of the volume.
        seen: (M · 512,) bool, known corners of the local volume.
        head: a `FieldHead`.
        least: logarithm of the optical thickness from which on a voxel is not see-through.

    Returns:
        (M · 512,) bool.
    """
    size, channels, hidden = count.shape[0], rows.shape[1], head.density.in_features
    out = torch.empty(size, dtype=torch.bool, device=rows.device)
    if size:
        solid = torch.empty(size, dtype=torch.uint8, device=rows.device)
        first = head.body[0]
        start, scale, change = head.numbers
        _solid[(pieces(size, BLOCK),)](
            rows, count, first.weight, first.bias, head.density.weight, head.density.bias, head.steep, solid, size, start, scale, change,
            INSIDE, least, CHANNELS=channels, WIDE=max(16, power_of_two(channels)), HIDDEN=hidden,
            LAYER=max(16, power_of_two(hidden)), BLOCK=BLOCK,
        )  # fmt: skip
        _surface[(topology.blocks,)](count, solid, seen.view(torch.uint8), topology.around, out.view(torch.uint8))
    return out


# What the GRU does between its convolutions (`FusionGRU.forward` in tensors).


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

    def __init__(self, part: Any, local: Any, least: float, most: float) -> None:
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
