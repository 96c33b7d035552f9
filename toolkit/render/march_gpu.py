# mypy: disable-error-code="no-untyped-def,untyped-decorator,misc"
"""The coarse steps of rays beyond the region of interest on CUDA, in one launch (`march._coarse_distances` in tensors)."""

from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor

from fieldfuse.backends.triton.launch import kernel

BLOCK = 64


@kernel("out")
def _walk(
    origins, directions, jitter, out, rays, columns, near, step, far, shell, extent, MOST: tl.constexpr, BLOCK: tl.constexpr
):  # fmt: skip
    n = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    some = n < rays
    ox, oy, oz = tl.load(origins + 3 * n, some, 0.0), tl.load(origins + 3 * n + 1, some, 0.0), tl.load(origins + 3 * n + 2, some, 0.0)
    dx, dy = tl.load(directions + 3 * n, some, 1.0), tl.load(directions + 3 * n + 1, some, 0.0)
    dz = tl.load(directions + 3 * n + 2, some, 0.0)
    square = dx * dx + dy * dy + dz * dz
    speed = tl.sqrt(square)
    along = (ox * dx + oy * dy + oz * dz) / square
    cx, cy, cz = ox - dx * along, oy - dy * along, oz - dz * along
    rise = 1 / tl.sqrt(shell * shell + extent * extent * (cx * cx + cy * cy + cz * cz))
    each = step / speed
    distance = near - tl.load(jitter + n, some, 0.0) * each
    tl.store(out + n * columns, distance, some)
    column = 1
    while column < columns:
        x, y, z = tl.abs(ox + dx * distance), tl.abs(oy + dy * distance), tl.abs(oz + dz * distance)
        norm = tl.maximum(tl.maximum(tl.maximum(x, y), z), 1.0)
        stretch = tl.minimum(tl.maximum(norm * norm * rise, 1.0), MOST)
        distance = tl.where(norm > far, distance, distance + stretch * each)
        tl.store(out + n * columns + column, distance, some)
        column += 1


def walk(
    origins: Tensor, directions: Tensor, jitter: Tensor, columns: int, near: float, step: float, far: float, shell: float, extent: float,
    most: float,
) -> Tensor:  # fmt: skip
    """(B, columns) distances along rays (B, 3), normalised; those that have arrived stay where they are."""
    out = origins.new_empty((len(origins), columns))
    if len(origins):
        origins, directions, jitter = origins.contiguous(), directions.contiguous(), jitter.contiguous()
        _walk[(triton.cdiv(len(origins), BLOCK),)](
            origins, directions, jitter, out, len(origins), columns, float(near), step, far, shell, extent, MOST=most, BLOCK=BLOCK
        )
    return out
