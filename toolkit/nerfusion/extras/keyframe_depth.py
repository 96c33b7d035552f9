"""Depth distributions of all key frames, each checked against those of overlapping key frames (not in the paper; `network.agreement`).

Overlapping key frames are needed before a key frame is fused, also those that come later, so distributions are made on demand and cached
for those that need them next. Images are compared small, which costs little against encoding them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from fieldfuse.backends.dispatch import is_cpu
from fieldfuse.camera import Array, Intrinsics
from fieldfuse.capture.types import Views
from fieldfuse.nerfusion.cameras import Cameras
from fieldfuse.nerfusion.extras.cross_view_consistency import CrossView, consistency, cross_view, own_estimate
from fieldfuse.nerfusion.extras.matching import patch_descriptors
from fieldfuse.nerfusion.extras.plane_sweep import CostVolume, DepthDistribution, cost_volume, to_probability
from fieldfuse.nerfusion.images import Recent, image_of, sensor_depth, with_neighbours
from fieldfuse.nerfusion.keyframes import KeyFrames
from fieldfuse.poses.overlap import overlap, parallax

MOST = 8  # key frames that one is checked against
LEAST_OVERLAP = 0.1  # either way
WIDEST = 60.0  # degrees of parallax: two that see a place from opposite sides tell little about each other
KEPT = 32  # distributions cached for key frames to come, 13 MB each at most, and as much again until they are needed
KEPT_DESCRIPTORS = 16  # images, 6 MB each at most


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
    """Call with a position in `keys.indices` for the depth distribution of that key frame."""

    def __init__(
        self,
        views: Views,
        keys: KeyFrames,
        witnesses: Sequence[Sequence[int]],
        near: float,
        far: float,
        measured: bool = False,
        device: torch.device | str = "cpu",
        pictures: Callable[[int], Tensor] | None = None,
    ) -> None:
        """
        Args:
            witnesses: for each key frame those that it is checked against, as `overlapping` gives them; none: its own images alone.
            near, far: depths along z, working units; one of them known.
            measured: the depth that a sensor measured goes into a key frame's distribution.
            pictures: gives a view's image (1, 3, H, W) on the device; None: it is brought there.

        Raises:
            ValueError: neither depth is known.
        """
        if not (near > 0 or math.isfinite(far)):
            raise ValueError("sweeps need a nearest or a farthest depth")
        self.views, self.keys, self.witnesses = views, keys, witnesses
        self.near, self.far, self.measured, self.device = near, far, measured, device
        self._picture = pictures or (lambda index: image_of(views, index, device))
        self._described: Recent[Tensor] = Recent(KEPT_DESCRIPTORS)
        self._made: Recent[tuple[CostVolume | None, CrossView, Tensor]] = Recent(KEPT)

    def __call__(self, at: int) -> DepthDistribution:
        costs, log_odds, surface = self._made.get(at, self._make)
        if costs is None:
            costs, log_odds, surface = self._make(at)
        correction = consistency(costs, [self._made.get(other, self._make)[1] for other in self.witnesses[at]], surface)
        self._made.put(at, (None, log_odds, surface))  # a key frame is fused once, and then only checks others
        return to_probability(costs, self._depth(at), correction)

    def _make(self, at: int) -> tuple[CostVolume, CrossView, Tensor]:
        """The cost volume of its images, its evidence for others, and its confident points."""
        group = with_neighbours(int(self.keys.indices[at]), self.keys.neighbours[at])
        poses = self.views.world_from_camera[group]
        cameras = Cameras.of([self.views.intrinsics[index] for index in group], poses, self.device)
        new = [index for index in group if index not in self._described]
        if len(new) > 1 and not is_cpu(torch.device(self.device)) and len({self.views.images[index].shape for index in new}) == 1:
            # Together they take as many launches as one.
            for index, made in zip(new, patch_descriptors(torch.cat([self._picture(index) for index in new])), strict=True):
                self._described.put(index, made)
        costs = cost_volume([self._described.get(index, self._describe) for index in group], cameras, self.near, self.far)
        log_odds, surface = own_estimate(costs)
        depth = self._depth(at)
        return costs, log_odds if depth is None else cross_view(to_probability(costs, depth)), surface

    def _describe(self, index: int) -> Tensor:
        return patch_descriptors(self._picture(index))[0]

    def _depth(self, at: int) -> Tensor | None:
        return sensor_depth(self.views, int(self.keys.indices[at]), self.device) if self.measured else None
