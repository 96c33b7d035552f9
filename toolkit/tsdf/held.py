"""Fusing depth frames that are all in memory: sizes from their depth, room made once, empty space carved by every view."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from fieldfuse.errors import InputError
from fieldfuse.progress import SILENT, Progress
from fieldfuse.tsdf.frames import DepthFrame, automatic_depth_max
from fieldfuse.tsdf.fuse import with_room
from fieldfuse.tsdf.volume import TsdfVolume

CONFIRMED = 1.5  # surface that a single view shows is left out ...
MANY_VIEWS = 10  # ... from so many views on
FUSION = 0.1  # of the time that making the frames takes, for the progress


def fuse_held(
    frames: Iterable[DepthFrame],
    total: int,
    voxel_size: float | None = None,
    depth_max: float | None = None,
    *,
    focal: float | None = None,
    carve: bool = True,
    nothing: str = "no view shows a surface",
    progress: Progress = SILENT,
) -> TsdfVolume:
    """Take all `frames` (`total` of them; they may be made one by one as they are asked for, which is told), and fuse those that show
    depth.

    Args:
        voxel_size, depth_max: working units; None: from the frames' depth, the voxel size made coarser until it fits into memory.
        focal: of the camera whose pixels a voxel size that is not asked for goes by; None: the depth maps'.
        carve: take no frame's word alone: each empties what others put in front of its surface, and what a single one shows is left out.
        nothing: the refusal when no frame shows depth.

    Raises:
        InputError: no frame shows depth, or the voxel size that was asked for is too fine for the memory.
        Interrupted: the user asked to stop.
    """
    held: list[DepthFrame] = []
    if isinstance(frames, Sequence):
        held += frames
    else:
        for number, frame in enumerate(frames, 1):
            progress.check()
            held.append(frame)
            progress.update(number, (1 + FUSION) * total, "views made for the surface")
    shown = [frame for frame in held if (frame.depth > 0).any()]
    if not shown:
        raise InputError(nothing)
    volume = _with_room(shown, voxel_size, depth_max, focal)
    if carve:
        volume.min_weight = CONFIRMED if len(shown) >= MANY_VIEWS else None
        for frame in shown:
            volume.reserve(volume.touched(frame))
    for number, frame in enumerate(shown, 1):
        progress.check()
        volume.integrate(frame, carve)
        progress.update(total * (1 + FUSION * number / len(shown)), (1 + FUSION) * total, "views fused")
    if volume.frames == 0:
        raise InputError(f"no view shows a surface nearer than {volume.depth_max:g}; raise the largest depth")
    return volume


def _with_room(frames: Sequence[DepthFrame], voxel_size: float | None, depth_max: float | None, focal: float | None) -> TsdfVolume:
    """An empty volume that the frames fit into."""
    depth_max = depth_max or automatic_depth_max([frame.depth for frame in frames])
    size, expected = with_room(frames, voxel_size, depth_max, len(frames), focal)
    return TsdfVolume(size, depth_max, expected_blocks=2 * expected)
