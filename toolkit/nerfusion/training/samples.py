"""What one training step sees: images of a scene, its key frames with their neighbours, images to predict, and the space around them.

Regions of interest differ on purpose, as captures do: from a small object before a far background (which then lies in the contracted shell)
to a box around everything.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.errors import InputError
from fieldfuse.nerfusion.cameras import Cameras
from fieldfuse.nerfusion.extras.cross_view_consistency import all_consistent
from fieldfuse.nerfusion.extras.matching import SIDE, patch_descriptors
from fieldfuse.nerfusion.extras.plane_sweep import DepthDistribution, cost_volume
from fieldfuse.nerfusion.training.settings import PictureSettings, VolumeSettings
from fieldfuse.volume.space import Space

SWEET = (0.2, 0.6)  # how different neighbours of a key frame are (see `view_distance`); around an object that is 6° to 17° of parallax
POOL = 16  # images of an object that a sample chooses among
SHELL = 1.0  # width of the contracted shell, as fits use it
MARGIN = 1.05
POINTS = 4000
FEWEST = 16  # points or depths that locate a scene
LEAST, STEP = 32, 8  # of the resolution
Rows = list[tuple[list[int], list[int]]]  # references and targets of each key frame


@dataclass(frozen=True)
class Pictures:
    """Images of one size of one scene."""

    images: Tensor  # (V, 3, H, W) float32 RGB in [0, 1]
    intrinsics: Tensor  # (V, 4) float32 fx, fy, cx, cy in pixels, pixel centres at +0.5
    world_from_camera: Tensor  # (V, 4, 4) float32, OpenCV axes
    depths: Tensor  # (V, H, W) float32 along z, 0 = unknown
    background: tuple[float, float, float] | None = None  # colour where rays meet nothing; None: every ray meets something

    @classmethod
    def of(
        cls,
        images: Sequence[Tensor],
        cameras: Sequence[Intrinsics],
        world_from_camera: Array,
        depths: Sequence[Array | None],
        background: tuple[float, float, float] | None,
    ) -> Pictures:
        """V images (H, W, 3) uint8, cameras, (V, 4, 4) poses, and depths (H, W), None or not finite where unknown."""
        blank = np.zeros(images[0].shape[:2], np.float32)
        filled = [blank if depth is None else np.nan_to_num(depth, posinf=0, neginf=0) for depth in depths]
        return cls(
            torch.stack([image.permute(2, 0, 1).float() / 255 for image in images]).contiguous(),
            torch.tensor([[c.fx, c.fy, c.cx, c.cy] for c in cameras], dtype=torch.float32),
            torch.from_numpy(world_from_camera.astype(np.float32)),
            torch.from_numpy(np.stack(filled)).float(),
            background,
        )

    def __len__(self) -> int:
        return len(self.images)

    def to(self, device: torch.device | str) -> Pictures:
        """The same images on another device."""
        images, intrinsics, poses = self.images.to(device), self.intrinsics.to(device), self.world_from_camera.to(device)
        return Pictures(images, intrinsics, poses, self.depths.to(device), self.background)

    def cameras(self, indices: Tensor) -> Cameras:
        """The networks' cameras of some images."""
        height, width = self.images.shape[2:]
        return Cameras.same_size(self.intrinsics[indices], self.world_from_camera[indices], width, height)


class TrainingScene(Protocol):
    """A scene that samples are drawn from; its images are made or read on demand."""

    name: str
    kind: str  # "object" | "room"
    ordered: bool  # neighbours in the list are neighbours in time
    world_from_camera: Array  # (N, 4, 4) float64 of every frame
    depth_hint: float | None  # typical depth where images come without depth

    def pictures(self, indices: Sequence[int]) -> Pictures:
        """The frames at `indices`."""
        ...


@dataclass(frozen=True)
class Sample:
    """One step's data. All indices are into `pictures`."""

    name: str
    pictures: Pictures
    references: Tensor  # (F, K) int64: each key frame (first column) and its K − 1 neighbours
    targets: Tensor  # (F, T) int64: images near each key frame, and others, that are not among its references
    space: Space
    resolution: int  # voxels along the side of the space's cube
    near: float  # nearest depth that matters, along z
    far: float  # farthest depth that local volumes reach

    def to(self, device: torch.device | str) -> Sample:
        """The same sample on another device."""
        return replace(self, pictures=self.pictures.to(device), references=self.references.to(device), targets=self.targets.to(device))


