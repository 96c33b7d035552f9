"""The start of a fit whose images' depth is known, measured or matched: which voxels can hold something, how thick, in which colour.

The classical start (`start.py`) goes by depth only where next to no image contradicts it, on the coarsest lattice. Here images vote,
voxel by voxel: what more than a few of them saw past is empty, what they measured is thick and has its colour, and what is unknown stays
as thin and grey as in the classical start. So a fit begins on a finer lattice, and has more of its rays left for the finest.
Not in the paper.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from fieldfuse.backends.numba.volume import add_points, vote
from fieldfuse.camera import Array, invert, unproject
from fieldfuse.capture.types import Views
from fieldfuse.config import Settings
from fieldfuse.poses.scene import Scene
from fieldfuse.render.field import Field
from fieldfuse.training.levels import FEATURE_NOISE, all_places, occupancy
from fieldfuse.training.start import (
    COARSEST,
    FEW_VIEWS,
    NEAR,
    THIN,
    WHOLE,
    colour_behind,
    finest_resolution,
    levels,
    new_decoder,
    possible,
    radii,
    space_of,
)
from fieldfuse.volume.space import Space
from fieldfuse.volume.topology import BLOCK, Topology

Tensor = torch.Tensor
RESOLUTION = 64  # voxels a side, where a part of the images' depth is known …
KNOWN, RESOLUTION_KNOWN = 0.9, 128  # … and where that much of it is: what is unknown is found on coarse lattices
THICK = 1.5  # raw density of what was measured
MOST_VIEWS = 80  # images with depth that vote, and as many without, evenly spread: more agree with these
PIECE = 4096  # voxels of the coarsest lattice whose parts are voted on at a time: memory is bounded
MOST_POINTS = 1_000_000  # that are put onto the lattice
ENOUGH = 1.0  # points that a corner needs about it to count as measured
PAST, PAST_SHARE = 1, 0.05  # images, and share of those with depth, that may see past what is not empty
SURFACE = 0.2  # images that measured a surface, for each one that saw past it, where it stays all the same


@dataclass(frozen=True)
class Votes:
    """Votes of images on voxels; those that have a surface before a voxel have none on it."""

    unknown: Array  # (N,) int32 images that look there, without depth
    past: Array  # (N,) … that measured something farther away
    here: Array  # (N,) … that measured a surface there

    def stays(self, views: int) -> Array:
        """(N,) bool: the voxels that can hold something, by the votes of so many images."""
        least = 2 if views >= FEW_VIEWS else 1
        surface = (self.here >= least) & (self.here > SURFACE * self.past)
        votes = self.unknown + self.past + self.here
        empty = self.past > np.maximum(PAST, PAST_SHARE * votes)
        seen = self.unknown + self.here > 0
        return np.asarray(surface | (seen & ~empty))


def starts_by_depth(views: Views, settings: Settings) -> bool:
    """Whether a fit of these views begins so: depth is known and believed, and alpha cuts nothing out. Depth that was matched has to be
    that of `FEW_VIEWS` training images: what few agree on is too often wrong (gum with 12 images lost 1.1 dB by it)."""
    known = sum(depth is not None and not test for depth, test in zip(views.depths, views.test, strict=False))
    return known >= (FEW_VIEWS if views.matched else 1) and settings.fit.depth > 0 and views.background is None


def depth_start(views: Views, scene: Scene, settings: Settings, device: torch.device | str = "cpu") -> Field:
    """The first field of a fit, at `RESOLUTION` voxels a side, or at `RESOLUTION_KNOWN` where nearly all depth is known (at the fit's
    finest, when that is less), from the training images and their depth. About a second.

    Args:
        views: all views, at least one training view with depth; held-out ones are not looked at.
    """
    torch.manual_seed(settings.seed)
    train = views.subset(np.flatnonzero(~np.asarray(views.test)))
    space = space_of(views, scene, settings.field.background)
    resolution = _resolution(space, train, scene, settings)
    some = train.subset(_voters(train))
    coarse, ratio = possible(space, COARSEST, all_places(space, COARSEST), train), resolution // COARSEST
    kept = []
    for part in coarse.split(PIECE):
        finer = _split(part, ratio)
        kept.append(finer[torch.from_numpy(votes(space, resolution, finer, some).stays(len(some)))])
    places = torch.cat(kept)
    if len(places) == 0:  # depth that contradicts itself everywhere
        places = _split(coarse, ratio)
    topology, occupied = occupancy(places)
    count, colour = measured(space, resolution, topology, train)
    known = count > ENOUGH
    channels = settings.field.channels
    feature = torch.randn(len(count), channels, generator=torch.Generator().manual_seed(settings.seed)) * FEATURE_NOISE
    feature[known, :3] = torch.logit((colour[known] / count[known, None]).clamp(0.02, 0.98))
    density = torch.where(known, THICK, THIN)
    density[-1], feature[-1] = 0, 0
    decoder = new_decoder(settings.field)
    return Field(space, resolution, topology, occupied, density, feature, decoder, colour_behind(views), NEAR * scene.near).to(device)


def votes(space: Space, resolution: int, places: Tensor, views: Views) -> Votes:
    """Votes of the depth of `views` on the voxels `places` (N, 3)."""
    # Also writeable: numba compiles kernels anew for arrays that are not.
    centres, radius = (np.require(one, requirements=("C", "W")) for one in radii(space, resolution, places, WHOLE))
    worlds = np.stack([invert(pose) for pose in views.world_from_camera])
    cameras = np.array([(c.fx, c.fy, c.cx, c.cy) for c in views.intrinsics])
    out = np.zeros((3, len(places)), np.int32)
    for index, depth in enumerate(views.depths):
        camera = views.intrinsics[index]
        known = np.zeros((camera.height, camera.width), np.float32) if depth is None else np.ascontiguousarray(depth, dtype=np.float32)
        vote(centres, radius, cameras[index], worlds[index], known, out)
    return Votes(*out)


def measured(space: Space, resolution: int, topology: Topology, views: Views) -> tuple[Tensor, Tensor]:
    """How many points of the depth of `views` lie about each corner of the lattice, those farther away counting less, and the sum of their
    colours, each channel 0 … 1: (M · 512 + 1,) and (M · 512 + 1, 3) float32, nothing in the zero row."""
    side = BLOCK * (resolution // BLOCK + 1)
    whole = np.zeros((side, side, side, 4), np.float32)
    deep = [index for index, depth in enumerate(views.depths) if depth is not None]
    pixels = sum(views.images[index][..., 0].size for index in deep)
    step = max(1, int(np.ceil(np.sqrt(pixels / MOST_POINTS))))
    for index in deep:
        points, colours = _points(views, index, step)
        at = (space.contract(space.normalise(torch.from_numpy(points))) + space.extent) * (resolution / (2 * space.extent))
        add_points(at.clamp(-1, side).numpy().astype(np.float32), colours, whole)
    blocks = whole.reshape(side // BLOCK, BLOCK, side // BLOCK, BLOCK, side // BLOCK, BLOCK, 4).transpose(0, 2, 4, 1, 3, 5, 6)
    x, y, z = topology.keys.long().unbind(1)
    rows = torch.from_numpy(blocks)[z, y, x].reshape(-1, 4)
    rows = torch.cat([rows, rows.new_zeros(1, 4)])
    return rows[:, 0], rows[:, 1:] / 255


def warm_up() -> None:
    """Have the kernels compiled, or loaded."""
    out = np.zeros((3, 1), np.int32)
    vote(np.zeros((1, 3)), np.ones(1), np.ones(4), np.eye(4), np.zeros((1, 1), np.float32), out)
    add_points(np.zeros((1, 3), np.float32), np.zeros((1, 3), np.uint8), np.zeros((2, 2, 2, 4), np.float32))


def _resolution(space: Space, train: Views, scene: Scene, settings: Settings) -> int:
    """Voxels a side: a doubling of the coarsest, among the fit's levels."""
    shares = [0.0 if depth is None else float(np.mean(depth > 0)) for depth in train.depths]
    wanted = RESOLUTION_KNOWN if np.mean(shares) >= KNOWN else RESOLUTION
    rungs = levels(settings.field.resolution or finest_resolution(space, train, scene))
    return max((rung for rung in rungs if rung <= wanted and rung & (rung - 1) == 0), default=COARSEST)


