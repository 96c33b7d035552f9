"""What one training step sees: pictures of a scene, its key frames with their reference views, and pictures to be predicted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import torch

from fieldfuse.camera import Array
from fieldfuse.errors import InputError
from fieldfuse.nerfusion.cameras import Cameras
from fieldfuse.nerfusion.extras.cross_view_consistency import all_consistent
from fieldfuse.nerfusion.extras.matching import SIDE, patch_descriptors
from fieldfuse.nerfusion.extras.plane_sweep import DepthDistribution, cost_volume
from fieldfuse.volume.space import Space

Tensor = torch.Tensor
SWEET = (0.2, 0.6)  # how different neighbours of a key frame are (see `view_distance`); around an object that is 6° to 17° of parallax


@dataclass(frozen=True)
class Pictures:
    """Pictures of one size of one scene."""

    images: Tensor  # (V, 3, H, W) float32 RGB in [0, 1]
    intrinsics: Tensor  # (V, 4) float32 fx, fy, cx, cy in pixels, pixel centres at +0.5
    world_from_camera: Tensor  # (V, 4, 4) float32, OpenCV axes
    depths: Tensor  # (V, H, W) float32 along z, 0 = unknown
    background: tuple[float, float, float] | None = None  # colour where rays meet nothing; None: every ray meets something

    def __len__(self) -> int:
        return len(self.images)

    def to(self, device: torch.device | str) -> Pictures:
        """The same pictures on another device."""
        return replace(
            self,
            images=self.images.to(device),
            intrinsics=self.intrinsics.to(device),
            world_from_camera=self.world_from_camera.to(device),
            depths=self.depths.to(device),
        )


class TrainingScene(Protocol):
    """A scene that samples can be drawn from; pictures are made or read only when they are asked for."""

    name: str
    kind: str  # "object" | "room"
    ordered: bool  # neighbours in the list are neighbours in time
    world_from_camera: Array  # (N, 4, 4) float64 of every frame
    depth_hint: float | None  # typical depth where pictures come without depth

    def pictures(self, indices: Sequence[int]) -> Pictures:
        """The frames at `indices`."""
        ...


@dataclass(frozen=True)
class Sample:
    """One step's data. All indices are into `pictures`."""

    name: str
    pictures: Pictures
    references: Tensor  # (F, K) int64: each key frame (first column) and its K − 1 neighbours
    targets: Tensor  # (F, T) int64: pictures near each key frame, and others, that are not among its references
    space: Space
    resolution: int  # voxels along the side of the space's cube
    near: float  # nearest depth that matters, along z
    far: float  # farthest depth that local volumes reach

    def to(self, device: torch.device | str) -> Sample:
        """The same sample on another device."""
        return replace(self, pictures=self.pictures.to(device), references=self.references.to(device), targets=self.targets.to(device))


def view_distance(poses: Array, depth: float) -> Array:
    """(N, N) how differently two cameras see: distance of their places counted in `depth`, plus the angle between their directions."""
    places = poses[:, :3, 3] / depth
    apart = np.linalg.norm(places[:, None] - places[None], axis=-1)
    cosine = np.clip(poses[:, :3, 2] @ poses[:, :3, 2].T, -1, 1)
    return np.asarray(apart + np.arccos(cosine))


@dataclass(frozen=True)
class Choice:
    """Frames of a scene that a sample uses (indices into the scene)."""

    references: Array  # (F, K)
    targets: Array  # (F, T)


def choose_views(
    poses: Array, ordered: bool, kind: str, rng: np.random.Generator, *, views: int, key_frames: int, targets: int, depth: float
) -> Choice:
    """Key frames, their references and the pictures to predict (NeRFusion, section 4).

    Videos of rooms: key frames are 2–5% of the frames, one after the other in time, at least a few frames apart; references are
    neighbours in time. Otherwise: 16 frames are drawn, key frames among them, and references are near in place and direction, at a
    difference that suits matching.
    Half of the targets are frames close to the key frame (videos: between its references or just beyond), the others are from anywhere;
    none is one that it refers to.

    Raises:
        InputError: fewer frames than one key frame, its references and one target need.
    """
    count = len(poses)
    if count < views + 1:
        raise InputError(f"a training scene needs at least {views + 1} frames, this one has {count}; leave it out")
    if ordered and kind == "room":
        return _by_time(count, rng, views, key_frames, targets)
    return _by_place(poses, rng, views, key_frames, targets, depth)


