"""What moves: where a picture shows something else than several others agree on at the same place.

People who pass, the photographer's own shadow, what was put elsewhere meanwhile: a fit explains them by things that hang before single
cameras, and errors draw its rays there. Steps: points of other pictures' depth maps are carried into each picture; where at least three of
them agree on the nearest surface, their mean is its colour; the picture's own is held against it. What is off by more than elsewhere, and
solid, counts as moving, with what nothing confirms right beside it. `left_out.py` holds what was found.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.capture.types import Views
from fieldfuse.progress import SILENT, Progress
from fieldfuse.stereo.bare import spread_along
from fieldfuse.stereo.consensus import AGREED, SAME, Consensus, consensus
from fieldfuse.stereo.cost import shrunk
from fieldfuse.stereo.match import StereoDepth, shrunk_camera, side_by_side, usable_neighbours, usable_pixels

SHARE, MOST_SHARE = 0.04, 0.1  # of a fit's seconds that looking is meant to take, and may take on the smallest pictures
SIDES = (96, 200)  # pixels; of the pictures that are looked at
VIEW_SECONDS = 0.025  # of a picture of the largest side, on one thread of a nominal machine
FEWEST = 24  # pictures with depth by matching: with fewer, what has none before what has looks as if it moved
ASKED = 12  # pictures that tell what stands at a place, at most
LEAST_OFF = 20.0  # levels by which a colour must be off, besides what the others' colours scatter by …
USUAL = 0.9  # … and what this share of the confirmed pixels of the capture is off by
CONFIRMED_OFF = 0.5  # of that, below which a colour confirms what the others say
BEFORE, BEFORE_OFF = 0.1, 0.25  # share of depth by which measured depth lies before the consensus where so little of that is enough
BLUR = 0.7  # pixels, before colours are compared
AWAY, EDGE = 0.1, 30.0  # of the long side, levels: how far votes go in a picture; see `bare.spread_along`
LEAST_VOTES = 0.02
SOLID = 0.03  # of the long side: what is thinner is an edge that was carried a little off
LEAST_SHARE = 0.004  # of the picture: what is smaller may be a highlight
OFF_SHARE = 0.25  # of a part's pixels that must be off themselves
REACH = 0.08  # of the long side: how far a part goes on through what nothing confirms
CLOSE = 0.03  # of the long side: gaps that are closed
GAINS = (0.5, 2.0)  # by which a picture may be darker or brighter than the others
FEW = 200  # pixels that tell a picture's gain
# Share of all images, and of a single one, beyond which it is no longer something that moves before a still scene: poses, light or depth
# disagree, and a fit without those pixels would have holes.
MOST_OF_ALL, MOST_OF_ONE = 0.25, 0.6


@dataclass(frozen=True)
class _Difference:
    off: Array  # (H, W) float32 levels by which the picture differs from the consensus, 0 where there is none
    known: Array  # (H, W) bool there is a consensus
    same: Array  # (H, W) bool the picture's own depth is that of the consensus
    own: Array  # (H, W) bool the picture has depth of its own there, too
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
    """Pixels of each of `views` (training pictures alone: leave held-out ones out before) that show what moves.

    Pictures without depth are looked at, too: their colours alone are held against the others'.

    Args:
        depths: (h, w) float32 along z, working units, 0 = missing; matched or measured; None: not known.
        cameras: pinhole, of the size that pictures are compared at, and of the depth maps.
        median_depth: what parallax and overlap of pictures are judged at.
        measured: a sensor's depths.

    Returns:
        (h, w) bool, one a view.

    Raises:
        Interrupted: the user asked to stop.
    """
    telling = [index for index, depth in enumerate(depths) if depth is not None]
    if len(telling) <= AGREED:
        return [np.zeros((camera.height, camera.width), bool) for camera in cameras]
    poses = np.asarray(views.world_from_camera, dtype=np.float64)
    wanted = int(np.ceil(ASKED * len(views) / len(telling)))
    beside = usable_neighbours(poses, list(cameras), median_depth, wanted)
    others = [[other for other in row if depths[other] is not None][:ASKED] for row in beside]
    small = [
        np.asarray(cv2.GaussianBlur(shrunk(picture, camera), (0, 0), BLUR)) for picture, camera in zip(views.images, cameras, strict=True)
    ]

    def compared(index: int) -> _Difference:
        progress.check()
        row = others[index]
        theirs = [depth for other in row if (depth := depths[other]) is not None]
        agreed = consensus(cameras[index], poses[index], theirs, [small[o] for o in row], [cameras[o] for o in row], poses[row])
        return _difference(agreed, small[index], depths[index], usable_pixels(views, index, cameras[index]))

    differences = side_by_side(compared, len(views))
    usual = [one.off[one.known & one.same] for one in differences]
    noise = float(np.quantile(np.concatenate(usual), USUAL)) if any(map(len, usual)) else 0.0

    def solid(index: int) -> Array:
        progress.check()
        return _solid(differences[index], small[index], LEAST_OFF + noise, measured)

    return side_by_side(solid, len(views))


def plan(views: int, budget: float) -> int | None:
    """Long side to look at so many pictures at, for a fit of `budget` seconds; None: they are too many for so short a fit."""
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
    known: list[Array | None] = [None] * len(views)
    if matched is None and views.depths:
        known = list(views.depths)
    for index, one in (matched or {}).items():
        known[index] = one.depth
    usable = [usable_pixels(views, index, camera) for index, camera in enumerate(cameras)]
    return [_nearest(*each) for each in zip(known, cameras, usable, strict=True)], cameras


def _nearest(depth: Array | None, camera: Intrinsics, usable: Array | None) -> Array | None:
    if depth is None:
        return None
    small = np.asarray(cv2.resize(depth, (camera.width, camera.height), interpolation=cv2.INTER_NEAREST))
    return small if usable is None else np.where(usable, small, np.float32(0))


def _difference(agreed: Consensus, picture: Array, depth: Array | None, usable: Array | None) -> _Difference:
    """The picture against the consensus, as bright as that; by how much it is off the range of colours around a pixel, since points are
    carried to the nearest pixel."""
    known = agreed.count > 0 if usable is None else (agreed.count > 0) & usable
    own = np.zeros(known.shape, bool) if depth is None else known & (depth > 0)
    same, before = own, own
    if depth is not None:
        same, before = own & (np.abs(depth - agreed.depth) < SAME * agreed.depth), own & (depth < (1 - BEFORE) * agreed.depth)
    telling = same if depth is not None else known
    gain = np.ones(3, np.float32)
    if telling.sum() >= FEW:
        ratio = (agreed.colour[telling] + 8) / (picture[telling].astype(np.float32) + 8)
        gain = np.clip(np.median(ratio, axis=0), *GAINS)
    window = np.ones((3, 3), np.uint8)
    low, high = cv2.erode(picture, window) * gain, cv2.dilate(picture, window) * gain
    beyond = np.maximum(np.maximum(low - agreed.colour, agreed.colour - high), 0)
    off = np.where(known, np.sqrt(np.mean(np.square(beyond), axis=2)), 0).astype(np.float32)
    return _Difference(off, known, same, own, before, agreed.scatter)


def _solid(one: _Difference, picture: Array, least_off: float, measured: bool) -> Array:
    """(H, W) bool parts of the picture that are off.

    Where depth is measured, a picture's own must speak for it, too: sensors' depth lies a few pixels beside its colour, and what they miss
    (screens, glass, the border of a picture) looks different from everywhere. Matching misses what moves.
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
    spread_along(picture, votes, AWAY * side, EDGE)
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
