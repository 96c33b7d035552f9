"""Sparse points with who sees them: from the source's own points, from depth maps, or from a table of observations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fieldfuse.camera import Array, project, unproject
from fieldfuse.capture.images import load_depth
from fieldfuse.capture.types import Capture
from fieldfuse.progress import SILENT, Progress

DEPTH_FRAMES = 40  # depth maps that are sampled
DEPTH_SAMPLES = 1500  # pixels of each
SEEN_FRAMES = 80  # frames into which points without tracks are projected


@dataclass
class Cloud:
    """Points in the input's frame, and observations: which frame sees which point at which depth."""

    points: Array  # (P, 3) float64
    point: Array  # (M,) int64 index into points
    frame: Array  # (M,) int64 index into the capture's frames
    depth: Array  # (M,) float64 along that frame's z
    source: str  # "source", "depth", "triangulated" or "silhouettes"

    @property
    def views(self) -> Array:
        """(P,) number of observations of each point."""
        return np.bincount(self.point, minlength=len(self.points))

    def median_depth(self) -> float:
        """Median over frames of the median depth that each sees."""
        order = np.argsort(self.frame, kind="stable")
        starts = np.flatnonzero(np.diff(self.frame[order], prepend=-1))
        return float(np.median([np.median(part) for part in np.split(self.depth[order], starts[1:])]))


def every(count: int, most: int) -> Array:
    """At most `most` indices spread evenly over range(count)."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64))


def cloud_of_points(capture: Capture, points: Array, source: str) -> Cloud:
    """Points without tracks: each is taken as seen by every frame (of up to 80) that has it inside its picture, hidden or not."""
    seen_point, seen_frame, seen_depth = [], [], []
    for i in every(len(capture.frames), SEEN_FRAMES):
        frame = capture.frames[i]
        assert frame.intrinsics is not None and frame.world_from_camera is not None
        # A lens bends far-off points back into the picture; which points are in view is asked of the pinhole camera.
        pixels, depth = project(frame.intrinsics.pinhole(), frame.world_from_camera, points)
        with np.errstate(invalid="ignore"):
            inside = (depth > 0) & np.all((pixels >= 0) & (pixels <= [frame.intrinsics.width, frame.intrinsics.height]), axis=1)
        found = np.flatnonzero(inside)
        seen_point.append(found)
        seen_frame.append(np.full(len(found), i))
        seen_depth.append(depth[found])
    return Cloud(points, np.concatenate(seen_point), np.concatenate(seen_frame), np.concatenate(seen_depth), source)


def cloud_of_depth(capture: Capture, progress: Progress = SILENT) -> Cloud:
    """Pixels of some depth maps, unprojected. Every sample is one point with one observation."""
    frames = [i for i, frame in enumerate(capture.frames) if frame.depth is not None]
    random = np.random.default_rng(0)
    points, owner, depths = [], [], []
    chosen = every(len(frames), DEPTH_FRAMES)
    for n, k in enumerate(chosen):
        progress.check()
        progress.update(n, len(chosen), "looking at depth")
        i = frames[k]
        frame = capture.frames[i]
        assert frame.intrinsics is not None and frame.world_from_camera is not None
        depth = load_depth(frame, capture)
        rows, columns = np.nonzero(depth)
        if len(rows) == 0:
            continue
        pick = random.choice(len(rows), min(DEPTH_SAMPLES, len(rows)), replace=False)
        z = depth[rows[pick], columns[pick]].astype(np.float64)
        camera = (frame.depth_intrinsics or frame.intrinsics).pinhole().scaled(depth.shape[1], depth.shape[0])
        pixels = np.stack([columns[pick] + 0.5, rows[pick] + 0.5], axis=1)
        points.append(unproject(camera, frame.world_from_camera, pixels, z))
        owner.append(np.full(len(z), i))
        depths.append(z)
    if not points:
        return Cloud(np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0), "depth")
    stacked = np.concatenate(points)
    return Cloud(stacked, np.arange(len(stacked)), np.concatenate(owner), np.concatenate(depths), "depth")
