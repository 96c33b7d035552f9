"""What the CUDA kernels share: where a place lies, which voxel holds it, which eight rows are its corners.

Written in Triton, which comes with torch for CUDA; a program works on a few rays, one a thread. `march.py` and `volume/lookup.py` are the
reference. Without a GPU the same functions run in Triton's interpreter (`TRITON_INTERPRET=1`), where the tests hold them against it.
"""

from __future__ import annotations

import triton
import triton.language as tl

from fieldfuse.backends.constants import BLOCK, LOOKUP, RAW_MAX, UNITS, VOXELS

# Constants that Triton reads must be marked as such.
C_BLOCK, C_VOXELS, C_LOOKUP, C_SIDE = (tl.constexpr(v) for v in (BLOCK, VOXELS, LOOKUP, BLOCK + 1))
C_RAW_MAX, C_UNITS = tl.constexpr(RAW_MAX), tl.constexpr(UNITS)
LOG2E = tl.constexpr(1.4426950408889634)


@triton.jit
def exp(x):
    """eˣ by the unit that raises 2 to a power."""
    return tl.exp2(x * LOG2E)


@triton.jit
def stopped(tau):
    """1 - exp(-τ), with the digits of thin media."""
    return tl.where(tau < 0.02, tau * (1 - tau * (0.5 - tau * (0.16666667 - tau * 0.041666667))), 1 - exp(-tau))


@triton.jit
def largest(x, y, z):
    """max(|x|, |y|, |z|)."""
    return tl.maximum(tl.maximum(tl.abs(x), tl.abs(y)), tl.abs(z))


@triton.jit
def contract(x, y, z, shell, HAS_SHELL: tl.constexpr):
    """`Space.contract` of a normalised place."""
    if HAS_SHELL:
        norm = tl.maximum(largest(x, y, z), 1.0)
        scale = (1 + shell - shell / norm) / norm
        x, y, z = x * scale, y * scale, z * scale
    return x, y, z


@triton.jit
def bricks_away(skip, x, y, z, extent, per_brick, width):
    """Distance in bricks from a contracted place to the nearest brick that holds something, at most what the table holds."""
    i = tl.minimum(tl.maximum(tl.floor((x + extent) * per_brick).to(tl.int32) + 1, 0), width - 1)
    j = tl.minimum(tl.maximum(tl.floor((y + extent) * per_brick).to(tl.int32) + 1, 0), width - 1)
    k = tl.minimum(tl.maximum(tl.floor((z + extent) * per_brick).to(tl.int32) + 1, 0), width - 1)
    return (k * width + j) * width + i


@triton.jit
def voxel_of(table, x, y, z, extent, per_voxel, top, tx, ty, tz, sx, sy, sz, mask):
    """Row of the voxel about a contracted place, −1 where its block is not there, and the place within it."""
    u = tl.minimum(tl.maximum((x + extent) * per_voxel, 0.0), top)
    v = tl.minimum(tl.maximum((y + extent) * per_voxel, 0.0), top)
    w = tl.minimum(tl.maximum((z + extent) * per_voxel, 0.0), top)
    i, j, k = tl.floor(u), tl.floor(v), tl.floor(w)
    fx, fy, fz = u - i, v - j, w - k
    a, b, c = i.to(tl.int32), j.to(tl.int32), k.to(tl.int32)
    # The table's outermost layer is empty: far blocks are moved there.
    bx = tl.minimum(tl.maximum((a >> 3) - tx, 0), sx - 1)
    by = tl.minimum(tl.maximum((b >> 3) - ty, 0), sy - 1)
    bz = tl.minimum(tl.maximum((c >> 3) - tz, 0), sz - 1)
    slot = tl.load(table + (bz * sy + by) * sx + bx, mask=mask, other=-1)
    row = slot * C_VOXELS + (((c & 7) * C_BLOCK + (b & 7)) * C_BLOCK + (a & 7))
    return tl.where(slot >= 0, row, -1), fx, fy, fz


@triton.jit
def corner(cell, lookup, DX: tl.constexpr, DY: tl.constexpr, DZ: tl.constexpr, mask):
    """Row of one corner of the voxels `cell`: arithmetic within a block, the index of its halo at its far sides."""
    local = cell & (C_VOXELS - 1)
    x, y, z = local & 7, (local >> 3) & 7, local >> 6
    across = ((x + DX) | (y + DY) | (z + DZ)) >= C_BLOCK
    place = (cell // C_VOXELS) * C_LOOKUP + ((z + DZ) * C_SIDE + (y + DY)) * C_SIDE + (x + DX)
    far = tl.load(lookup + place, mask=mask & across, other=0)
    return tl.where(across, far, cell + (DZ * C_BLOCK + DY) * C_BLOCK + DX)


@triton.jit
def share(f, D: tl.constexpr):
    """Trilinear weight along one axis."""
    return f if D == 1 else 1 - f


@triton.jit
def raw_density(density, cell, fx, fy, fz, lookup, mask):
    """Trilinear raw density in voxels `cell`."""
    raw = fx * 0
    for d in tl.static_range(8):
        row = corner(cell, lookup, d & 1, (d >> 1) & 1, d >> 2, mask)
        raw += tl.load(density + row, mask=mask, other=0.0) * share(fx, d & 1) * share(fy, (d >> 1) & 1) * share(fz, d >> 2)
    return raw
