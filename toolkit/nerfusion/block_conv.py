"""Block-sparse 3×3×3 convolution on rows: one gather of each block's 10³ halo, one dense `conv3d`, and the occupancy mask.

Rows stay [voxels, channels] throughout: a halo read as (n, 10, 10, 10, C) is already the channels-last-3d memory that `conv3d` likes,
so nothing is transposed. The input's gradient is the same kind of convolution, with the kernel flipped, on the haloed gradient,
which is exact and needs no scatter.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from fieldfuse.backends import dispatch
from fieldfuse.volume.topology import BLOCK, HALO, VOXELS, Topology

DEFAULT_CHUNK = 64  # blocks at a time: 4 MB of halo at 16 channels in float32
FEW = 4096  # blocks up to which the halo's rows (4 kB a block) are kept for the next convolution on the same topology
_ONES, _ZEROS = [1, 1, 1], [0, 0, 0]
_WHOLE = {2: torch.int16, 4: torch.int32, 8: torch.int64}  # numbers of so many bytes


class BlockConv3d(nn.Module):
    """3×3×3 submanifold convolution: occupied voxels get an output, unoccupied and absent ones count as zero.

    Args:
        in_channels, out_channels: channels of the rows.
        bias: add a learned bias to occupied voxels.
        chunk: blocks at a time, which bounds the memory beyond input and output (chunk · 1000 · channels numbers).

    The kernel has `torch.nn.Conv3d`'s layout (out, in, z, y, x). Kaiming initialisation for a ReLU behind it.
    """

    def __init__(self, in_channels: int, out_channels: int, bias: bool = True, chunk: int = DEFAULT_CHUNK) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(out_channels, in_channels, 3, 3, 3))
        self.bias = nn.Parameter(torch.empty(out_channels)) if bias else None
        self.chunk = chunk
        self._prepared = Prepared()
        nn.init.kaiming_normal_(self.weight, nonlinearity="relu")
        if self.bias is not None:
            nn.init.zeros_(self.bias)

    def forward(self, rows: Tensor, topology: Topology, occupied: Tensor | None = None, relu: bool = False) -> Tensor:
        """See `block_conv3d`."""
        if not torch.is_grad_enabled() and dispatch.can_use_triton(rows, dtypes=dispatch.FLOATS):
            return self._prepared.convolve([[self]], rows, topology, occupied, relu)
        return block_conv3d(rows, topology, self.weight, self.bias, occupied, self.chunk, relu)


Stage = Sequence[BlockConv3d]  # one convolution, or several that go side by side


class Prepared:
    """What convolutions on CUDA without gradients read of layers that follow each other: kernels in the order of their loop, and biases, in
    the numbers that are computed in. Laid out anew when a parameter has changed."""

    def __init__(self) -> None:
        self._key: Any = None
        self._laid: list[tuple[Tensor, Tensor | None]] = []

    def convolve(
        self, stages: Sequence[Stage], rows: Tensor, topology: Topology, occupied: Tensor | None = None, relu: bool = False
    ) -> Tensor:
        """`block_conv3d` of rows (M · 512 + 1, C) by one stage after the other, with a ReLU between them (with `relu` also before), a
        launch each → (M · 512 + 1, C'), one layer's channels after the other's.

        Layers of a stage are alike in shape, and have all a bias or none. Those of the first read the same rows, those of later ones each
        its own part of the channels.
        """
        from fieldfuse.backends.triton import convolution

        numbers, around = computed_in(rows), topology.around
        rows = rows.to(numbers)
        for taps, bias in self._parameters(stages, numbers):
            rows = convolution.convolve(rows, around, taps, bias, occupied, relu)
            relu = True
        return rows

    def _parameters(self, stages: Sequence[Stage], numbers: torch.dtype) -> list[tuple[Tensor, Tensor | None]]:
        from fieldfuse.backends.triton import convolution

        known = [[(one.weight, one.bias) for one in stage] for stage in stages]
        key = [numbers, *[(w.data_ptr(), w._version, b is not None and (b.data_ptr(), b._version)) for stage in known for w, b in stage]]
        if key != self._key:
            self._laid = []
            for stage in known:
                weights: list[Tensor] = [weight for weight, _ in stage]
                biases: list[Tensor] = [bias for _, bias in stage if bias is not None]
                taps = convolution.taps_of(*(weights if self._laid else [torch.cat(weights)]))
                self._laid.append((taps.to(numbers), torch.cat(biases).to(numbers) if biases else None))
            self._key = key
        return self._laid


def computed_in(rows: Tensor) -> torch.dtype:
    """The numbers that autocast computes in, else those of the rows."""
    kind = rows.device.type
    return torch.get_autocast_dtype(kind) if torch.is_autocast_enabled(kind) else rows.dtype


def block_conv3d(
    rows: Tensor,
    topology: Topology,
    weight: Tensor,
    bias: Tensor | None = None,
    occupied: Tensor | None = None,
    chunk: int = DEFAULT_CHUNK,
    relu: bool = False,
) -> Tensor:
    """Convolve block rows; differentiable once in `rows`, `weight` and `bias`. Under autocast it computes in the reduced type.

    Args:
        rows: (M · 512, C) or (M · 512 + 1, C), the last then the zero row. Zero at unoccupied voxels, as every output of this is.
        weight: (C', C, 3, 3, 3).
        bias: (C',).
        occupied: (M · 512,) bool; None: every voxel of every block.
        relu: of the rows, before.

    Returns:
        (M · 512, C') or (M · 512 + 1, C'), zero at unoccupied voxels and in the zero row.

    Raises:
        ValueError: shapes that do not belong together.
    """
    if rows.ndim != 2 or len(rows) - topology.zero_row not in (0, 1) or weight.shape[1:] != (rows.shape[1], 3, 3, 3):
        raise ValueError(f"rows {tuple(rows.shape)} and weight {tuple(weight.shape)} do not fit a topology of {topology.blocks} blocks")
    if occupied is not None and occupied.shape != (topology.zero_row,):
        raise ValueError(f"occupied must have {topology.zero_row} entries, not {tuple(occupied.shape)}")
    if topology.blocks == 0:
        return rows.new_zeros((len(rows), len(weight)))
    result: Tensor = _BlockConv.apply(torch.relu(rows) if relu else rows, weight, bias, occupied, topology, chunk)
    return result


def _haloed(values: Tensor, topology: Topology, start: int, stop: int, buffer: Tensor) -> Tensor:
    """(M · 512 + 1, C) → (n, C, 10, 10, 10) in channels-last-3d memory, written into `buffer`."""
    rows = (topology.halo_rows[start:stop] if topology.blocks <= FEW else topology.halo_chunk(start, stop)).view(-1)
    out = buffer[: len(rows)]
    torch.index_select(values, 0, rows, out=out)
    return out.view(-1, BLOCK + 2, BLOCK + 2, BLOCK + 2, values.shape[1]).permute(0, 4, 1, 2, 3)


def _with_zero_row(rows: Tensor, topology: Topology, kind: torch.dtype) -> Tensor:
    rows = rows.to(kind)
    return rows if len(rows) > topology.zero_row else torch.cat([rows, rows.new_zeros((1, rows.shape[1]))])


def _cubes(rows: Tensor) -> Tensor:
    """(n · 512, C) → (n, C, 8, 8, 8), the same memory."""
    return rows.view(-1, BLOCK, BLOCK, BLOCK, rows.shape[1]).permute(0, 4, 1, 2, 3)


def _clear(rows: Tensor, kept: Tensor) -> None:
    """Set rows that are not kept to zero, in place: by their bits, since a product with a mask takes five times as long in bfloat16."""
    kind = _WHOLE[rows.element_size()]
    rows.view(kind).bitwise_and_(kept.to(kind).neg_()[:, None])


def _convolve(rows: Tensor, weight: Tensor, bias: Tensor | None, topology: Topology, occupied: Tensor | None, chunk: int) -> Tensor:
    """(M · 512 + 1, C) → (M · 512 + 1, C')."""
    if dispatch.can_use_triton(rows, dtypes=dispatch.FLOATS):
        from fieldfuse.backends.triton import convolution

        return convolution.convolve(rows, topology.around, convolution.taps_of(weight), bias, occupied)
    out = rows.new_empty((topology.zero_row + 1, len(weight)))
    out[-1] = 0
    chunk = min(chunk, topology.blocks)
    buffer = rows.new_empty((chunk * HALO, rows.shape[1]))
    weight = weight.contiguous(memory_format=torch.channels_last_3d)
    for start in range(0, topology.blocks, chunk):
        stop = min(start + chunk, topology.blocks)
        part = F.conv3d(_haloed(rows, topology, start, stop, buffer), weight, bias)
        _cubes(out[start * VOXELS : stop * VOXELS]).copy_(part)
    if occupied is not None:
        _clear(out[:-1], occupied)
    return out


class _BlockConv(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, rows: Tensor, weight: Tensor, bias: Tensor | None, occupied: Tensor | None, topology: Topology, chunk: int
    ) -> Tensor:
        ctx.save_for_backward(rows, weight, occupied)
        ctx.topology, ctx.chunk, ctx.kind, ctx.biased = topology, chunk, computed_in(rows), bias is not None
        with torch.autocast(rows.device.type, enabled=False):
            padded = _with_zero_row(rows, topology, ctx.kind)
            bias = bias.to(ctx.kind) if bias is not None else None
            out = _convolve(padded, weight.to(ctx.kind), bias, topology, occupied, chunk)
        return out if len(rows) > topology.zero_row else out[:-1]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        rows, weight, occupied = ctx.saved_tensors
        topology, kind = ctx.topology, ctx.kind
        with torch.autocast(rows.device.type, enabled=False):
            padded = gradient.new_zeros((topology.zero_row + 1, gradient.shape[1]), dtype=kind)
            padded[:-1] = gradient[: topology.zero_row]
            if occupied is not None:
                _clear(padded[:-1], occupied)
            to_rows = to_weight = to_bias = None
            if ctx.needs_input_grad[0]:
                flipped = weight.to(kind).flip(2, 3, 4).transpose(0, 1)
                to_rows = _convolve(padded, flipped, None, topology, None, ctx.chunk)[: len(rows)].to(rows.dtype)
            if ctx.needs_input_grad[1]:
                to_weight = _weight_gradient(_with_zero_row(rows, topology, kind), padded, weight, topology, ctx.chunk)
            if ctx.biased and ctx.needs_input_grad[2]:
                to_bias = padded.sum(0, dtype=weight.dtype)
        return to_rows, to_weight, to_bias, None, None, None


def _weight_gradient(rows: Tensor, gradient: Tensor, weight: Tensor, topology: Topology, chunk: int) -> Tensor:
    """(C', C, 3, 3, 3) in the weight's type, summed over chunks in it."""
    if dispatch.can_use_triton(rows, dtypes=dispatch.FLOATS):
        from fieldfuse.backends.triton import convolution

        return convolution.weight_gradient(rows, topology.around, gradient).to(weight.dtype)
    total = torch.zeros_like(weight, memory_format=torch.contiguous_format)
    shaped = weight.to(rows.dtype).contiguous(memory_format=torch.channels_last_3d)
    chunk = min(chunk, topology.blocks)
    buffer = rows.new_empty((chunk * HALO, rows.shape[1]))
    for start in range(0, topology.blocks, chunk):
        stop = min(start + chunk, topology.blocks)
        cubes = _cubes(gradient[start * VOXELS : stop * VOXELS])
        halo = _haloed(rows, topology, start, stop, buffer)
        parts = torch.ops.aten.convolution_backward(cubes, halo, shaped, None, _ONES, _ZEROS, _ONES, False, _ZEROS, 1, [False, True, False])
        total += parts[1]
    return total
