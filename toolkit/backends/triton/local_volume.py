# mypy: disable-error-code="no-untyped-def,untyped-decorator,misc"
"""A key frame's local volume on CUDA without gradients (`NerfusionModel.local_volume` in tensors): the device is waited for once, for how
many corners it sees and in which blocks; all else is decided by the processor, which has the blocks' keys, or happens behind it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import triton
import triton.language as tl
from torch import Tensor

from fieldfuse.backends.dispatch import to_device_async
from fieldfuse.backends.triton.depth_reading import estimate, local
from fieldfuse.backends.triton.feature_lookup import corners
from fieldfuse.backends.triton.launch import kernel, pieces, power_of_two
from fieldfuse.backends.triton.volumes import settle

BLOCK = 32
PART = 128  # corners of a block that are looked at at once


@triton.jit
def _corner(row, keys, voxel, extent, half, cx, cy, cz, shell, some, SHELL: tl.constexpr):
    """Contracted and working places of lattice corners, and the length of a voxel there."""
    slot, inner = row // 512, (row % 512).to(tl.int32)
    u = (tl.load(keys + 3 * slot, some, 0) * 8 + inner % 8).to(tl.float32) * voxel - extent
    v = (tl.load(keys + 3 * slot + 1, some, 0) * 8 + (inner // 8) % 8).to(tl.float32) * voxel - extent
    w = (tl.load(keys + 3 * slot + 2, some, 0) * 8 + inner // 64).to(tl.float32) * voxel - extent
    x, y, z, size = u, v, w, tl.zeros_like(u) + voxel * half
    if SHELL:
        norm = tl.maximum(tl.maximum(tl.abs(u), tl.abs(v)), tl.abs(w))
        beyond = norm > 1
        outer = shell / tl.maximum(1 + shell - norm, 1e-4)
        grown = tl.where(beyond, outer / tl.maximum(norm, 1e-12), 1.0)
        x, y, z, size = x * grown, y * grown, z * grown, size * grown
    return u, v, w, x * half + cx, y * half + cy, z * half + cz, size


@triton.jit
def _seen(x, y, z, size, poses, lenses, sizes, view, near, far):
    """Pixel, visibility and footprint of places in a view (`unproject.project`)."""
    x, y, z = local(x, y, z, poses + 16 * view)
    fx, fy = tl.load(lenses + 4 * view), tl.load(lenses + 4 * view + 1)
    deep = (z > near) & (z <= far)
    z = tl.where(deep, z, 1.0)
    u, v = x / z * fx + tl.load(lenses + 4 * view + 2), y / z * fy + tl.load(lenses + 4 * view + 3)
    footprint = size * (0.5 * (fx + fy)) / z
    visible = deep & (u >= -footprint) & (v >= -footprint)
    visible = visible & (u <= tl.load(sizes + 2 * view) + footprint) & (v <= tl.load(sizes + 2 * view + 1) + footprint)
    return tl.where(visible, u, 0.0), tl.where(visible, v, 0.0), visible, tl.where(visible, footprint, 1.0)


@kernel("keys", "table", "rows")
def _choose(
    wanted, keys, poses, lenses, sizes, table, rows, found, count, height, width, planes, lowest, step,
    voxel, extent, half, cx, cy, cz, shell, bx, by, bz, near, far, truncation, hidden, free,
    ALL: tl.constexpr, SHELL: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Corners that the key frame sees and that are not for sure hidden, and what there is in each part of a block."""
    n = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    some = n < count
    if not ALL:
        some = some & (tl.load(wanted + n, some, 0) != 0)
    u, v, w, x, y, z, size = _corner(n, keys, voxel, extent, half, cx, cy, cz, shell, some, SHELL)
    _, _, seen, _ = _seen(x, y, z, size, poses, lenses, sizes, 0, near, far)
    if not SHELL:
        seen = seen & (tl.abs(u) <= bx) & (tl.abs(v) <= by) & (tl.abs(w) <= bz)
    signed, clear, _ = estimate(x, y, z, truncation * size, table, poses, lenses, sizes, height, width, planes, lowest, step, some)
    chosen = seen & (clear > hidden) & some
    kept = chosen.to(tl.int32)
    busy = tl.max((chosen & (signed < free)).to(tl.int32), 0)
    tl.store(found + 1 + tl.program_id(0), tl.max(kept, 0) + 2 * busy)
    first = tl.atomic_add(found, tl.sum(kept, 0))
    tl.store(rows + first + tl.cumsum(kept, 0) - 1, n, chosen)


