"""Poses that the capture brings."""

from __future__ import annotations

import numpy as np

from fieldfuse.capture.types import Capture
from fieldfuse.errors import PoseError
from fieldfuse.poses.result import GIVEN, PoseResult, listed

FEW, SHARE = 6, 0.1  # images with poses, and their share of all, below which the model is a failed one, or of other images


def given_poses(capture: Capture) -> PoseResult:
    """The frames that come with pose and intrinsics, as they are.

    Raises:
        PoseError: fewer than two frames have both, hardly any of many images do, or all cameras stand on one spot.
    """
    posed = [frame for frame in capture.frames if frame.world_from_camera is not None and frame.intrinsics is not None]
    missing = [frame.name for frame in capture.frames if frame.world_from_camera is None or frame.intrinsics is None]
    if len(posed) < 2:
        raise PoseError(
            f"{capture.root}: {len(posed)} of {len(capture.frames)} frames come with a pose and intrinsics, at least 2 "
            f"are needed; use --set poses.source=sfm to find them"
        )
    beside = int(capture.extra.get("unregistered") or 0)
    if len(posed) < FEW and len(posed) < SHARE * (len(posed) + beside):
        raise PoseError(
            f"{capture.root}: the poses that come with it are of {len(posed)} of {len(posed) + beside} images only, so they hardly are of "
            f"these images; find poses of all with --poses sfm"
        )
    poses = np.array([frame.world_from_camera for frame in posed], dtype=np.float64)
    cameras = [frame.intrinsics.checked(f"{capture.root}, {frame.name}") for frame in posed if frame.intrinsics is not None]
    centres = poses[:, :3, 3]
    spread = float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())
    if not spread > 1e-9 * max(1.0, float(np.abs(centres).max())):
        raise PoseError(
            f"{capture.root}: all {len(posed)} given cameras stand on one spot, so depth cannot be told; record while "
            f"moving sideways, or correct the poses"
        )
    warnings = []
    if missing:
        warnings.append(f"{len(missing)} of {len(capture.frames)} frames come without a pose and are left out: {listed(missing)}")
    return PoseResult(
        source=GIVEN,
        registered=len(posed),
        total=len(capture.frames),
        names=[frame.name for frame in posed],
        intrinsics=cameras,
        world_from_camera=poses,
        models=[len(posed)],
        missing=missing,
        points=None if capture.points is None else np.asarray(capture.points, dtype=np.float64),
        warnings=warnings,
        seconds={},
        metric=capture.metric,
    )
