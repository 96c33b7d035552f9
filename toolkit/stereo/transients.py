"""What moves: where an image shows something else than several others agree on at the same place, and the masks of it.

People who walk through, the photographer's own shadow, what was put elsewhere meanwhile: a fit explains them by things that hang before
single cameras, and errors draw its rays there. Steps: points of other images' depth maps are warped into each image; where at least three
of them agree on the nearest surface, their mean is its colour; the image's own is compared with it. What is off by more than elsewhere,
and solid, counts as moving, with what nothing confirms right beside it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from safetensors.numpy import save_file

from fieldfuse.backends.numba.depth_maps import nearest_agreed, warp
from fieldfuse.camera import Array, Intrinsics, invert
from fieldfuse.capture.types import Views
from fieldfuse.files import atomic_path
from fieldfuse.progress import SILENT, Progress
from fieldfuse.stereo.consistency import numbers
from fieldfuse.stereo.cost_volume import shrunk
from fieldfuse.stereo.maps import opened
from fieldfuse.stereo.match import StereoDepth, resized, shrunk_camera, side_by_side, usable_neighbours, usable_pixels
from fieldfuse.stereo.plane_completion import spread_along

AGREED = 3  # images that must have the same surface
SAME = 0.04  # share of depth within which points are of one surface
SHARE, MOST_SHARE = 0.04, 0.1  # of a fit's seconds that looking is meant to take, and may take on the smallest images
SIDES = (96, 200)  # pixels; of the images that are looked at
VIEW_SECONDS = 0.025  # of an image of the largest side, on one thread of a nominal machine
FEWEST = 24  # images with depth by matching: with fewer, what has none before what has looks as if it moved
COMPARED = 12  # images that show what stands at a place, at most
LEAST_OFF = 20.0  # levels by which a colour must be off, besides what the others' colours scatter by …
USUAL = 0.9  # … and what this share of the confirmed pixels of the capture is off by
CONFIRMED_OFF = 0.5  # of that, below which a colour confirms the others
BEFORE, BEFORE_OFF = 0.1, 0.25  # share of depth by which measured depth lies before the consensus where so little of that is enough
BLUR = 0.7  # pixels, before colours are compared
AWAY, EDGE = 0.1, 30.0  # of the long side, levels: how far votes go in an image; see `plane_completion.spread_along`
LEAST_VOTES = 0.02
SOLID = 0.03  # of the long side: what is thinner is an edge that was warped a little off
LEAST_SHARE = 0.004  # of the image: what is smaller may be a highlight
OFF_SHARE = 0.25  # of a part's pixels that must be off themselves
REACH = 0.08  # of the long side: how far a part goes on through what nothing confirms
CLOSE = 0.03  # of the long side: gaps that are closed
GAINS = (0.5, 2.0)  # by which an image may be darker or brighter than the others
FEW = 200  # pixels that measure an image's gain
# Share of all images, and of a single one, beyond which it is no longer something that moves before a still scene: poses, light or depth
# disagree, and a fit without those pixels would have holes.
MOST_OF_ALL, MOST_OF_ONE = 0.25, 0.6
MOST_SIDE = 2**13  # pixels; masks are small, so a file with a larger one is damaged


@dataclass(frozen=True)
class Consensus:
    """What stands in each pixel of one image by several others."""

    count: Array  # (H, W) int32 images that agree, 0 below `AGREED`
    depth: Array  # (H, W) float32 mean of theirs, 0 = unknown
    colour: Array  # (H, W, 3) float32 mean of theirs, levels
    scatter: Array  # (H, W) float32 standard deviation of theirs, levels


def consensus(
    camera: Intrinsics, pose: Array, depths: Sequence[Array], images: Sequence[Array], lenses: Sequence[Intrinsics], poses: Array
) -> Consensus:
    """What the images with these depths, warped into the camera at `pose` (4, 4), agree on.

    Args:
        depths: (h, w) float32 along z, 0 = missing.
        images: (h, w, 3) uint8 of the depth maps' sizes, `lenses` their cameras.
        poses: (N, 4, 4) world from camera of these.
    """
    shape = (camera.height, camera.width)
    warped, colours = np.zeros((len(depths), *shape), np.float32), np.zeros((len(depths), *shape, 3), np.uint8)
    for number, (depth, image, lens) in enumerate(zip(depths, images, lenses, strict=True)):
        there = invert(pose) @ poses[number]
        source = np.ascontiguousarray(depth, dtype=np.float32)
        warp(source, image, numbers(lens), numbers(camera), there, warped[number], colours[number])
    out = Consensus(np.zeros(shape, np.int32), np.zeros(shape, np.float32), np.zeros((*shape, 3), np.float32), np.zeros(shape, np.float32))
    nearest_agreed(warped, colours, AGREED, SAME, out.count, out.depth, out.colour, out.scatter)
    return out


@dataclass(frozen=True)
class _Difference:
    off: Array  # (H, W) float32 levels by which the image differs from the consensus, 0 where there is none
    known: Array  # (H, W) bool there is a consensus
    same: Array  # (H, W) bool the image's own depth is that of the consensus
    own: Array  # (H, W) bool the image has depth of its own there, too
    before: Array  # (H, W) bool this depth lies well before the consensus
    scatter: Array  # (H, W) float32 levels, of the colours that agree


def bounded(masks: Sequence[Array]) -> list[Array]:
    """The masks (h, w) bool that may show what moves: none where they take too much of all images, and none of a single one that is taken
    nearly whole."""
    if not masks or float(np.mean([mask.mean() for mask in masks])) > MOST_OF_ALL:
        return [np.zeros_like(mask) for mask in masks]
    return [np.zeros_like(mask) if mask.mean() > MOST_OF_ONE else mask for mask in masks]


def moving(
    views: Views,
    depths: Sequence[Array | None],
    cameras: Sequence[Intrinsics],
    median_depth: float,
    measured: bool = False,
    progress: Progress = SILENT,
) -> list[Array]:
    """Pixels of each of `views` (training images alone: leave held-out ones out before) that show what moves.

    Images without depth are looked at, too: their colours alone are held against the others'.

    Args:
        depths: (h, w) float32 along z, working units, 0 = missing; matched or measured; None: not known.
        cameras: pinhole, of the size that images are compared at, and of the depth maps.
        median_depth: depth at which parallax and overlap of images are judged.
        measured: a sensor's depths.

    Returns:
        (h, w) bool, one a view.

    Raises:
        Interrupted: the user asked to stop.
    """
    with_depth = [index for index, depth in enumerate(depths) if depth is not None]
    if len(with_depth) <= AGREED:
        return [np.zeros((camera.height, camera.width), bool) for camera in cameras]
    poses = np.asarray(views.world_from_camera, dtype=np.float64)
    wanted = int(np.ceil(COMPARED * len(views) / len(with_depth)))
    beside = usable_neighbours(poses, list(cameras), median_depth, wanted)
    others = [[other for other in row if depths[other] is not None][:COMPARED] for row in beside]
    small = [np.asarray(cv2.GaussianBlur(shrunk(*each), (0, 0), BLUR)) for each in zip(views.images, cameras, strict=True)]

    def compared(index: int) -> _Difference:
        progress.check()
        row = others[index]
        theirs = [depth for other in row if (depth := depths[other]) is not None]
        agreed = consensus(cameras[index], poses[index], theirs, [small[o] for o in row], [cameras[o] for o in row], poses[row])
        return _difference(agreed, small[index], depths[index], usable_pixels(views, index, cameras[index]))

    differences = list(side_by_side(compared, len(views)))
    usual = [one.off[one.known & one.same] for one in differences]
    noise = float(np.quantile(np.concatenate(usual), USUAL)) if any(map(len, usual)) else 0.0

    def solid(index: int) -> Array:
        progress.check()
        return _solid(differences[index], small[index], LEAST_OFF + noise, measured)

    return list(side_by_side(solid, len(views)))


def plan(views: int, budget: float) -> int | None:
    """Long side to look at so many images at, for a fit of `budget` seconds; None: they are too many for so short a fit."""
    least, most = SIDES
    if views * VIEW_SECONDS * (least / most) ** 2 > MOST_SHARE * budget:
        return None
    return int(np.clip(most * np.sqrt(SHARE * budget / max(views * VIEW_SECONDS, 1e-9)), least, most)) // 8 * 8


def depths_at(
    views: Views, long_side: int, matched: Mapping[int, StereoDepth] | None = None
) -> tuple[list[Array | None], list[Intrinsics]]:
    """Depth maps with this long side at most, and their cameras: those that were `matched` (by the view's index), or else the views' own.

    Each pixel has one of the depths that it covers, and none where the view's mask excludes it.
    """
    if matched:
        long_side = min(long_side, max(max(one.depth.shape) for one in matched.values()))
    cameras = [shrunk_camera(camera, long_side) for camera in views.intrinsics]
    out: list[Array | None] = list(views.depths) if matched is None and views.depths else [None] * len(views)
    for index, one in (matched or {}).items():
        out[index] = one.depth
    for index, (depth, camera) in enumerate(zip(out, cameras, strict=True)):
        if depth is not None:
            usable, small = usable_pixels(views, index, camera), resized(depth, camera)
            out[index] = small if usable is None else np.where(usable, small, np.float32(0))
    return out, cameras


def _difference(agreed: Consensus, image: Array, depth: Array | None, usable: Array | None) -> _Difference:
    """The image against the consensus, as bright as that; by how much it is off the range of colours around a pixel, since points are
    warped to the nearest pixel."""
    known = agreed.count > 0 if usable is None else (agreed.count > 0) & usable
    own = np.zeros(known.shape, bool) if depth is None else known & (depth > 0)
    same, before = own, own
    if depth is not None:
        same, before = own & (np.abs(depth - agreed.depth) < SAME * agreed.depth), own & (depth < (1 - BEFORE) * agreed.depth)
    alike = same if depth is not None else known
    gain = np.ones(3, np.float32)
    if alike.sum() >= FEW:
        ratio = (agreed.colour[alike] + 8) / (image[alike].astype(np.float32) + 8)
        gain = np.clip(np.median(ratio, axis=0), *GAINS)
    window = np.ones((3, 3), np.uint8)
    low, high = cv2.erode(image, window) * gain, cv2.dilate(image, window) * gain
    beyond = np.maximum(np.maximum(low - agreed.colour, agreed.colour - high), 0)
    off = np.where(known, np.sqrt(np.mean(np.square(beyond), axis=2)), 0).astype(np.float32)
    return _Difference(off, known, same, own, before, agreed.scatter)


def _solid(one: _Difference, image: Array, least_off: float, measured: bool) -> Array:
    """(H, W) bool parts of the image that are off.

    Where depth is measured, an image's own must speak for it, too: sensors' depth lies a few pixels beside its colour, and what they miss
    (screens, glass, the border of an image) looks different from everywhere. Matching misses what moves.
    """
    side = max(one.off.shape)
    limit = least_off + one.scatter
    off = one.known & ~one.same & (one.off > limit)
    if measured:
        off = (off & one.own) | (one.before & (one.off > BEFORE_OFF * limit))
    if off.sum() < LEAST_SHARE * off.size:
        return np.zeros(off.shape, bool)
    confirmed = one.same | (one.known & ~off & (one.off < CONFIRMED_OFF * limit))
    off = _opened(off, np.ones((2, 2), np.uint8))
    votes = np.stack([off, confirmed], axis=2).astype(np.float32)
    spread_along(image, votes, AWAY * side, EDGE)
    parts = _opened((votes[..., 0] > votes[..., 1]) & (votes[..., 0] > LEAST_VOTES), _disc(SOLID / 2 * side))
    count, label = cv2.connectedComponents(parts.astype(np.uint8), connectivity=8)
    inside, area = np.bincount(label[off], minlength=count), np.bincount(label.ravel(), minlength=count)
    kept = (inside >= LEAST_SHARE * off.size) & (inside >= OFF_SHARE * area)
    kept[0] = False
    out = kept[label]
    if not out.any():
        return np.asarray(out)
    for _ in range(round(REACH * side)):
        further = (cv2.dilate(out.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0) & (out | ~confirmed)
        if (further == out).all():
            break
        out = further
    gap = max(1, round(CLOSE * side))
    framed = cv2.copyMakeBorder(out.astype(np.uint8), gap, gap, gap, gap, cv2.BORDER_REPLICATE)
    closed = cv2.morphologyEx(framed, cv2.MORPH_CLOSE, _disc(gap))[gap:-gap, gap:-gap] > 0
    return np.asarray(cv2.dilate(_opened(closed, np.ones((3, 3), np.uint8)).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)


def _opened(mask: Array, window: Array) -> Array:
    return np.asarray(cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, window) > 0)


def _disc(radius: float) -> Array:
    size = 2 * max(1, round(radius)) + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)))


@dataclass(frozen=True)
class LeftOut:
    """What of some images is excluded, since it moves; see `moving`."""

    looked_at: int  # images
    share: float  # of their pixels that are excluded
    masks: dict[str, Array]  # (h, w) bool, of the images where something is, by name; True: excluded
    seconds: float = 0.0  # that looking took

    @staticmethod
    def of(names: Sequence[str], masks: Sequence[Array], seconds: float = 0.0) -> LeftOut:
        """What the `masks` of the images `names` exclude."""
        share = float(np.mean([mask.mean() for mask in masks])) if masks else 0.0
        return LeftOut(len(names), share, {name: mask for name, mask in zip(names, masks, strict=True) if mask.any()}, seconds)

    def to_dict(self) -> dict[str, float]:
        return {"looked_at": self.looked_at, "pictures": len(self.masks), "share": round(self.share, 5), "seconds": round(self.seconds, 2)}

    def mask(self, name: str, width: int, height: int) -> Array:
        """(height, width) bool pixels of the image `name`, at this size, that are excluded."""
        if name not in self.masks:
            return np.zeros((height, width), bool)
        return np.asarray(cv2.resize(self.masks[name].astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0)

    def without(self, views: Views) -> Views:
        """`views` in which the excluded pixels are not valid, and have no depth."""
        valid: list[Array | None] = list(views.valid) if views.valid else [None] * len(views)
        depths = list(views.depths)
        for index, name in enumerate(views.names):
            if name not in self.masks:
                continue
            height, width = views.images[index].shape[:2]
            stays = ~self.mask(name, width, height)
            before = valid[index]
            valid[index] = stays if before is None else before & stays
            if depths and (depth := depths[index]) is not None:
                depths[index] = np.where(stays, depth, np.float32(0))
        return replace(views, valid=valid, depths=depths)


def save_left_out(path: Path | str, left_out: LeftOut) -> None:
    """Write it, eight pixels to a byte.

    Raises:
        OutputError: the file cannot be written.
    """
    tensors = {f"mask.{index}": np.packbits(mask) for index, mask in enumerate(left_out.masks.values())}
    shapes = {name: list(mask.shape) for name, mask in left_out.masks.items()}
    about = {"looked_at": left_out.looked_at, "share": left_out.share, "seconds": left_out.seconds, "shapes": shapes}
    with atomic_path(path) as temporary:
        save_file(tensors, temporary, metadata={"left_out": json.dumps(about)})


def load_left_out(path: Path | str) -> LeftOut:
    """What `save_left_out` wrote.

    Raises:
        InputError: missing or damaged.
    """
    with opened(path, "left_out") as (file, about):
        looked_at, share, seconds = int(about["looked_at"]), float(about["share"]), float(about["seconds"])
        masks: dict[str, Array] = {}
        if not (looked_at >= len(about["shapes"]) and 0 <= share <= 1 and 0 <= seconds < np.inf):
            raise ValueError("its numbers cannot be")
        for index, (name, (height, width)) in enumerate(about["shapes"].items()):
            bits = file.get_tensor(f"mask.{index}")
            if not (0 < height <= MOST_SIDE and 0 < width <= MOST_SIDE and bits.shape == (-(-height * width // 8),)):
                raise ValueError(f"the mask of {name!r:.80} does not have its size")
            masks[name] = np.unpackbits(bits, count=height * width).reshape(height, width).astype(bool)
        return LeftOut(looked_at, share, masks, seconds)
