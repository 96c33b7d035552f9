"""Trilinear lookup through the halo index, forward and by-hand backward, on block rows. Torch only."""

from __future__ import annotations

import torch
import torch.nn.functional as F

from fieldfuse.volume.topology import BLOCK, VOXELS, Topology

Tensor = torch.Tensor
SIDE = BLOCK + 1
_OFFSETS = [(z * SIDE + y) * SIDE + x for z in (0, 1) for y in (0, 1) for x in (0, 1)]


def corners(topology: Topology, cell: Tensor, inside: Tensor) -> tuple[Tensor, Tensor]:
    """The eight lattice corners of voxels.

    Args:
        cell: (N,) int64 rows of the voxels (their lower corners).
        inside: (N, 3) place within the voxel, 0 … 1, (x, y, z).

    Returns:
        (N, 8) int32 rows into value arrays (`topology.zero_row` where a corner's block is absent) and (N, 8) weights that sum to 1.
    """
    slot = cell.div(VOXELS, rounding_mode="floor")
    local = cell - slot * VOXELS
    z, y, x = local >> 6, (local >> 3) & 7, local & 7
    base = slot * SIDE**3 + (z * SIDE + y) * SIDE + x
    offsets = torch.tensor(_OFFSETS, device=cell.device)
    rows = topology.lookup_rows.view(-1)[base[:, None] + offsets]
    fx, fy, fz = inside.unbind(1)
    wx = torch.stack([1 - fx, fx], 1)
    wy = torch.stack([1 - fy, fy], 1)
    wz = torch.stack([1 - fz, fz], 1)
    weights = (wz[:, :, None, None] * wy[:, None, :, None] * wx[:, None, None, :]).reshape(-1, 8)
    return rows, weights


def gather(values: Tensor, rows: Tensor, weights: Tensor) -> Tensor:
    """(R, C) or (R,) values → (N, C) or (N,) weighted sums over the corners. Differentiable, but `scatter` is far cheaper."""
    if values.ndim == 1:
        return (values[rows] * weights).sum(1)
    return F.embedding_bag(rows, values, mode="sum", per_sample_weights=weights)


def scatter(rows: Tensor, weights: Tensor, gradients: tuple[Tensor, ...]) -> tuple[Tensor, list[Tensor]]:
    """The transpose of `gather`, for the rows that are touched only.

    Entries are sorted by row, so that each row's gradient is one bag of weighted samples: four times faster than `index_add_`, no
    buffer as large as the volume, and the same sums in the same order every time.

    Args:
        rows, weights: (N, 8) from `corners`.
        gradients: (N,) or (N, C) each, gradients of what was gathered.

    Returns:
        (U,) int64 ascending rows, and for each gradient its (U,) or (U, C) share.
    """
    ordered, order = torch.sort(rows.reshape(-1))
    touched, counts = torch.unique_consecutive(ordered, return_counts=True)
    starts = torch.cumsum(counts, 0) - counts
    sample, weight = order >> 3, weights.reshape(-1)[order]
    out = []
    for gradient in gradients:
        table = gradient[:, None] if gradient.ndim == 1 else gradient
        share = F.embedding_bag(sample, table, starts, mode="sum", per_sample_weights=weight)
        out.append(share[:, 0] if gradient.ndim == 1 else share)
    return touched.long(), out
