"""The loop over key frames: local volumes in, one global volume out (NeRFusion, section 3.2), as frames stream in.

Coarse to fine within each key frame: the coarse lattice is asked everywhere in the frusta, each finer one only in the cells that the coarse
global volume does not see through, starting from the coarse latents there. Memory a key frame is bounded by its frusta at the coarse
level and by surface at the finer ones; encoded pictures are kept only as long as a key frame near them may come.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import torch
from torch import Tensor

from fieldfuse.backends.dispatch import is_cpu, to_device_async
from fieldfuse.capture.types import Views
from fieldfuse.errors import InputError
from fieldfuse.nerfusion.cameras import Cameras
from fieldfuse.nerfusion.cull import all_blocks, block_balls, depth_range, visible_at_once, visible_blocks
from fieldfuse.nerfusion.extras.keyframe_depth import KeyframeDepth
from fieldfuse.nerfusion.extras.matching import SIDE, SIDE_WITHIN
from fieldfuse.nerfusion.extras.plane_sweep import DepthDistribution, Empty
from fieldfuse.nerfusion.extras.two_lattices import allowed_cells, split_volume
from fieldfuse.nerfusion.images import ImageCache, Recent, image_of, sensor_depth, with_neighbours
from fieldfuse.nerfusion.keyframes import KeyFrames
from fieldfuse.nerfusion.lattice import LatentVolume, Lattice, LocalVolume, merged
from fieldfuse.nerfusion.model import NerfusionModel
from fieldfuse.nerfusion.precision import FLOAT32, computing
from fieldfuse.nerfusion.store import GlobalStore, ValueStore
from fieldfuse.nerfusion.unproject import EncodedView, KeyFrame
from fieldfuse.progress import SILENT, Progress
from fieldfuse.volume.space import Space
from fieldfuse.volume.topology import BLOCK, VOXELS, Topology

KEPT_PICTURES = 12  # encoded pictures kept for key frames to come …
KEPT_ON_DEVICE = 32  # … and where they are encoded ahead, 20 MB each at 640×480
AHEAD = 4  # key frames whose pictures are encoded at once there: it takes as many launches as one


@dataclass(frozen=True)
class FusionOptions:
    """How key frames are fused.

    Attributes:
        levels: lattices, each of half the voxel size of the one before; 1: the paper's single one.
        near, far: depths along z within which a view is asked, working units (the paper: 3 m).
        gamma: coarse cells in which exp(−optical thickness) exceeds this are not looked at finer.
        prune_every: key frames after which blocks without such cells are forgotten.
        measured: the depth that a sensor measured for key frames goes into their sweep, where there is one (not in the paper).
        precision: of the networks' arithmetic (`nerfusion.precision`).
    """

    levels: int = 2
    near: float = 0.0
    far: float = math.inf
    gamma: float = 0.95
    prune_every: int = 8
    measured: bool = False
    precision: str = FLOAT32


@dataclass(frozen=True)
class Fused:
    """The state after a key frame.

    Attributes:
        frame: index of the key frame's picture.
        seconds: spent on this key frame.
        encode_seconds: of these, on encoding pictures.
        look: finds `volume`.
        judge: finds `allowed`.
    """

    frame: int
    seconds: float
    encode_seconds: float
    look: Callable[[], LatentVolume]
    judge: Callable[[], Tensor]

    @cached_property
    def volume(self) -> LatentVolume:
        """The finest global volume, when it is first asked for; shares memory with the loop, valid until it goes on."""
        return self.look()

    @cached_property
    def allowed(self) -> Tensor:
        """(M · 512,) bool, cells whose coarser ones are not see-through; found when they are first asked for, before the loop goes on."""
        return self.judge()


def fusion_lattice(space: Space, voxel_size: float, levels: int) -> Lattice:
    """The finest lattice with voxels of about `voxel_size` (working units) that can be made in `levels` doublings.

    Raises:
        InputError: the voxel size is not positive, or too small for the space.
    """
    unit = BLOCK * 2 ** (levels - 1)
    if not (math.isfinite(voxel_size) and voxel_size > 0):
        raise InputError(f"the voxel size must be positive, not {voxel_size:g}")
    resolution = max(round(2 * space.extent * space.half / voxel_size / unit), 1) * unit
    if resolution > 4096:
        raise InputError(f"voxels of {voxel_size:.3g} are too small for a space {2 * space.half:.3g} wide; choose larger ones")
    return Lattice(space, resolution)


def fuse_key_frame(
    model: NerfusionModel,
    frame: KeyFrame,
    stores: Sequence[GlobalStore | ValueStore],
    topology: Topology | None,
    chosen: Callable[[LatentVolume, Tensor], Tensor],
    meanwhile: Callable[[], None] | None = None,
) -> LocalVolume:
    """One step of the loop, in inference and training alike: V = J(…), H' = GRU(H, V) on the coarsest lattice, then on finer ones.

    Args:
        stores: the global volumes, coarsest first; changed.
        topology: blocks of the coarsest lattice to work on; None: those in the key frame's frustum.
        chosen: (volume, (M · 512,) bool corners that the key frame sees) → (M · 512,) bool cells to work on finer (not in the paper).
        meanwhile: see `Fusion.add`.

    Returns:
        the local volume on the coarsest lattice.
    """
    coarsest: LocalVolume | None = None
    finer: LatentVolume | None = None
    for level, store in enumerate(stores):
        wanted, limits = None if finer is None else finer.known, (frame.near, frame.far)
        local = model.local_volume(frame.views, frame.cameras, store.lattice, topology, wanted, *limits, frame.distribution)
        coarsest = coarsest or local
        if meanwhile is not None and level + 1 == len(stores):
            meanwhile()
        before, seen = store.part(local.topology, finer), local.known
        after = model.fuse_part(before, local)
        store.write(after, seen)
        if level + 1 < len(stores):
            with torch.no_grad():  # each lattice is trained by its own loss
                # What was known before but is not seen now still makes cells whole.
                here = merged(before, after, seen)
                finer = split_volume(here, chosen(here, seen))
            topology = finer.topology
    assert coarsest is not None
    return coarsest


class Fusion:
    """The global volumes of all levels, and one step of the loop."""

    def __init__(self, model: NerfusionModel, lattice: Lattice, options: FusionOptions | None = None, empty: Empty | None = None) -> None:
        """
        Args:
            lattice: the finest.
            empty: where there is for sure nothing (not in the paper).

        Raises:
            InputError: the lattice cannot be halved so often.
        """
        self.model, self.options, self.empty = model, options or FusionOptions(), empty
        if self.options.levels < 1 or lattice.resolution % (BLOCK * 2 ** (self.options.levels - 1)):
            raise InputError(f"a lattice of {lattice.resolution} voxels a side does not have {self.options.levels} levels; choose fewer")
        steps = range(self.options.levels - 1, -1, -1)
        self.stores = [
            GlobalStore(Lattice(lattice.space, lattice.resolution >> step), model.config.channels, model.device) for step in steps
        ]
        self._keys = all_blocks(self.stores[0].lattice)  # the processor knows them all, and need not ask the device which are seen
        self._balls = block_balls(self.stores[0].lattice, self._keys)

    @torch.no_grad()
    def add(
        self,
        views: Sequence[EncodedView],
        cameras: Cameras,
        depth: Tensor | None = None,
        distribution: DepthDistribution | None = None,
        meanwhile: Callable[[], None] | None = None,
    ) -> None:
        """Fuse one key frame (first) and its neighbours.

        Args:
            depth: (H, W) of the key frame where a sensor measured it, working units.
            distribution: of the key frame's depth, where it was made already (`KeyframeDepth`); None: made here.
            meanwhile: called once a device of its own has been asked the last question, so that what it does delays no answer.
        """
        options, model = self.options, self.model
        topology = self._visible(cameras)
        if distribution is None:
            bounded = options.near > 0 or math.isfinite(options.far)
            limits = (options.near, options.far) if bounded else depth_range(self.stores[0].lattice, topology, cameras)
            distribution = model.sweep_planes(views, cameras, *limits, depth, self.empty)
        frame = KeyFrame(views, cameras, options.near, options.far, distribution)
        chosen = partial(model.surface_cells, gamma=options.gamma)
        fuse_key_frame(model, frame, self.stores, topology, chosen, meanwhile)

    def _visible(self, cameras: Cameras) -> Topology:
        """Blocks of the coarsest lattice in the frustum of the key frame."""
        near, far, device = self.options.near, self.options.far, self.model.device
        bounds = self.stores[0].lattice.bounds(device)
        if is_cpu(device):
            return Topology(self._keys[visible_blocks(*self._balls, cameras[0], near, far)], bounds=bounds)
        kept = self._keys.numpy()[visible_at_once(self._balls[0].numpy(), self._balls[1].numpy(), cameras[0], near, far)]
        return Topology(to_device_async(kept, device), bounds=bounds, host=kept)

    @property
    def volume(self) -> LatentVolume:
        """The finest global volume, sharing memory with the loop."""
        return self.stores[-1].volume()

    @torch.no_grad()
    def allowed(self, level: int = -1) -> Tensor:
        """(M · 512,) bool, cells of a level's volume (the finest) whose coarser ones are not see-through."""
        level %= self.options.levels
        fine = self.stores[level].topology
        if level == 0:
            return torch.ones(fine.zero_row, dtype=torch.bool, device=fine.device)
        coarse = self.stores[level - 1].volume()
        return allowed_cells(coarse, self.model.thickness(coarse), self.options.gamma, fine)

    def prune(self) -> None:
        """Forget blocks of the finer levels in which no cell is allowed any more."""
        for level in range(1, self.options.levels):
            self.stores[level].keep(self.allowed(level).view(-1, VOXELS).any(1))


