"""The loop over key frames: local volumes in, one global volume out (NeRFusion, section 3.2), as frames stream in.

Coarse to fine within each key frame: the coarse lattice is worked on everywhere in the frusta, each finer one only in the cells that the
coarse global volume does not see through, starting from the coarse latents there. Memory a key frame is bounded by its frusta at the coarse
level and by surface at the finer ones; encoded images are cached only as long as a key frame near them may come.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import torch
from torch import Tensor

from fieldfuse.backends.dispatch import is_cpu
from fieldfuse.capture.types import Views
from fieldfuse.errors import InputError
from fieldfuse.nerfusion.cameras import Cameras, depth_range, frustum
from fieldfuse.nerfusion.extras.keyframe_depth import KeyframeDepth
from fieldfuse.nerfusion.extras.matching import SIDE, SIDE_WITHIN
from fieldfuse.nerfusion.extras.plane_sweep import DepthDistribution, Empty, sweep_planes
from fieldfuse.nerfusion.extras.two_lattices import allowed_cells, split_volume
from fieldfuse.nerfusion.images import ImageCache, Recent
from fieldfuse.nerfusion.keyframes import KeyFrames
from fieldfuse.nerfusion.lattice import LatentVolume, Lattice, LocalVolume, merged
from fieldfuse.nerfusion.model import NerfusionModel
from fieldfuse.nerfusion.precision import FLOAT32, computing
from fieldfuse.nerfusion.store import GlobalStore, ValueStore
from fieldfuse.nerfusion.unproject import EncodedView, KeyFrame
from fieldfuse.progress import SILENT, Progress
from fieldfuse.volume.topology import BLOCK, VOXELS, Topology

CACHED = 12  # encoded images for key frames to come …
CACHED_ON_DEVICE = 32  # … and where they are encoded ahead, 20 MB each at 640×480
AHEAD = 4  # key frames whose images are encoded at once there: it takes as many launches as one


@dataclass(frozen=True)
class FusionOptions:
    """How key frames are fused."""

    levels: int = 2  # lattices, each of half the voxel size of the one before; 1: the paper's single one
    near: float = 0.0  # depths along z within which views count, working units (the paper: 3 m)
    far: float = math.inf
    gamma: float = 0.95  # coarse cells in which exp(−optical thickness) exceeds this are not looked at finer
    prune_every: int = 8  # key frames after which blocks without such cells are forgotten
    measured: bool = False  # the depth that a sensor measured for key frames goes into their sweep (not in the paper)
    precision: str = FLOAT32  # of the networks' arithmetic (`nerfusion.precision`)
    empty: Empty | None = None  # where there is for sure nothing (not in the paper)


@dataclass(frozen=True)
class Fused:
    """The state after a key frame."""

    frame: int  # index of the key frame's image
    seconds: float  # spent on this key frame
    encode_seconds: float  # of these, on encoding images
    fusion: Fusion

    @cached_property
    def volume(self) -> LatentVolume:
        """The finest global volume; shares memory with the loop, valid until it goes on."""
        return self.fusion.volume

    @cached_property
    def allowed(self) -> Tensor:
        """(M · 512,) bool, cells whose coarser ones are not see-through; to be read before the loop goes on."""
        return self.fusion.allowed()


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
        local = model.local_volume(frame, store.lattice, topology, None if finer is None else finer.known)
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
    """The global volumes of all levels, and one step of the loop.

    Args:
        lattice: the finest.

    Raises:
        InputError: the lattice cannot be halved so often.
    """

    def __init__(self, model: NerfusionModel, lattice: Lattice, options: FusionOptions | None = None) -> None:
        self.model, self.options = model, options or FusionOptions()
        levels = self.options.levels
        if levels < 1 or lattice.resolution % (BLOCK * 2 ** (levels - 1)):
            raise InputError(f"a lattice of {lattice.resolution} voxels a side does not have {levels} levels; choose fewer")
        sizes = [lattice.resolution >> step for step in range(levels - 1, -1, -1)]
        self.stores = [GlobalStore(Lattice(lattice.space, size), model.config.channels, model.device) for size in sizes]

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
            meanwhile: called once a device of its own has been waited for the last time, so that it delays nothing.
        """
        options, lattice = self.options, self.stores[0].lattice
        topology = frustum(lattice, cameras, options.near, options.far, self.model.device)
        if distribution is None:
            bounded = options.near > 0 or math.isfinite(options.far)
            limits = (options.near, options.far) if bounded else depth_range(lattice, topology, cameras)
            distribution = sweep_planes([view.descriptors for view in views], cameras, *limits, depth, options.empty)
        frame = KeyFrame(views, cameras, options.near, options.far, distribution)
        fuse_key_frame(self.model, frame, self.stores, topology, partial(self.model.surface_cells, gamma=options.gamma), meanwhile)

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


