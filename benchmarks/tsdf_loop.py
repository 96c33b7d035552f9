"""Frame rate of `TsdfVolume` beside a bare loop on Open3D's `VoxelBlockGrid`, measured in turns in one run."""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence

import numpy as np
import open3d as o3d
import open3d.core as o3c

from fieldfuse.camera import invert
from fieldfuse.errors import InputError
from fieldfuse.tsdf.volume import BLOCK, DEVICE, TRUNCATION, DepthFrame, TsdfVolume


def bare_loop_seconds(
    raw: Sequence[tuple[o3c.Tensor, o3c.Tensor]],
    frames: Sequence[DepthFrame],
    voxel_size: float,
    depth_max: float,
    blocks: int,
) -> tuple[float, float]:
    """Seconds of the shortest loop one can write, by the wall and by all threads' processor time.

    16-bit millimetres and 8-bit colour as stored, nothing checked, room for all `blocks`.
    """
    grid = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight", "color"),
        (o3c.float32, o3c.float32, o3c.float32),
        (o3c.SizeVector([1]), o3c.SizeVector([1]), o3c.SizeVector([3])),
        voxel_size,
        BLOCK,
        blocks,
        DEVICE,
    )
    started = _clocks()
    for (depth, colour), frame in zip(raw, frames, strict=True):
        depth_image, colour_image = o3d.t.geometry.Image(depth), o3d.t.geometry.Image(colour)
        matrix, colour_matrix = o3c.Tensor(frame.depth_intrinsics.matrix()), o3c.Tensor(frame.colour_intrinsics.matrix())
        extrinsic = o3c.Tensor(invert(frame.world_from_camera))
        keys = grid.compute_unique_block_coordinates(depth_image, matrix, extrinsic, 1000.0, depth_max, TRUNCATION)
        grid.integrate(keys, depth_image, colour_image, matrix, colour_matrix, extrinsic, 1000.0, depth_max, TRUNCATION)
    return _since(started)


def compare_with_bare_loop(frames: Sequence[DepthFrame], voxel_size: float, depth_max: float, rounds: int = 5) -> dict[str, float]:
    """Frames a second of `TsdfVolume.integrate` and of the bare loop on the same frames (metres, already decoded), and their ratio.

    Both run `rounds` times in turns, each first in every other round, so that a busy machine slows both; medians count. Set the number of
    threads before Open3D is imported (OMP_NUM_THREADS=1).

    Returns:
        `voxel_size`, `frames`, `ours` and `bare` (frames/s, medians), `ratio` (median of the ratios within a round), `best_ratio` (of the
        processor time that each took in its best round: what a busy machine disturbs least).
    """
    if not frames:
        raise InputError("there are no depth frames to measure with; choose a capture with depth")
    scratch = TsdfVolume(voxel_size, depth_max)
    for frame in frames:
        scratch.integrate(frame)
    blocks = scratch.blocks + max(len(scratch.touched(frame)) for frame in frames) + 1000
    del scratch
    raw = [
        (o3c.Tensor.from_numpy(np.round(frame.depth * 1000).astype(np.uint16)), o3c.Tensor.from_numpy(np.ascontiguousarray(frame.colour)))
        for frame in frames
    ]
    ours, bare = [], []
    for turn in range(rounds):
        for which in ("ours", "bare") if turn % 2 else ("bare", "ours"):
            if which == "bare":
                bare.append(bare_loop_seconds(raw, frames, voxel_size, depth_max, blocks))
            else:
                volume = TsdfVolume(voxel_size, depth_max, expected_blocks=blocks)
                started = _clocks()
                for frame in frames:
                    volume.integrate(frame)
                ours.append(_since(started))
    return {
        "voxel_size": voxel_size,
        "frames": float(len(frames)),
        "ours": len(frames) / statistics.median(wall for wall, _ in ours),
        "bare": len(frames) / statistics.median(wall for wall, _ in bare),
        "ratio": statistics.median(b / o for (b, _), (o, _) in zip(bare, ours, strict=True)),
        "best_ratio": min(processor for _, processor in bare) / min(processor for _, processor in ours),
    }


def _clocks() -> tuple[float, float]:
    return time.perf_counter(), time.process_time()


def _since(started: tuple[float, float]) -> tuple[float, float]:
    wall, processor = _clocks()
    return wall - started[0], processor - started[1]