def _by_time(count: int, rng: np.random.Generator, views: int, key_frames: int, targets: int) -> Choice:
    stride = max(views, round(1 / rng.uniform(0.02, 0.05)))
    stride = max(1, min(stride, (count - 1) // max(key_frames, 1)))
    # References stand between the neighbouring key frames, so that what a key frame sees overlaps with them.
    step = max(1, min(stride, count // (views + 1)))
    offsets = sorted(range(-views, views + 1), key=lambda k: (abs(k), k < 0))
    first = int(rng.integers(0, max(1, count - stride * (key_frames - 1))))
    references, wanted = [], []
    for number in range(key_frames):
        key = min(first + number * stride, count - 1)
        near = [key + k * step for k in offsets if 0 <= key + k * step < count][:views]
        spare = [i for i in range(count) if i not in near]
        reach = max(2, min(len(spare), 2 * targets, (views - 1) * step + 1))
        close = sorted(spare, key=lambda i: (abs(i - key), i))[:reach]
        references.append(near)
        wanted.append(_near_and_far(rng, close, spare, targets))
    return Choice(np.array(references), np.array(wanted))


def _by_place(poses: Array, rng: np.random.Generator, views: int, key_frames: int, targets: int, depth: float) -> Choice:
    pool = np.sort(rng.permutation(len(poses))[:16])
    apart = view_distance(poses[pool], depth)
    # A walk from one key frame to the nearest one not yet used, as frames of a capture would stream in.
    order = [int(rng.integers(len(pool)))]
    while len(order) < key_frames:
        left = apart[order[-1]].copy()
        left[order] = np.inf
        order.append(int(np.argmin(left)) if np.isfinite(left).any() else order[-1])
    references, wanted = [], []
    sweet = float(np.exp(rng.uniform(np.log(SWEET[0]), np.log(SWEET[1]))))
    for key in order:
        # Neighbours at about one difference, on different sides of the key frame: parallax varies between samples, not within one.
        refer, cost = [key], np.abs(apart[key] - sweet)
        while len(refer) < views:
            cost[refer[-1]] = np.inf
            refer.append(int(np.argmin(cost)))
            cost = cost - 0.25 * np.minimum(apart[refer[-1]], 2 * sweet)
        near = [int(i) for i in np.argsort(apart[key], kind="stable") if int(i) not in refer]
        references.append([int(pool[i]) for i in refer])
        wanted.append([int(pool[i]) for i in _near_and_far(rng, near[: 2 * targets], near, targets)])
    return Choice(np.array(references), np.array(wanted))


def _near_and_far(rng: np.random.Generator, close: list[int], all_of_them: list[int], count: int) -> list[int]:
    """Half of the targets from nearby, the others from anywhere: seen from nearby alone, a picture painted right before the key frame's
    camera is as good as a surface, and from everywhere else it is fog.
    """
    return _draw(rng, close, count - count // 2) + _draw(rng, all_of_them, count // 2)


def _draw(rng: np.random.Generator, among: list[int], count: int) -> list[int]:
    """`count` of `among` in random order, some twice when there are fewer."""
    order = [among[i] for i in rng.permutation(len(among))]
    return (order * -(-count // len(order)))[:count]


def cameras_of(pictures: Pictures, indices: Tensor) -> Cameras:
    """The networks' cameras of some pictures."""
    height, width = pictures.images.shape[2:]
    return Cameras.same_size(pictures.intrinsics[indices], pictures.world_from_camera[indices], width, height)


@torch.no_grad()
def keyframe_distributions(sample: Sample, side: int = SIDE) -> list[DepthDistribution]:
    """The depth distribution of each key frame, checked against all others as in direct inference (not in the paper).

    Nothing in it is learned, so key frames that are fused later may be asked before.

    Args:
        side: pixels of the long side at which pictures are compared.
    """
    descriptors = patch_descriptors(sample.pictures.images, side)
    return all_consistent(
        [
            cost_volume([descriptors[index] for index in numbers], cameras_of(sample.pictures, indices), sample.near, sample.far)
            for indices, numbers in zip(sample.references, sample.references.tolist(), strict=True)
        ]
    )
