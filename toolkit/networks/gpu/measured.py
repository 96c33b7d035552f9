# mypy: disable-error-code="no-untyped-def,untyped-decorator,misc"
"""What pictures say and a sensor measured, and the table of it, in one launch on CUDA (`sweep.measured`): it is large, at all pixels."""

from __future__ import annotations

from collections.abc import Sequence

import triton.language as tl
from torch import Tensor

from fieldfuse.backends.triton.launch import kernel, pieces
from fieldfuse.networks.gpu import matching
from fieldfuse.networks.gpu.matching import corners, table_of


@kernel("likely", "inverses", "out")
def _measured(
    likely, inverses, depth, out, tall, wide, height, width, planes, rows, columns, upper, left, down, across, step, noise, trust,
    window: tl.constexpr, BP: tl.constexpr, BD: tl.constexpr,
):  # fmt: skip
    p = tl.program_id(0) * BP + tl.arange(0, BP)
    d = tl.arange(0, BD)
    pixels = height * width
    some, is_plane = p < pixels, d < planes
    inside = some[:, None] & is_plane[None, :]
    y, x = p // width, p % width
    row, column = (upper + (y + 0.5) * down).to(tl.int32), (left + (x + 0.5) * across).to(tl.int32)
    here = tl.load(depth + tl.minimum(row, rows - 1) * columns + tl.minimum(column, columns - 1), some, 0.0)
    known = (here > 0) & (here < float("inf"))
    inverse = 1 / tl.where(known, here, 1.0)
    inverse = tl.minimum(tl.maximum(inverse, tl.load(inverses)), tl.load(inverses + planes - 1))
    apart = (tl.load(inverses + d, is_plane, 0.0)[None, :] - inverse[:, None]) / tl.maximum(noise * inverse, 0.7 * step)[:, None]
    along = tl.where(is_plane[None, :], -0.5 * apart * apart, -float("inf"))
    near = tl.exp(along - tl.max(along, 1)[:, None])
    near = near / tl.sum(near, 1)[:, None]
    one, two, three, four, of_one, of_two, of_three, of_four = corners((x + 0.5) / width * 2 - 1, (y + 0.5) / height * 2 - 1, tall, wide)
    told = tl.load(likely + one[:, None] * planes + d[None, :], inside, 0.0) * of_one[:, None]
    told += tl.load(likely + two[:, None] * planes + d[None, :], inside, 0.0) * of_two[:, None]
    told += tl.load(likely + three[:, None] * planes + d[None, :], inside, 0.0) * of_three[:, None]
    told += tl.load(likely + four[:, None] * planes + d[None, :], inside, 0.0) * of_four[:, None]
    told = tl.where(known[:, None], trust * near + (1 - trust) * told, told)
    table_of(tl.where(inside, told, 0.0), out, p.to(tl.int64), d, pixels, planes, step, window, BP, BD)


def measured(
    likely: Tensor, inverses: Tensor, depth: Tensor, shape: Sequence[int], spans: Sequence[tuple[float, float]], step: float, noise: float,
    trust: float, peak: int,
) -> Tensor:  # fmt: skip
    """`matching.table` (3, D, h', w') of what `sweep.measured` gives.

    Args:
        likely: (D, h, w) likelihoods of planes (D,), evenly spaced.
        depth: (H, W).
        shape: h' and w'.
        spans: from which row of the depth on, and how many of them, are asked; and the same of columns.
    """
    volume, depth = matching.rows(likely), depth.contiguous()
    tall, wide, planes = volume.shape
    height, width = shape
    out = volume.new_empty((height, width, planes, 3))
    (upper, down), (left, across) = spans
    _measured[(pieces(height * width, matching.PIXELS),)](
        volume, inverses, depth, out, tall, wide, height, width, planes, *depth.shape, float(upper), float(left), down / height,
        across / width, step, noise, trust, window=matching.window_of(peak, planes), BP=matching.PIXELS, BD=matching.wide(planes),
    )  # fmt: skip
    return out.permute(3, 2, 0, 1)
