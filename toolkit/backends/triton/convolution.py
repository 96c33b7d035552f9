# mypy: disable-error-code="no-untyped-def,untyped-decorator,misc"
"""The block-sparse 3×3×3 convolution on CUDA in one launch, which reads neighbours where they lie (`block_conv.py` in tensors)."""

from __future__ import annotations

import torch
import triton.language as tl
from torch import Tensor

from fieldfuse.backends.constants import VOXELS
from fieldfuse.backends.triton.launch import kernel, pieces, power_of_two

TILE = 128  # voxels of a block at a time: two of its layers …
SLOPES = 64  # … and where the kernel's gradient is summed


def _wide(channels: int) -> int:
    """As many as a product of matrices takes at least."""
    return max(16, power_of_two(channels))


@kernel("rows", "around", "taps", "out")
def _convolve(
    rows, around, taps, bias, occupied, out, blocks, biased, masked, floor,
    CIN: tl.constexpr, COUT: tl.constexpr, BIN: tl.constexpr, BOUT: tl.constexpr, GROUPS: tl.constexpr, TILE: tl.constexpr,
):  # fmt: skip
    parts: tl.constexpr = 512 // TILE
    block, group = tl.program_id(0) // parts, tl.program_id(1)
    voxel = (tl.program_id(0) % parts) * TILE + tl.arange(0, TILE)
    z, y, x = voxel // 64, (voxel // 8) % 8, voxel % 8
    c, o = tl.arange(0, BIN), tl.arange(0, BOUT)
    rows += group * CIN
    taps += group * (27 * CIN * COUT)
    total = tl.zeros((TILE, BOUT), tl.float32)
    for tap in range(27):
        nz, ny, nx = z + tap // 9 + 7, y + (tap // 3) % 3 + 7, x + tap % 3 + 7  # of the 3 × 3 × 3 blocks, 0 to 23
        slot = tl.load(around + block * 27 + (nz // 8 * 3 + ny // 8) * 3 + nx // 8)
        row = slot * 512 + (nz % 8 * 8 + ny % 8) * 8 + nx % 8
        there = (slot >= 0)[:, None] & (c < CIN)[None, :]
        values = tl.load(rows + row[:, None] * (GROUPS * CIN) + c[None, :], there, 0.0)
        values = tl.maximum(values, floor).to(rows.dtype.element_ty)
        weight = tl.load(taps + (tap * CIN + c[:, None]) * COUT + o[None, :], (c < CIN)[:, None] & (o < COUT)[None, :], 0.0)
        total = tl.dot(values, weight, total, input_precision="tf32x3")
    total += tl.load(bias + group * COUT + o, (o < COUT) & (biased != 0), 0.0).to(tl.float32)[None, :]
    place = tl.cast(block, tl.int64) * 512 + voxel
    kept = tl.load(occupied + place, (voxel < 512) & (masked != 0), 1) != 0
    total = tl.where(kept[:, None], total, 0.0)
    out += group * COUT + o[None, :]
    tl.store(out + place[:, None] * (GROUPS * COUT), total.to(out.dtype.element_ty), (o < COUT)[None, :] & (voxel < 512)[:, None])
    # The zero row, written by the first program.
    last = tl.cast(blocks, tl.int64) * 512 + voxel
    nothing = tl.zeros((TILE, BOUT), out.dtype.element_ty)
    first = (tl.program_id(0) == 0) & (voxel == 0)
    tl.store(out + last[:, None] * (GROUPS * COUT), nothing, (o < COUT)[None, :] & first[:, None])


def taps_of(*weights: Tensor) -> Tensor:
    """Kernels (C', C, 3, 3, 3) of a group each, all of one shape → (groups, 27, C, C'), as the convolution reads them."""
    return torch.stack([weight.permute(2, 3, 4, 1, 0).flatten(0, 2) for weight in weights])


def convolve(
    rows: Tensor, around: Tensor, taps: Tensor, bias: Tensor | None, occupied: Tensor | None, relu: bool = False
) -> Tensor:
    """Convolve rows of blocks, groups of channels each by themselves.

    Args:
        rows: (M · 512 or more, groups · C); what lies beyond the blocks' own is not read.
        around: (M, 27) int64, `Topology.around`.
        taps: (groups, 27, C, C') of `taps_of`; bias: (groups · C',); both of the rows' type.
        occupied: (M · 512,) bool; None: every voxel.
        relu: of the rows, before.

    Returns:
        (M · 512 + 1, groups · C'), zero at unoccupied voxels and in the last row.
    """
    groups, _, inside, outside = taps.shape
    blocks = around.shape[0]
    if not blocks:
        return rows.new_zeros((1, groups * outside))
    out = rows.new_empty((blocks * VOXELS + 1, groups * outside))
    mask = around.view(torch.uint8) if occupied is None else occupied.view(torch.uint8)
    _convolve[(blocks * (VOXELS // TILE), groups)](
        rows.contiguous(), around, taps, taps if bias is None else bias, mask,
        out, blocks, int(bias is not None), int(occupied is not None), 0.0 if relu else -3e38,
        CIN=inside, COUT=outside, BIN=_wide(inside), BOUT=_wide(outside), GROUPS=groups, TILE=TILE,
    )  # fmt: skip
    return out


@kernel("rows", "around", "gradient", "out")
def _weigh(
    rows, around, gradient, out, blocks, share,
    CIN: tl.constexpr, COUT: tl.constexpr, BIN: tl.constexpr, BOUT: tl.constexpr, TILE: tl.constexpr,
):  # fmt: skip
    """Products of what lies at one of the 27 places beside voxels with their gradients, summed over a share of the blocks."""
    tap, part = tl.program_id(0), tl.program_id(1)
    c, o = tl.arange(0, BIN), tl.arange(0, BOUT)
    total = tl.zeros((BIN, BOUT), tl.float32)
    tile = part * share * (512 // TILE)
    last = tl.minimum((part + 1) * share, blocks) * (512 // TILE)
    while tile < last:
        block = tile // (512 // TILE)
        voxel = (tile % (512 // TILE)) * TILE + tl.arange(0, TILE)
        nz, ny, nx = voxel // 64 + tap // 9 + 7, (voxel // 8) % 8 + (tap // 3) % 3 + 7, voxel % 8 + tap % 3 + 7
        slot = tl.load(around + block * 27 + (nz // 8 * 3 + ny // 8) * 3 + nx // 8)
        row = slot * 512 + (nz % 8 * 8 + ny % 8) * 8 + nx % 8
        values = tl.load(rows + row[None, :] * CIN + c[:, None], (slot >= 0)[None, :] & (c < CIN)[:, None], 0.0)
        place = tl.cast(block, tl.int64) * 512 + voxel
        slopes = tl.load(gradient + place[:, None] * COUT + o[None, :], (o < COUT)[None, :] & (voxel < 512)[:, None], 0.0)
        total = tl.dot(values, slopes, total, input_precision="tf32x3")
        tile += 1
    at = ((part * 27 + tap) * CIN + c[:, None]) * COUT + o[None, :]
    tl.store(out + at, total, (c < CIN)[:, None] & (o < COUT)[None, :])


def weight_gradient(rows: Tensor, around: Tensor, gradient: Tensor) -> Tensor:
    """(C', C, 3, 3, 3) float32, from rows (M · 512 or more, C) and the result's gradient (M · 512 or more, C'), of one type."""
    blocks, inside, outside = len(around), rows.shape[1], gradient.shape[1]
    parts = max(1, min(32, blocks // 4))
    share = pieces(blocks, parts)
    out = rows.new_empty((parts, 27, inside, outside), dtype=torch.float32)
    _weigh[(27, parts)](
        rows.contiguous(), around, gradient.contiguous(), out, blocks, share,
        CIN=inside, COUT=outside, BIN=_wide(inside), BOUT=_wide(outside),
        TILE=SLOPES,
    )  # fmt: skip
    return out.sum(0).view(3, 3, 3, inside, outside).permute(4, 3, 0, 1, 2).contiguous()