class _Pictures:
    """Encoded pictures, the most recently used ones kept."""

    def __init__(self, model: NerfusionModel, views: Views, side: int | None, precision: str) -> None:
        self.model, self.views, self.side, self.precision = model, views, side, precision
        self.ahead = 1 if is_cpu(model.device) else AHEAD
        self.brought = None if self.ahead == 1 else ImageCache(views, model.device)
        self._kept: Recent[tuple[EncodedView, Cameras]] = Recent(KEPT_PICTURES if self.ahead == 1 else KEPT_ON_DEVICE)

    def __call__(self, groups: Sequence[Sequence[int]]) -> list[tuple[EncodedView, Cameras]]:
        """The pictures of the first of `groups`; where one of them is new, those of `ahead` groups that are new are encoded together."""
        self.prepare(groups)
        return [self._kept.get(index, self._one) for index in groups[0]]

    def prepare(self, groups: Sequence[Sequence[int]]) -> None:
        """On a device of its own: begin with what a call with `groups` will ask for, if there are any, while there is other work to do."""
        if self.ahead == 1 or not groups or all(index in self._kept for index in groups[0]):
            return
        group = groups[0]
        for index in group:  # they stay when others come
            if index in self._kept:
                self._kept.get(index, self._one)
        some = dict.fromkeys(index for one in groups[: self.ahead] for index in one if index not in self._kept)
        shape = self.views.images[group[0]].shape
        new = [index for index in some if self.views.images[index].shape == shape][: KEPT_ON_DEVICE - len(group)]
        for index, made in zip(new, self._encode(new), strict=True) if new else ():
            self._kept.put(index, made)

    def _one(self, index: int) -> tuple[EncodedView, Cameras]:
        return self._encode([index])[0]

    @torch.no_grad()
    def _encode(self, indices: Sequence[int]) -> list[tuple[EncodedView, Cameras]]:
        views, device = self.views, self.model.device
        lenses = [views.intrinsics[index] for index in indices]
        cameras = Cameras.of(lenses, views.world_from_camera[list(indices)], device)
        pictures = [image_of(views, index, device) if self.brought is None else self.brought(index) for index in indices]
        images = pictures[0] if len(pictures) == 1 else torch.cat(pictures)
        with computing(self.precision, device):
            encoded = self.model.encode(images, cameras, self.side)
        return [(view, cameras[number]) for number, view in enumerate(encoded)]


