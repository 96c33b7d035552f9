"""Depth distributions of all key frames, each checked against those of overlapping key frames (not in the paper; `network.agreement`).

Overlapping key frames are needed before a key frame is fused, also those that come later, so distributions are made on demand and cached
for those that need them next. Images are compared small, which costs little against encoding them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from fieldfuse.backends.dispatch import is_cpu
from fieldfuse.camera import Array, Intrinsics
from fieldfuse.nerfusion.cameras import Cameras
from fieldfuse.nerfusion.extras.cross_view_consistency import CrossView, consistency, cross_view, own_estimate
from fieldfuse.nerfusion.extras.matching import patch_descriptors
from fieldfuse.nerfusion.extras.plane_sweep import CostVolume, DepthDistribution, cost_volume, to_probability
from fieldfuse.nerfusion.images import ImageCache, Recent
from fieldfuse.nerfusion.keyframes import KeyFrames
from fieldfuse.poses.overlap import overlap, parallax

MOST = 8  # key frames that one is checked against
LEAST_OVERLAP = 0.1  # either way
WIDEST = 60.0  # degrees of parallax: two that see a place from opposite sides tell little about each other
CACHED = 32  # distributions for key frames to come, 13 MB each at most, and as much again until they are needed
CACHED_DESCRIPTORS = 16  # images, 6 MB each at most


def overlapping(keys: KeyFrames, world_from_camera: Array, intrinsics: Sequence[Intrinsics], depth: float) -> list[list[int]]:
    """For each key frame those that overlap most with it, as positions in `keys.indices`.

    Args:
        world_from_camera: (N, 4, 4) of all views that `keys` counts.
        depth: median depth, in the frame of the poses.
    """
    poses = np.asarray(world_from_camera, dtype=np.float64)[keys.indices]
    shares = overlap(poses, [intrinsics[int(index)] for index in keys.indices], depth)
    angles = parallax(poses, depth)
    common = np.minimum(shares, shares.T)
    common[np.maximum(angles, angles.T) > WIDEST] = 0
    np.fill_diagonal(common, 0)
    order = np.argsort(-common, axis=1, kind="stable")[:, :MOST]
    return [[int(other) for other in row if common[at, other] > LEAST_OVERLAP] for at, row in enumerate(order)]


class KeyframeDepth:
    """Call with a position in `keys.indices` for the depth distribution of that key frame.

    Args:
        images: of the views that `keys` counts, and their measured depth.
        others: for each key frame those that it is checked against, as `overlapping` gives them; none: its own images alone.
        near, far: depths along z, working units; one of them known.

    Raises:
        ValueError: neither depth is known.
    """

    def __init__(self, images: ImageCache, keys: KeyFrames, others: Sequence[Sequence[int]], near: float, far: float) -> None:
        if not (near > 0 or math.isfinite(far)):
            raise ValueError("sweeps need a nearest or a farthest depth")
        self.images, self.keys, self.others, self.near, self.far = images, keys, others, near, far
        self._descriptors: Recent[Tensor] = Recent(CACHED_DESCRIPTORS)
        self._made: Recent[tuple[CostVolume | None, CrossView, Tensor]] = Recent(CACHED)

    def __call__(self, at: int) -> DepthDistribution:
        costs, log_odds, surface = self._made.get(at, self._make)
        if costs is None:
            costs, log_odds, surface = self._make(at)
        correction = consistency(costs, [self._made.get(other, self._make)[1] for other in self.others[at]], surface)
        self._made.put(at, (None, log_odds, surface))  # a key frame is fused once, and then only checks others
        return to_probability(costs, self.images.depth(int(self.keys.indices[at])), correction)

    def _make(self, at: int) -> tuple[CostVolume, CrossView, Tensor]:
        """The cost volume of its images, its evidence for others, and its confident points."""
        views, device, group = self.images.views, self.images.device, self.keys.group(at)
        cameras = Cameras.of([views.intrinsics[index] for index in group], views.world_from_camera[group], device)
        new = [index for index in group if index not in self._descriptors]
        if len(new) > 1 and not is_cpu(device) and len({views.images[index].shape for index in new}) == 1:
            # Together they take as many launches as one.
            for index, made in zip(new, patch_descriptors(torch.cat([self.images(index) for index in new])), strict=True):
                self._descriptors.put(index, made)
        descriptors = [self._descriptors.get(index, lambda index: patch_descriptors(self.images(index))[0]) for index in group]
        costs = cost_volume(descriptors, cameras, self.near, self.far)
        log_odds, surface = own_estimate(costs)
        depth = self.images.depth(group[0])
        return costs, log_odds if depth is None else cross_view(to_probability(costs, depth)), surface