def draw_sample(scene: TrainingScene, rng: np.random.Generator, wanted: PictureSettings, volume: VolumeSettings, key_frames: int) -> Sample:
    """A sample of a scene.

    The frame of reference is moved to the first key frame's place in float64 before anything becomes float32.

    Raises:
        InputError: too few frames, or neither depth nor a hint of it.
    """
    references, targets = choose_views(scene, rng, wanted, key_frames)
    used, places = np.unique(np.concatenate([references.ravel(), targets.ravel()]), return_inverse=True)
    pictures = scene.pictures([int(i) for i in used])
    poses = np.array(scene.world_from_camera[used], dtype=np.float64)
    poses[:, :3, 3] -= scene.world_from_camera[references[0, 0], :3, 3]
    pictures = replace(pictures, world_from_camera=torch.from_numpy(poses.astype(np.float32)).to(pictures.images.device))
    own = torch.from_numpy(places[: references.size].reshape(references.shape)).long()
    others = torch.from_numpy(places[references.size :].reshape(targets.shape)).long()
    near, middle, far = depth_range(pictures.depths[own.unique()], scene.depth_hint, scene.name)
    key = int(own[0, 0])
    ahead = poses[key, :3, 3] + middle * poses[key, :3, 2]
    share, closed = float(rng.uniform(volume.region[0], volume.region[1])), bool(rng.random() < volume.closed)
    space = region_around(surface_points(pictures, own.unique()), (ahead, 0.6 * middle), share, closed)
    low, high = volume.voxels_to_median
    voxel = middle / math.exp(rng.uniform(math.log(low), math.log(high)))
    resolution = lattice_resolution(space, voxel, volume.most)
    return Sample(scene.name, pictures, own, others, space, resolution, 0.7 * near, max(1.1 * far, 1.5 * middle))


# Which frames ----------------------------------------------------------------------------------------------------------------------------


def view_distance(poses: Array, depth: float) -> Array:
    """(N, N) how differently two cameras see: distance of their places counted in `depth`, plus the angle between their directions."""
    places = poses[:, :3, 3] / depth
    apart = np.linalg.norm(places[:, None] - places[None], axis=-1)
    cosine = np.clip(poses[:, :3, 2] @ poses[:, :3, 2].T, -1, 1)
    return np.asarray(apart + np.arccos(cosine))


def choose_views(scene: TrainingScene, rng: np.random.Generator, wanted: PictureSettings, key_frames: int) -> tuple[Array, Array]:
    """Key frames with their references (F, K) and the images to predict (F, T), as indices into the scene (NeRFusion, section 4).

    Videos of rooms: key frames are 2–5% of the frames, one after the other in time, at least a few frames apart; references are
    neighbours in time. Otherwise: 16 frames are drawn, key frames among them, and references are near in place and direction, at a
    difference that suits matching.
    Half of the targets are frames close to the key frame (videos: between its references or just beyond), the others are from anywhere;
    none is one that it refers to.

    Raises:
        InputError: fewer frames than one key frame, its references and one target need.
    """
    poses = scene.world_from_camera
    if len(poses) < wanted.views + 1:
        raise InputError(f"a training scene needs at least {wanted.views + 1} frames, this one has {len(poses)}; leave it out")
    by_time = scene.ordered and scene.kind == "room"
    rows = _by_time(len(poses), rng, wanted, key_frames) if by_time else _by_place(scene, rng, wanted, key_frames)
    return np.array([refer for refer, _ in rows]), np.array([targets for _, targets in rows])