@triton.jit
def _fetch(table, corner, right, below, w0, w1, w2, w3, mask, CHANNELS: tl.constexpr, WIDE: tl.constexpr):
    """Bilinear rows (BLOCK, WIDE)."""
    c = tl.arange(0, WIDE)[None, :]
    here = mask[:, None] & (c < CHANNELS)
    at = table + corner[:, None] * CHANNELS + c
    value = tl.load(at, here, 0.0) * w0[:, None] + tl.load(at + right[:, None] * CHANNELS, here, 0.0) * w1[:, None]
    value += tl.load(at + below[:, None] * CHANNELS, here, 0.0) * w2[:, None]
    return value + tl.load(at + (right + below)[:, None] * CHANNELS, here, 0.0) * w3[:, None]


@triton.jit
def _projected(
    mean, variance, several, weight, first, whole,
    INPUTS: tl.constexpr, CHANNELS: tl.constexpr, WIDE: tl.constexpr, HIDDEN: tl.constexpr,
):  # fmt: skip
    """What a group of channels (BLOCK, WIDE), whose first one is `first` of `whole`, adds to the local network's first rows."""
    c, h = tl.arange(0, WIDE)[:, None], tl.arange(0, HIDDEN)[None, :]
    here = c < CHANNELS
    at = weight + h * INPUTS + first + c
    squashed = variance / (1 + variance) * several[:, None]
    logarithm = (tl.log(variance + 1e-4) / 4 + 1) * several[:, None]
    out = tl.dot(mean, tl.load(at, here, 0.0), input_precision="tf32x3")
    out = tl.dot(squashed, tl.load(at + whole, here, 0.0), out, input_precision="tf32x3")
    return tl.dot(logarithm, tl.load(at + 2 * whole, here, 0.0), out, input_precision="tf32x3")


@triton.jit
def _atanh(x):
    x = tl.minimum(tl.maximum(x, -0.93), 0.93)
    return 0.5 * tl.log((1 + x) / (1 - x))


