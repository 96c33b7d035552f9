"""From depth by matching to a surface."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from fieldfuse.capture.types import Views
from fieldfuse.progress import SILENT, Progress
from fieldfuse.stereo.maps import LEAST_CONFIDENCE
from fieldfuse.stereo.match import StereoDepth
from fieldfuse.tsdf.frames import DepthFrame, cover
from fieldfuse.tsdf.held import fuse_held
from fieldfuse.tsdf.volume import TsdfVolume


def stereo_frames(views: Views, depths: Sequence[StereoDepth]) -> Iterator[DepthFrame]:
    """One frame a view: its depth where it is confident enough, its picture in full size."""
    for index, found in enumerate(depths):
        depth = np.where(found.confidence >= LEAST_CONFIDENCE, found.depth, np.float32(0))
        colour, camera = cover(views.images[index], views.intrinsics[index].pinhole(), found.intrinsics)
        pose = np.asarray(views.world_from_camera[index], dtype=np.float64)
        yield DepthFrame(depth, np.ascontiguousarray(colour), found.intrinsics, camera, pose)


def fuse_stereo(
    views: Views,
    depths: Sequence[StereoDepth],
    voxel_size: float | None = None,
    depth_max: float | None = None,
    carve: bool = True,
    progress: Progress = SILENT,
) -> TsdfVolume:
    """Fuse the depth of `stereo_depths(views, …)`; arguments and errors as `fuse_held`."""
    nothing = (
        "no depth could be found by matching the pictures: they show too little texture, or their poses do not fit them; find the poses"
        " again with --poses sfm, or set tsdf.enabled=off"
    )
    frames = stereo_frames(views, depths)
    return fuse_held(frames, len(depths), voxel_size, depth_max, carve=carve, nothing=nothing, progress=progress)