class _EncodedViews:
    """Encoded views, the most recently used ones cached."""

    def __init__(self, model: NerfusionModel, images: ImageCache, side: int | None, precision: str) -> None:
        self.model, self.images, self.side, self.precision = model, images, side, precision
        self.ahead = 1 if is_cpu(model.device) else AHEAD
        self._cached: Recent[tuple[EncodedView, Cameras]] = Recent(CACHED if self.ahead == 1 else CACHED_ON_DEVICE)

    def __call__(self, groups: Sequence[Sequence[int]]) -> list[tuple[EncodedView, Cameras]]:
        """The views of the first of `groups`; where one of them is new, those of `ahead` groups that are new are encoded together."""
        self.prepare(groups)
        return [self._cached.get(index, self._one) for index in groups[0]]

    def prepare(self, groups: Sequence[Sequence[int]]) -> None:
        """On a device of its own: begin with what a call with `groups` will need, if there are any, while there is other work to do."""
        if self.ahead == 1 or not groups or all(index in self._cached for index in groups[0]):
            return
        group = groups[0]
        for index in group:  # they stay when others come
            if index in self._cached:
                self._cached.get(index, self._one)
        some = dict.fromkeys(index for one in groups[: self.ahead] for index in one if index not in self._cached)
        shape = self.images.views.images[group[0]].shape
        new = [index for index in some if self.images.views.images[index].shape == shape][: CACHED_ON_DEVICE - len(group)]
        for index, made in zip(new, self._encode(new), strict=True) if new else ():
            self._cached.put(index, made)

    def _one(self, index: int) -> tuple[EncodedView, Cameras]:
        return self._encode([index])[0]

    @torch.no_grad()
    def _encode(self, indices: Sequence[int]) -> list[tuple[EncodedView, Cameras]]:
        views, device = self.images.views, self.model.device
        cameras = Cameras.of([views.intrinsics[index] for index in indices], views.world_from_camera[list(indices)], device)
        with computing(self.precision, device):
            encoded = self.model.encode(torch.cat([self.images(index) for index in indices]), cameras, self.side)
        return [(view, cameras[number]) for number, view in enumerate(encoded)]


def fuse_views(
    model: NerfusionModel,
    views: Views,
    key_frames: KeyFrames,
    lattice: Lattice,
    options: FusionOptions | None = None,
    progress: Progress = SILENT,
    others: Sequence[Sequence[int]] | None = None,
) -> Iterator[Fused]:
    """Fuse key frames one after the other; yields after each, so that a preview can be rendered meanwhile.

    Args:
        others: of each key frame, other ones (places among them, `keyframe_depth.overlapping`) that its depth distribution is checked
            against (not in the paper); needs a nearest or a farthest depth, and goes without `options.empty` (docs/measured/few_views.md,
            "Within silhouettes").

    Raises:
        InputError: no key frames, or a lattice that does not fit the options.
        Interrupted: the user asked to stop.
        ValueError: other key frames and what is empty were both given.
    """
    options = options or FusionOptions()
    if options.empty is not None and others is not None:
        raise ValueError("key frames check each other where nothing is known to be empty; give one of the two")
    if len(key_frames.indices) == 0:
        raise InputError("there are no key frames to fuse; give more pictures")
    fusion = Fusion(model, lattice, options)
    images = ImageCache(views, model.device, options.measured)
    side = None if others is not None else SIDE if options.empty is None else SIDE_WITHIN
    encoded = _EncodedViews(model, images, side, options.precision)
    checked = None if others is None else KeyframeDepth(images, key_frames, others, options.near, options.far)
    groups = [key_frames.group(at) for at in range(len(key_frames.indices))]
    for done, key in enumerate(key_frames.indices):
        progress.check()
        begin = time.perf_counter()
        group = encoded(groups[done:])
        encode_seconds = time.perf_counter() - begin
        depth, distribution = (images.depth(int(key)), None) if checked is None else (None, checked(done))
        with computing(options.precision, model.device):
            cameras, coming = Cameras.together([camera for _, camera in group]), partial(encoded.prepare, groups[done + 1 :])
            fusion.add([view for view, _ in group], cameras, depth, distribution, coming)
        if (done + 1) % options.prune_every == 0:
            fusion.prune()
        yield Fused(int(key), time.perf_counter() - begin, encode_seconds, fusion)
        progress.update(done + 1, len(key_frames.indices), f"{fusion.stores[-1].blocks} blocks")