@kernel("rows", "keys", "table", "latent", "start", "counts", "weights")
def _observe(
    rows, keys, slots, poses, lenses, sizes, table, pictures, weight, bias, latent, start, counts, weights, shown_at, channels, blocks,
    views_of, count, height, width, planes, lowest, step, voxel, extent, half, cx, cy, cz, shell, near, far, truncation, hidden, blind,
    tall, wide, levels, down, across, fine_levels, part, gain,
    SHELL: tl.constexpr, VARIANCE: tl.constexpr, CHANNELS: tl.constexpr, WIDE: tl.constexpr, SAMPLED: tl.constexpr,
    STRIDE: tl.constexpr, FINE: tl.constexpr, HIDDEN: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """All that is known of corners, into rows of the blocks that are kept: projected evidence where a block is busy, what latents start
    from, how many views see them, and how much that weighs."""
    n = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    some = n < count
    row = tl.load(rows + n, some, 0)
    _, _, _, x, y, z, size = _corner(row, keys, voxel, extent, half, cx, cy, cz, shell, some, SHELL)
    signed, clear, sure = estimate(x, y, z, truncation * size, table, poses, lenses, sizes, height, width, planes, lowest, step, some)
    # How many views see it, how large it is there, and how far their directions lie apart.
    views, mark = tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32)
    mx, my, mz = tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32)
    k = 0
    while k < views_of:  # not unrolled: compiling that takes a quarter of a minute
        _, _, visible, footprint = _seen(x, y, z, size, poses, lenses, sizes, k, near, far)
        dx, dy, dz = x - tl.load(poses + 16 * k + 3), y - tl.load(poses + 16 * k + 7), z - tl.load(poses + 16 * k + 11)
        length = tl.maximum(tl.sqrt(dx * dx + dy * dy + dz * dz), 1e-12)
        views += visible.to(tl.float32)
        mark += tl.where(visible, tl.log(footprint), 0.0)
        mx += tl.where(visible, dx / length, 0.0)
        my += tl.where(visible, dy / length, 0.0)
        mz += tl.where(visible, dz / length, 0.0)
        k += 1
    share = 1 / tl.maximum(views, 1.0)
    mx, my, mz = mx * share, my * share, mz * share
    apart = tl.zeros((BLOCK,), tl.float32)
    k = 0
    while k < views_of:
        _, _, visible, _ = _seen(x, y, z, size, poses, lenses, sizes, k, near, far)
        dx, dy, dz = x - tl.load(poses + 16 * k + 3), y - tl.load(poses + 16 * k + 7), z - tl.load(poses + 16 * k + 11)
        length = tl.maximum(tl.sqrt(dx * dx + dy * dy + dz * dz), 1e-12)
        gx, gy, gz = dx / length - mx, dy / length - my, dz / length - mz
        apart += tl.where(visible, (gx * gx + gy * gy + gz * gz) * share, 0.0)
        k += 1
    footprint_mean = tl.exp(mark * share)
    move = footprint_mean * tl.sqrt(tl.where(views == 1, 0.0, apart))
    several = (views >= 2).to(tl.float32)
    # Mean, then variance, of what they show.
    mean, deep = tl.zeros((BLOCK, WIDE), tl.float32), tl.zeros((BLOCK, WIDE), tl.float32)
    fine, fine_deep = tl.zeros((BLOCK, 16), tl.float32), tl.zeros((BLOCK, 16), tl.float32)
    whole, whole_deep = tl.zeros((BLOCK, 16), tl.float32), tl.zeros((BLOCK, 16), tl.float32)
    k = 0
    while k < 2 * views_of:
        view = k % views_of
        px, py, visible, footprint = _seen(x, y, z, size, poses, lenses, sizes, view, near, far)
        visible = visible & some
        each = tl.where(visible, share, 0.0)[:, None]
        corner, right, below, w0, w1, w2, w3 = corners(px, py, move, tall, wide, levels, STRIDE)
        features = tl.load(pictures + 2 * view).to(tl.pointer_type(tl.float32))
        colours = tl.load(pictures + 2 * view + 1).to(tl.pointer_type(tl.float32))
        if CHANNELS % 4 == 0:
            features = tl.multiple_of(features, 16)
        shown = _fetch(features, corner, right, below, w0, w1, w2, w3, visible, CHANNELS, WIDE)
        corner, right, below, w0, w1, w2, w3 = corners(px, py, move, down, across, fine_levels, FINE)
        shown_fine = _fetch(colours, corner, right, below, w0, w1, w2, w3, visible, 3, 16)
        corner, right, below, w0, w1, w2, w3 = corners(px, py, part * footprint, down, across, fine_levels, FINE)
        shown_whole = _fetch(colours, corner, right, below, w0, w1, w2, w3, visible, 3, 16)
        if k < views_of:
            mean += shown * each
            fine += shown_fine * each
            whole += shown_whole * each
        else:
            deep += (shown - mean) * (shown - mean) * each
            fine_deep += (shown_fine - fine) * (shown_fine - fine) * each
            whole_deep += (shown_whole - whole) * (shown_whole - whole) * each
        k += 1
    kept = (views != 1)[:, None] & VARIANCE
    deep, fine_deep, whole_deep = tl.where(kept, deep, 0.0), tl.where(kept, fine_deep, 0.0), tl.where(kept, whole_deep, 0.0)
    total: tl.constexpr = CHANNELS + 6
    inputs: tl.constexpr = 3 * total + 9
    out = _projected(mean, deep, several, weight, 0, total, inputs, CHANNELS, WIDE, HIDDEN)
    out += _projected(fine, fine_deep, several, weight, CHANNELS, total, inputs, 3, 16, HIDDEN)
    out += _projected(whole, whole_deep, several, weight, CHANNELS + 3, total, inputs, 3, 16, HIDDEN)
    h = tl.arange(0, HIDDEN)[None, :]
    at = weight + h * inputs + 3 * total
    out += tl.load(bias + h) + several[:, None] * tl.load(at) + share[:, None] * tl.load(at + 1)
    out += (tl.log2(footprint_mean) / 4)[:, None] * tl.load(at + 2)
    out += (tl.log2(move + 0.05) * several / 4)[:, None] * tl.load(at + 3)
    c = tl.arange(0, WIDE)[None, :]
    agree = tl.sum(tl.where(c < SAMPLED, deep, 0.0), 1) / SAMPLED
    out += ((tl.log(agree + 1e-4) / 4 + 1) * several)[:, None] * tl.load(at + 4)
    c = tl.arange(0, 16)[None, :]
    agree = tl.sum(tl.where(c < 3, fine_deep, 0.0), 1) / 3
    out += ((tl.log(agree + 1e-4) / 4 + 1) * several)[:, None] * tl.load(at + 5)
    out += signed[:, None] * tl.load(at + 6) + clear[:, None] * tl.load(at + 7) + sure[:, None] * tl.load(at + 8)
    slot, inner = row // 512, row % 512
    filled, busy = tl.load(slots + slot, some, 0), tl.load(slots + blocks + slot, some, -1)
    place = busy.to(tl.int64) * 512 + inner
    works = some & (busy >= 0)
    tl.store(latent + place[:, None] * HIDDEN + h, tl.maximum(out, 0.0), works[:, None])
    tl.store(shown_at + place, tl.full((BLOCK,), 1, tl.uint8), works)
    place = filled.to(tl.int64) * 512 + inner
    shade = tl.minimum(tl.maximum(whole / gain + 0.5, 1e-4), 1 - 1e-4)
    colour = _atanh(tl.log(shade / (1 - shade)) / 4)
    tl.store(start + place[:, None] * channels + c, colour, some[:, None] & (c < 3) & (c < channels))
    tl.store(start + place * channels + 3, _atanh(-signed), some & (channels > 3))
    tl.store(counts + place, views, some)
    tl.store(weights + place, tl.maximum(clear, hidden) * (blind + (1 - blind) * sure), some)


