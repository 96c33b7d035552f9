"""From depth frames to a fused volume: how much memory it will take, the loop over frames, and a whole capture."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from fieldfuse.camera import Similarity
from fieldfuse.capture.types import Capture
from fieldfuse.config import TsdfSettings
from fieldfuse.errors import InputError
from fieldfuse.progress import SILENT, Progress
from fieldfuse.tone import Tone
from fieldfuse.tsdf.frames import DepthFrame, automatic_depth_max, automatic_voxel_size, capture_depth_frames
from fieldfuse.tsdf.view import MeshView
from fieldfuse.tsdf.volume import Points, TsdfVolume, too_fine

__all__ = ["DepthFrame", "MeshView", "Points", "TsdfVolume", "capture_depth_frames", "estimate_blocks", "fuse_capture", "fuse_frames"]

log = logging.getLogger(__name__)

SAMPLE_FRAMES = 12  # frames looked at before fusion, for voxel size, range and memory
FINEST = 0.3  # smallest voxel in pixels: Open3D looks at every fourth pixel for the blocks of 8 voxels to fill
COARSER = 1.4  # from one try of a voxel size to the next
HOPELESS = 16  # how many times too many blocks are counted before counting stops


def estimate_blocks(sample: Sequence[DepthFrame], volume: TsdfVolume, total: int) -> int:
    """Blocks that `total` frames will need, from an evenly spread sample of them: the blocks it touches, and as much again for what
    lies between when the sample's frames overlap little.

    Raises:
        InputError: the sample alone needs more than the volume may hold, or a voxel is so small that pixels would miss most blocks.
    """
    pixel = float(np.median([np.median(f.depth[f.depth > 0]) / f.depth_intrinsics.fx for f in sample if (f.depth > 0).any()] or [0.0]))
    if volume.voxel_size < FINEST * pixel:
        raise InputError(
            f"a voxel size of {volume.voxel_size:g} is finer than the pixels of the depth maps ({pixel:.2g} on the surface), which would"
            f" leave holes; use tsdf.voxel_size={FINEST * pixel * 1.05:.2g} or larger"
        )
    union = np.zeros(0, np.int64)
    passed = largest = 0
    for frame in sample:
        # A key's three numbers in one, 21 bits each: much faster to compare than rows.
        keys = (volume.touched(frame).astype(np.int64) + (1 << 20)) @ np.array([1, 1 << 21, 1 << 42])
        passed, largest = passed + len(keys), max(largest, len(keys))
        union = np.union1d(union, keys)
        if len(union) > HOPELESS * volume.max_blocks:
            break
    if len(union) > volume.max_blocks:
        raise too_fine(volume.voxel_size, len(union), volume.max_blocks)
    unseen = len(union) * (len(union) / max(passed, 1)) if total > len(sample) else 0.0
    return int(1.2 * (len(union) + unseen)) + largest


def with_room(
    sample: Sequence[DepthFrame], voxel_size: float | None, depth_max: float, total: int, focal: float | None = None
) -> tuple[float, int]:
    """Voxel size and blocks for `total` frames; a size that was not asked for is made coarser until the blocks fit into memory.

    Args:
        focal: of the camera whose pixels that size goes by; None: the depth maps'.

    Raises:
        InputError: the size that was asked for is too fine for the memory, or for the pixels.
    """
    focal = focal or min(frame.depth_intrinsics.fx for frame in sample)
    size = voxel_size or automatic_voxel_size([frame.depth for frame in sample], focal)
    while True:
        try:
            return size, estimate_blocks(sample, TsdfVolume(size, depth_max, expected_blocks=64), total)
        except InputError:
            if voxel_size is not None or size > depth_max:
                raise
            size *= COARSER


def fuse_frames(
    frames: Iterable[DepthFrame],
    voxel_size: float,
    depth_max: float,
    total: int = 0,
    expected_blocks: int = 4000,
    progress: Progress = SILENT,
) -> TsdfVolume:
    """Fuse all `frames` (`total` of them, for the progress).

    Raises:
        InputError: none holds depth within range, or the voxel size is too fine for the memory.
        Interrupted: the user asked to stop.
    """
    volume = TsdfVolume(voxel_size, depth_max, expected_blocks=expected_blocks)
    for number, frame in enumerate(frames, 1):
        progress.check()
        volume.integrate(frame)
        progress.update(number, max(total, number), f"{volume.blocks} blocks")
    volume.require_frames()
    if volume.empty_frames:
        seen = volume.frames + volume.empty_frames
        log.warning("%d of %d frames hold no depth within %g and were left out of the TSDF", volume.empty_frames, seen, depth_max)
    return volume


def fuse_capture(
    capture: Capture,
    working_from_input: Similarity,
    indices: Iterable[int] | None = None,
    settings: TsdfSettings | None = None,
    progress: Progress = SILENT,
    tones: Mapping[str, Tone] | None = None,
) -> TsdfVolume:
    """Fuse the frames `indices` (None: all) of a capture; voxel size and range from its depth unless `settings` name them. What `tones`
    has for a frame's name is taken out of its colours.

    Raises:
        InputError: no frame has depth, poses are missing, or the voxel size is too fine for the memory.
        Interrupted: the user asked to stop.
    """
    settings = settings or TsdfSettings()
    chosen = range(len(capture.frames)) if indices is None else [int(i) for i in indices]
    wanted = [i for i in chosen if capture.frames[i].depth is not None]
    if not wanted:
        raise InputError(f"{capture.root} holds no depth maps, which the TSDF needs; set tsdf.enabled=off")
    spread = np.unique(np.linspace(0, len(wanted) - 1, SAMPLE_FRAMES).round().astype(int))
    sample = list(capture_depth_frames(capture, working_from_input, [wanted[i] for i in spread]))
    depths = [frame.depth for frame in sample]
    depth_max = settings.depth_max or automatic_depth_max(depths)
    voxel_size, expected = with_room(sample, settings.voxel_size, depth_max, len(wanted))
    del sample, depths
    frames = capture_depth_frames(capture, working_from_input, wanted, tones)
    return fuse_frames(frames, voxel_size, depth_max, len(wanted), expected, progress)
