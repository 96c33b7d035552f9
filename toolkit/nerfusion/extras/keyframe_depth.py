"""The plane sweeps of all key frames, each held against those of the key frames beside it (not in the paper).

A key frame's witnesses are wanted before it is fused, whichever of them come later, so sweeps are made as they are asked for and kept for
those that ask next. The pictures are compared small, which costs little against encoding them.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

import numpy as np
import torch
from torch import Tensor

from fieldfuse.backends.dispatch import is_cpu
from fieldfuse.camera import Array, Intrinsics
from fieldfuse.capture.types import Views
from fieldfuse.nerfusion.cameras import Cameras
from fieldfuse.nerfusion.extras.cross_view_consistency import Witness, alone, evidence, witness
from fieldfuse.nerfusion.extras.matching import describe
from fieldfuse.nerfusion.extras.plane_sweep import Compared, Sweep, compare, decide
from fieldfuse.nerfusion.keyframes import KeyFrames
from fieldfuse.poses.overlap import overlap, parallax

MOST = 8  # witnesses of a key frame
LEAST_OVERLAP = 0.1  # either way
WIDEST = 60.0  # degrees of parallax: two that look at a place from either side say little about each other
KEPT = 32  # sweeps kept for key frames to come, 13 MB each at most, and as much again until they are asked for
KEPT_DESCRIPTORS = 16  # pictures, 6 MB each at most
KEPT_PICTURES = 48  # on a device of its own, as bytes
T = TypeVar("T")


def beside(keys: KeyFrames, world_from_camera: Array, intrinsics: Sequence[Intrinsics], depth: float) -> list[list[int]]:
    """For each key frame its witnesses, as places in `keys.indices`: those that overlap most.

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


class KeySweeps:
    """Call with a place in `keys.indices` for the sweep of that key frame."""

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
            witnesses: for each key frame, as `beside` gives them; none: its sweep alone.
            near, far: depths along z, working units; one of them known.
            measured: the depth that a sensor measured goes into a key frame's sweep.
            pictures: gives a view's picture (1, 3, H, W) on the device; None: it is brought there.

        Raises:
            ValueError: neither depth is known.
        """
        if not (near > 0 or math.isfinite(far)):
            raise ValueError("sweeps need a nearest or a farthest depth")
        self.views, self.keys, self.witnesses = views, keys, witnesses
        self.near, self.far, self.measured, self.device = near, far, measured, device
        self._picture = pictures or (lambda index: picture(views, index, device))
        self._described: Recent[Tensor] = Recent(KEPT_DESCRIPTORS)
        self._made: Recent[tuple[Compared | None, Witness, Tensor]] = Recent(KEPT)

    def __call__(self, at: int) -> Sweep:
        compared, says, surface = self._made.get(at, self._make)
        if compared is None:
            compared, says, surface = self._make(at)
        said = evidence(compared, [self._made.get(other, self._make)[1] for other in self.witnesses[at]], surface)
        self._made.put(at, (None, says, surface))  # a key frame is fused once, and goes on as a witness
        return decide(compared, self._depth(at), said)

    def _make(self, at: int) -> tuple[Compared, Witness, Tensor]:
        """What the pictures say alone, what this key frame says of others' surfaces, and the places it is sure of."""
        group = together(int(self.keys.indices[at]), self.keys.neighbours[at])
        poses = self.views.world_from_camera[group]
        cameras = Cameras.of([self.views.intrinsics[index] for index in group], poses, self.device)
        new = [index for index in group if index not in self._described]
        if len(new) > 1 and not is_cpu(torch.device(self.device)) and len({self.views.images[index].shape for index in new}) == 1:
            # Together they take as many launches as one.
            for index, made in zip(new, describe(torch.cat([self._picture(index) for index in new])), strict=True):
                self._described.put(index, made)
        compared = compare([self._described.get(index, self._describe) for index in group], cameras, self.near, self.far)
        says, surface = alone(compared)
        depth = self._depth(at)
        return compared, says if depth is None else witness(decide(compared, depth)), surface

    def _describe(self, index: int) -> Tensor:
        return describe(self._picture(index))[0]

    def _depth(self, at: int) -> Tensor | None:
        return sensed(self.views, int(self.keys.indices[at]), self.device) if self.measured else None


class Brought:
    """Pictures of views on a device, the most recently asked of kept there: call with an index for (1, 3, H, W) RGB in [0, 1]."""

    def __init__(self, views: Views, device: torch.device) -> None:
        self.views, self.device = views, device
        self._kept: Recent[Tensor] = Recent(KEPT_PICTURES)

    def __call__(self, index: int) -> Tensor:
        return shown(self._kept.get(index, lambda index: pixels(self.views, index, self.device)))


class Recent(Generic[T]):
    """The most recently asked of what is made for an index.

    `functools.lru_cache` of a method would refer to its owner, which then stays in memory until the garbage collector comes by.
    """

    def __init__(self, most: int) -> None:
        self.most = most
        self._kept: OrderedDict[int, T] = OrderedDict()

    def __contains__(self, index: int) -> bool:
        return index in self._kept

    def get(self, index: int, make: Callable[[int], T]) -> T:
        """What is kept for `index`, or what `make` gives for it."""
        return self.put(index, self._kept[index] if index in self._kept else make(index))

    def put(self, index: int, value: T) -> T:
        """Keep `value` as the most recently asked of."""
        self._kept[index] = value
        self._kept.move_to_end(index)
        while len(self._kept) > self.most:
            self._kept.popitem(last=False)
        return value


def together(key: int, neighbours: Array) -> list[int]:
    """The key frame and its neighbours, each once."""
    return list(dict.fromkeys([key, *(int(n) for n in neighbours)]))


def pixels(views: Views, index: int, device: torch.device | str) -> Tensor:
    """(H, W, 3) uint8 of a view, on a device."""
    return _brought(views.images[index], device)


def shown(values: Tensor) -> Tensor:
    """(H, W, 3) uint8 → (1, 3, H, W) RGB in [0, 1]."""
    return values.permute(2, 0, 1)[None] / 255


def picture(views: Views, index: int, device: torch.device | str) -> Tensor:
    """(1, 3, H, W) RGB in [0, 1]."""
    return shown(pixels(views, index, device))


def sensed(views: Views, index: int, device: torch.device | str) -> Tensor | None:
    """(H, W) of a view's depth along z in working units, None where it has none."""
    depth = views.depths[index] if views.depths else None
    return None if depth is None else _brought(np.asarray(depth, np.float32), device)


def _brought(values: Array, device: torch.device | str) -> Tensor:
    """Values on a device."""
    found = torch.from_numpy(np.ascontiguousarray(values))
    if torch.device(device).type == "cuda":  # from memory that stays in place, which nobody has to wait for
        found = found.pin_memory().to(device, non_blocking=True)
    return found.to(device)