@dataclass(frozen=True)
class Numbers:
    """Numbers of `known_terms`, `unproject` and the model's configuration."""

    truncation: float
    hidden: float
    blind: float
    free: float
    gain: float  # of colours
    coloured: float
    sampled: int  # channels of the encoder's whose variance is averaged
    variance: bool
    channels: int  # of a latent


def local_volume(network: Any, frame: Any, lattice: Any, topology: Any, wanted: Tensor | None, numbers: Numbers) -> tuple[Any, ...]:
    """The fields of a `LocalVolume` behind its lattice, by the `LocalReconstruction` and a `KeyFrame`."""
    views, cameras, device = frame.views, frame.cameras, topology.device
    lenses = tuple(values.contiguous() for values in (cameras.world_from_camera, cameras.intrinsics, cameras.size))
    table = frame.distribution.table.permute(2, 3, 1, 0).contiguous()
    swept = *table.shape[:3], frame.distribution.lowest, frame.distribution.step
    space, limits = lattice.space, (float(max(frame.near, 0.0)), float(frame.far))
    place = tuple(float(value) for value in (lattice.voxel, space.extent, space.half, *space.centre, space.shell))
    # Corners that the key frame sees, in no particular order, and blocks that own one of them (filled), or one near a surface (busy).
    blocks, parts = topology.blocks, 512 // PART
    rows = torch.empty(512 * blocks, dtype=torch.int64, device=device)
    found = torch.zeros(1 + blocks * parts, dtype=torch.int32, device=device)
    if blocks:
        box = tuple(side + 1.01 * lattice.voxel for side in space.box)
        _choose[(blocks * parts,)](
            found if wanted is None else wanted.view(torch.uint8), topology.keys, *lenses, table, rows, found, 512 * blocks, *swept, *place,
            *box, *limits, numbers.truncation, numbers.hidden, numbers.free, ALL=wanted is None, SHELL=space.shell > 0, BLOCK=PART,
        )  # fmt: skip
    read = found.cpu().numpy()
    count, marks = int(read[0]), np.bitwise_or.reduce(read[1:].reshape(blocks, parts), axis=1)
    filled, busy = (np.flatnonzero(marks & bit).astype(np.int32) for bit in (1, 2))
    slots = np.full((2, blocks), -1, np.int32)
    slots[0, filled], slots[1, busy] = (np.arange(len(of), dtype=np.int32) for of in (filled, busy))
    filled_keys, busy_keys = topology.host[filled], topology.host[busy]
    # All that the processor has decided goes to the device in one piece.
    pieces_of: list[Any] = [slots, filled_keys, busy_keys, slots[1, filled], slots[0, busy], busy]
    whole = to_device_async(np.concatenate([part.reshape(-1) for part in pieces_of]), device).split([part.size for part in pieces_of])
    kept = topology.alike(whole[1].view(-1, 3), filled_keys)
    # Beside which blocks they lie is read in a table that others need as well.
    given = whole[2].view(-1, 3), busy_keys
    few = kept.some(*given, whole[4], whole[3]) if wanted is None else topology.some(*given, whole[5], whole[0][blocks:])
    # Evidence in rows of F filled blocks, B of them busy, zero where nothing is seen; one piece of memory is cleared at once.
    hidden = network.project.weight.shape[0]
    corners_of, working = 512 * len(filled), 512 * len(busy)
    sizes = [(working + 1) * hidden, (corners_of + 1) * numbers.channels, corners_of, corners_of, working // 4]
    latent, start, counts, weights, seen = lenses[0].new_zeros(sum(sizes)).split(sizes)
    latent, start, seen = latent.view(-1, hidden), start.view(-1, numbers.channels), seen.view(torch.uint8)
    if count:
        fine, coarse = views[0].colours, views[0].features
        tables = [(view.features.rows.contiguous(), view.colours.rows.contiguous()) for view in views]
        pictures = to_device_async(np.array([of.data_ptr() for pair in tables for of in pair], np.int64), device)
        width = coarse.rows.shape[1]
        _observe[(pieces(count, BLOCK),)](
            rows, topology.keys, whole[0], *lenses, table, pictures, network.project.weight, network.project.bias, latent, start,
            counts, weights, seen, numbers.channels, blocks, len(views), count, *swept, *place, *limits, numbers.truncation,
            numbers.hidden, numbers.blind, *coarse.sizes[0], len(coarse.sizes), *fine.sizes[0], len(fine.sizes), numbers.coloured,
            numbers.gain, SHELL=space.shell > 0, VARIANCE=numbers.variance, CHANNELS=width, WIDE=max(16, power_of_two(width)),
            SAMPLED=numbers.sampled, STRIDE=coarse.stride, FINE=fine.stride, HIDDEN=hidden, BLOCK=BLOCK,
        )  # fmt: skip
    learned = network.learned(latent, few, seen.view(torch.bool)) if len(busy) else start
    raw, out = settle(start, learned, whole[3])
    return kept, out, counts, raw, weights, few, whole[4]
