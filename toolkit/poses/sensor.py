"""Scale from depth maps: structure from motion does not know metres, a depth camera does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fieldfuse.camera import project
from fieldfuse.capture.images import load_depth
from fieldfuse.capture.types import Capture
from fieldfuse.poses.result import PoseResult

FRAMES = 12  # depth maps that are looked at
MIN_POINTS = 50  # points with depth that make a scale believable
SPREAD = 0.25  # relative spread (half the 20–80% range) of depth ratios above which sensor and model disagree


def scale_to_depth(result: PoseResult, capture: Capture) -> PoseResult:
    """`result` scaled so that its points' depths agree with the capture's depth maps (median ratio over points and frames).

    Unchanged but for a warning when they disagree among themselves or there is too little to compare.
    """
    by_name = {frame.name: frame for frame in capture.frames}
    step = max(1, len(result.names) // FRAMES)
    ratios = []
    for i in range(0, len(result.names), step):
        frame = by_name[result.names[i]]
        if frame.depth is None or result.points is None:
            continue
        depth = load_depth(frame, capture)
        camera = (frame.depth_intrinsics or result.intrinsics[i]).scaled(depth.shape[1], depth.shape[0])
        pixels, z = project(camera, result.world_from_camera[i], result.points)
        inside = (z > 0) & np.all(pixels >= 0, axis=1) & (pixels[:, 0] < depth.shape[1]) & (pixels[:, 1] < depth.shape[0])
        sensed = depth[pixels[inside, 1].astype(int), pixels[inside, 0].astype(int)]
        ratios.append(sensed[sensed > 0] / z[inside][sensed > 0])
    found = np.concatenate(ratios) if ratios else np.zeros(0)
    if len(found) < MIN_POINTS:
        return replace(
            result,
            warnings=[
                *result.warnings,
                "the depth maps share too few points with the poses found, so the scale stays unknown and depth is of no use here",
            ],
        )
    low, scale, high = np.percentile(found, [20, 50, 80])
    if (high - low) / (2 * scale) > SPREAD:
        return replace(
            result,
            warnings=[
                *result.warnings,
                f"the depth maps and the poses found disagree on scale (ratios from "
                f"{low:.3g} to {high:.3g}); check the depth's unit and alignment",
            ],
        )
    poses = result.world_from_camera.copy()
    poses[:, :3, 3] *= scale
    return replace(
        result,
        world_from_camera=poses,
        points=None if result.points is None else result.points * scale,
        metric=capture.metric or capture.has_depth,
    )