def _by_time(count: int, rng: np.random.Generator, wanted: PictureSettings, key_frames: int) -> Rows:
    views, targets = wanted.views, wanted.targets
    stride = max(views, round(1 / rng.uniform(0.02, 0.05)))
    stride = max(1, min(stride, (count - 1) // max(key_frames, 1)))
    # References stand between the neighbouring key frames, so that what a key frame sees overlaps with them.
    step = max(1, min(stride, count // (views + 1)))
    offsets = sorted(range(-views, views + 1), key=lambda k: (abs(k), k < 0))
    first = int(rng.integers(0, max(1, count - stride * (key_frames - 1))))
    rows = []
    for number in range(key_frames):
        key = min(first + number * stride, count - 1)
        refer = [key + k * step for k in offsets if 0 <= key + k * step < count][:views]
        spare = [i for i in range(count) if i not in refer]
        reach = max(2, min(len(spare), 2 * targets, (views - 1) * step + 1))
        close = sorted(spare, key=lambda i: (abs(i - key), i))[:reach]
        rows.append((refer, _near_and_far(rng, close, spare, targets)))
    return rows


def _by_place(scene: TrainingScene, rng: np.random.Generator, wanted: PictureSettings, key_frames: int) -> Rows:
    poses = scene.world_from_camera
    pool = np.sort(rng.permutation(len(poses))[:POOL])
    apart = view_distance(poses[pool], scene.depth_hint or 1.0)
    # A walk from one key frame to the nearest one not yet used, as frames of a capture would stream in.
    order = [int(rng.integers(len(pool)))]
    while len(order) < key_frames:
        left = apart[order[-1]].copy()
        left[order] = np.inf
        order.append(int(np.argmin(left)) if np.isfinite(left).any() else order[-1])
    rows = []
    sweet = float(np.exp(rng.uniform(np.log(SWEET[0]), np.log(SWEET[1]))))
    for key in order:
        # Neighbours at about one difference, on different sides of the key frame: parallax varies between samples, not within one.
        refer, cost = [key], np.abs(apart[key] - sweet)
        while len(refer) < wanted.views:
            cost[refer[-1]] = np.inf
            refer.append(int(np.argmin(cost)))
            cost = cost - 0.25 * np.minimum(apart[refer[-1]], 2 * sweet)
        near = [int(i) for i in np.argsort(apart[key], kind="stable") if int(i) not in refer]
        targets = _near_and_far(rng, near[: 2 * wanted.targets], near, wanted.targets)
        rows.append(([int(pool[i]) for i in refer], [int(pool[i]) for i in targets]))
    return rows


def _near_and_far(rng: np.random.Generator, close: list[int], everywhere: list[int], count: int) -> list[int]:
    """Half of the targets from nearby, the others from anywhere, some twice where there are few: seen from nearby alone, an image painted
    right before the key frame's camera is as good as a surface, and from everywhere else it is fog."""
    out = []
    for among, some in ((close, count - count // 2), (everywhere, count // 2)):
        order = [among[i] for i in rng.permutation(len(among))]
        out += (order * -(-some // len(order)))[:some]
    return out


# Where the lattice lies ------------------------------------------------------------------------------------------------------------------


def depth_range(depths: Tensor, hint: float | None, where: str) -> tuple[float, float, float]:
    """Nearest, median and farthest depth (1st, 50th, 99th percentile) of (V, H, W) depths, or guesses around `hint` without them.

    Raises:
        InputError: neither depth nor a hint.
    """
    known = depths[depths > 0]
    if len(known) < FEWEST:
        if hint is None:
            raise InputError(f"{where}: neither depth images nor cameras give the depth of the scene; remove it")
        return 0.5 * hint, hint, 2.0 * hint
    part = known[:: max(1, len(known) // 20000)].double()
    near, middle, far = torch.quantile(part, part.new_tensor([0.01, 0.5, 0.99])).tolist()
    return near, middle, far


def surface_points(pictures: Pictures, indices: Tensor) -> Tensor:
    """(N, 3) evenly chosen points of the surfaces that the images at `indices` show, from their depth."""
    view, row, column = (pictures.depths[indices] > 0).nonzero(as_tuple=True)
    keep = torch.arange(0, len(view), max(1, len(view) // POINTS), device=view.device)
    view, row, column = indices.to(view.device)[view[keep]], row[keep], column[keep]
    depth = pictures.depths[view, row, column]
    fx, fy, cx, cy = pictures.intrinsics[view].unbind(1)
    local = torch.stack([(column + 0.5 - cx) / fx * depth, (row + 0.5 - cy) / fy * depth, depth], 1)
    pose = pictures.world_from_camera[view]
    return (pose[:, :3, :3] @ local[:, :, None])[:, :, 0] + pose[:, :3, 3]


def region_around(points: Tensor, fallback: tuple[Array, float], part: float, closed: bool) -> Space:
    """A region of interest.

    Args:
        points: (N, 3) of surfaces, working frame.
        fallback: centre (3,) and half size where there are no points.
        part: share of the points that the region holds, around their middle; the rest lies in the shell.
        closed: a bare box around nearly all points instead, with nothing beyond it.
    """
    if len(points) < FEWEST:
        return Space(_triple(fallback[0]), float(fallback[1]), SHELL)
    if closed:
        low, high = torch.quantile(points, points.new_tensor([0.005, 0.995]), dim=0)
        size = ((high - low) / 2 * MARGIN).clamp_min(1e-6)
        half = float(size.max())
        box = _triple((size / half).clamp_min(0.05).double().cpu().numpy())
        return Space(_triple(((low + high) / 2).double().cpu().numpy()), half, 0.0, box)
    middle = points.median(0).values
    reach = (points - middle).abs().amax(1)
    half = float(torch.quantile(reach, part).clamp_min(1e-6)) * MARGIN
    return Space(_triple(middle.double().cpu().numpy()), half, SHELL)


def _triple(values: Array) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in values)
    return x, y, z


def lattice_resolution(space: Space, voxel_size: float, most: int) -> int:
    """Voxels along the side of the space's cube so that one inside the region is about `voxel_size`, a multiple of 8 up to `most`."""
    wanted = 2 * space.extent * space.half / voxel_size
    return int(np.clip(STEP * round(wanted / STEP), LEAST, most))


@torch.no_grad()
def keyframe_distributions(sample: Sample) -> list[DepthDistribution]:
    """The depth distribution of each key frame, checked against all others as in direct inference (not in the paper).

    Nothing in it is learned, so key frames that are fused later may take part.
    """
    descriptors, pictures = patch_descriptors(sample.pictures.images, SIDE), sample.pictures
    return all_consistent(
        [
            cost_volume([descriptors[index] for index in numbers], pictures.cameras(indices), sample.near, sample.far)
            for indices, numbers in zip(sample.references, sample.references.tolist(), strict=True)
        ]
    )