def fuse_views(
    model: NerfusionModel,
    views: Views,
    key_frames: KeyFrames,
    lattice: Lattice,
    options: FusionOptions | None = None,
    progress: Progress = SILENT,
    empty: Empty | None = None,
    witnesses: Sequence[Sequence[int]] | None = None,
) -> Iterator[Fused]:
    """Fuse key frames one after the other; yields after each, so that a preview can be rendered meanwhile.

    Args:
        empty: see `Fusion`.
        witnesses: of each key frame, other ones (places among them, `keyframe_depth.overlapping`) that its depth distribution is checked
            against (not in the paper); needs a nearest or a farthest depth, and goes without `empty` (docs/measured/few_views.md,
            "Within silhouettes").

    Raises:
        InputError: no key frames, or a lattice that does not fit the options.
        Interrupted: the user asked to stop.
        ValueError: witnesses and what is empty were both given.
    """
    if empty is not None and witnesses is not None:
        raise ValueError("key frames are witnesses of each other where nothing is known to be empty; give one of the two")
    if len(key_frames.indices) == 0:
        raise InputError("there are no key frames to fuse; give more pictures")
    fusion = Fusion(model, lattice, options, empty)
    side = None if witnesses is not None else SIDE if empty is None else SIDE_WITHIN
    encoded = _Pictures(model, views, side, fusion.options.precision)
    near, far, measured = fusion.options.near, fusion.options.far, fusion.options.measured
    sweeps = None if witnesses is None else KeyframeDepth(views, key_frames, witnesses, near, far, measured, model.device, encoded.brought)
    groups = [with_neighbours(int(key), neighbours) for key, neighbours in zip(key_frames.indices, key_frames.neighbours, strict=True)]
    for done, key in enumerate(key_frames.indices):
        progress.check()
        begin = time.perf_counter()
        group = encoded(groups[done:])
        encode_seconds = time.perf_counter() - begin
        depth = sensor_depth(views, int(key), model.device) if measured else None
        distribution = None if sweeps is None else sweeps(done)
        with computing(fusion.options.precision, model.device):
            cameras, coming = Cameras.together([camera for _, camera in group]), partial(encoded.prepare, groups[done + 1 :])
            fusion.add([view for view, _ in group], cameras, depth, distribution, coming)
        if (done + 1) % fusion.options.prune_every == 0:
            fusion.prune()
        seconds = time.perf_counter() - begin
        yield Fused(int(key), seconds, encode_seconds, fusion.stores[-1].volume, fusion.allowed)
        progress.update(done + 1, len(key_frames.indices), f"{fusion.stores[-1].blocks} blocks")