def _voters(train: Views) -> Array:
    """Indices of the images that vote."""
    deep = np.array([depth is not None for depth in train.depths])
    return np.concatenate([some[:: max(1, -(-len(some) // MOST_VIEWS))] for some in (np.flatnonzero(deep), np.flatnonzero(~deep))])


def _split(places: Tensor, ratio: int) -> Tensor:
    """(N, 3) voxels → (N · ratio³, 3) the finer ones in them."""
    line = torch.arange(ratio)
    inside = torch.stack(torch.meshgrid(line, line, line, indexing="ij"), -1).reshape(-1, 3)
    return (places[:, None] * ratio + inside).reshape(-1, 3)


def _points(views: Views, index: int, step: int) -> tuple[Array, Array]:
    """(P, 3) float64 points of every `step`th pixel that has depth and counts, and (P, 3) uint8 their colours."""
    depth, valid = views.depths[index], views.valid[index] if views.valid else None
    assert depth is not None
    known = (depth > 0) & np.isfinite(depth) & (True if valid is None else valid)
    first = step // 2
    row, column = np.nonzero(known[first::step, first::step])
    row, column = row * step + first, column * step + first
    pixels = np.stack([column, row], 1) + 0.5
    points = unproject(views.intrinsics[index], views.world_from_camera[index], pixels, depth[row, column].astype(np.float64))
    return points, views.images[index][row, column]
