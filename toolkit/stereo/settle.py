"""Depth maps that are mostly right, such as a field's, made to agree with each other before a surface is made of them.

What other views confirm and pictures tell stays. Elsewhere a field's depth is a guess: few views see the place, or nothing there could be
recognised. There planes of what is sure go on: where most of it lies on a few large ones, as in a room, wherever one explains the pictures
as well as the guess does (`on_planes.py`); else, since small planes are found in what is round, too, only beside what is sure and near the
guess (`bare.py`). What is left of the guesses stays unless some other view sees through it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.capture.types import Views
from fieldfuse.progress import SILENT, Progress
from fieldfuse.stereo.bare import points_of, proposal
from fieldfuse.stereo.check import agreement, confirmed
from fieldfuse.stereo.cost import grey_view, shrunk
from fieldfuse.stereo.match import CHECKED, StereoDepth, shrunk_camera, side_by_side, usable_neighbours, usable_pixels
from fieldfuse.stereo.on_planes import SLANT, Unsure, shown_planes
from fieldfuse.stereo.plane_maps import depth_of, in_camera
from fieldfuse.stereo.planes import find_planes, shares

T = TypeVar("T")

# Scenes of planes, where pictures are asked which plane they show
CONFIRMED = 3  # views beside a view that must have the same point
ON = 0.003  # share of its depth by which a point may miss a plane that it is counted to: a fifth of what matched depth needs
MIN_SHARE, MAX_PLANES = 0.003, 40  # share of the points that a plane has, and planes: twice as many as in matched depth, which is worse
LARGE = 0.05  # share of the points that a large plane has
PLANAR = 0.6  # share of the points on large planes from which a scene is one of planes: small ones are found in what is round, too
RATHER = (0.1, -0.1)  # how much more a large plane may cost than a guess, and where a sensor's depth stands behind the guesses …
SMALL = 0.0  # … and how much more a small one may at most
ASKED_SIDE = 320  # pixels along the side, at most, of the pictures that are asked

# Others, where planes go on beside what is sure
CONFIRMED_BESIDE, ON_BESIDE = 2, 0.004
REACH = 3.0  # pixels of parallax between a guess and the plane that takes its place, at most

MEASURED = 0.03  # share of a sensor's depth by which a field's may differ and be the same place


@dataclass(frozen=True)
class _Maps:
    """What is settled; lists have an entry a view, in one order."""

    reliable: Sequence[Array]
    guesses: Sequence[Array]
    known: Sequence[Array]  # (H, W) bool where pictures or a sensor tell the depth
    views: Views
    lenses: list[Intrinsics]
    poses: Array  # (N, 4, 4)
    others: list[list[int]]  # views that a view's depth is checked against
    progress: Progress

    def each(self, of: Callable[[int], T]) -> list[T]:
        """`of` each view, several at once."""

        def asked(index: int) -> T:
            self.progress.check()
            return of(index)

        return side_by_side(asked, len(self.lenses))

    def sure(self, needed: int) -> list[StereoDepth]:
        """What `needed` other views confirm, or all where there are fewer, and what is known."""

        def checked(index: int) -> StereoDepth:
            fewest = min(needed, max(1, len(self.others[index])))
            depth, confidence = confirmed(index, self.others[index], self.reliable, self.lenses, self.poses, needed=fewest)
            # Its own depth, not the mean with theirs, which are looked up at the nearest pixel; fusing the maps averages better.
            kept = np.where((depth > 0) & self.known[index], self.reliable[index], 0).astype(np.float32)
            return StereoDepth(kept, confidence, self.lenses[index])

        return self.each(checked)

    def not_seen_through(self, depths: Sequence[Array], sure: Sequence[Array]) -> list[Array]:
        """`depths` without what is not `sure` and some other view sees through."""

        def kept(index: int) -> Array:
            through = agreement(index, self.others[index], depths, self.lenses, self.poses).through
            return np.where(sure[index] | (through == 0), depths[index], np.float32(0)).astype(np.float32)

        return self.each(kept)


def settled(
    reliable: Sequence[Array],
    guesses: Sequence[Array],
    told: Sequence[Array],
    views: Views,
    cameras: Sequence[Intrinsics],
    median_depth: float,
    measured: Sequence[Array | None] = (),
    progress: Progress = SILENT,
) -> list[Array]:
    """The depth maps of all `views`, made to agree.

    Args:
        reliable: (H, W) along z, working units, one a view, 0 = missing.
        guesses: the same with what is less than reliable, such as edges; planes take the place of these, and none of missing ones.
        told: (H, W) bool where the pictures tell the depth; other views of one field agree on bare walls without knowing more.
        cameras: of the depth maps.
        median_depth: what parallax and overlap of pictures are judged at.
        measured: (H, W) a sensor's depth, in whatever size, 0 = missing, that what rendered the maps knew; empty: it knew none.

    Returns:
        (H, W) float32; as they were where no two views see the same from different places.

    Raises:
        Interrupted: the user asked to stop.
    """
    poses = np.asarray(views.world_from_camera, dtype=np.float64)
    lenses = [camera.pinhole() for camera in cameras]
    beside = usable_neighbours(poses, lenses, median_depth, CHECKED) if len(views) > 1 else [[]]
    if not any(beside):
        return [np.asarray(depth, dtype=np.float32) for depth in reliable]
    others = [[other for other in row if beside[other]] for row in beside]
    backed = any(depth is not None for depth in measured)
    known = [where | same_place(depth, one) for where, depth, one in zip(told, reliable, measured, strict=True)] if backed else told
    maps = _Maps(reliable, guesses, known, views, lenses, poses, others, progress)
    sure = maps.sure(CONFIRMED)
    points = points_of(sure, poses)
    planes = find_planes(points, on=ON, least=MIN_SHARE, most=MAX_PLANES)
    share = shares(points, planes, ON)
    if share[share >= LARGE].sum() >= PLANAR:
        rather = np.where(share >= LARGE, RATHER[backed], min(SMALL, RATHER[backed]))
        depths = _as_pictures_show(maps, sure, planes, rather)
    else:
        depths = _beside_what_is_sure(maps)
    filled = [np.where(depth > 0, depth, guess).astype(np.float32) for depth, guess in zip(depths, reliable, strict=True)]
    return maps.not_seen_through(filled, [depth > 0 for depth in depths])


def _as_pictures_show(maps: _Maps, sure: Sequence[StereoDepth], planes: Array, rather: Array) -> list[Array]:
    """What is sure, and planes wherever pictures show them (`on_planes.py`)."""
    asked = [_asked(maps, index, one) for index, one in enumerate(sure)]

    def continued(index: int) -> Array:
        lens, one, guess = maps.lenses[index], sure[index], maps.guesses[index]
        which = _resized(shown_planes(index, asked, planes, rather), lens)
        there = depth_of(which, lens, in_camera(planes, maps.poses[index]), SLANT)
        open_, usable = (one.depth <= 0) & (guess > 0), usable_pixels(maps.views, index, lens)
        return np.where(open_ if usable is None else open_ & usable, there, one.depth)

    return maps.each(continued)


def _beside_what_is_sure(maps: _Maps) -> list[Array]:
    """What is sure, and planes that go on beside it in the picture (`bare.py`), near the guess and where no other view sees through."""
    sure = maps.sure(CONFIRMED_BESIDE)
    planes = find_planes(points_of(sure, maps.poses), on=ON_BESIDE)
    if not len(planes):
        return [one.depth for one in sure]

    def continued(index: int) -> Array:
        one, lens, guess = sure[index], maps.lenses[index], maps.guesses[index]
        picture, usable = shrunk(maps.views.images[index], lens), usable_pixels(maps.views, index, lens)
        plan = proposal(one, picture, maps.poses[index], planes, usable)
        apart = [float(np.linalg.norm(maps.poses[other][:3, 3] - maps.poses[index][:3, 3])) for other in maps.others[index]]
        both = (guess > 0) & (plan.depth > 0)
        shift = lens.fx * max(apart, default=0.0) * np.abs(1 / np.where(both, guess, 1) - 1 / np.where(both, plan.depth, 1))
        return np.where(plan.new & both & (shift <= REACH), plan.depth, one.depth)

    return maps.not_seen_through(maps.each(continued), [one.depth > 0 for one in sure])


def same_place(depth: Array, measured: Array | None) -> Array:
    """(H, W) bool where a sensor measured about this depth (H, W), which it may have done in another size; None: it measured nothing."""
    if measured is None:
        return np.zeros(depth.shape, bool)
    theirs = cv2.resize(measured, depth.shape[::-1], interpolation=cv2.INTER_NEAREST)
    return np.asarray((theirs > 0) & (np.abs(theirs - depth) < MEASURED * theirs))


def _asked(maps: _Maps, index: int, sure: StereoDepth) -> Unsure:
    """A view at the size that it is asked at."""
    camera, picture = shrunk_camera(maps.lenses[index], ASKED_SIDE), maps.views.images[index]
    grey = grey_view(picture, camera, maps.poses[index])
    held = _resized((sure.confidence > 0).astype(np.uint8), camera) > 0
    return Unsure(grey, shrunk(picture, camera), _resized(sure.depth, camera), _resized(maps.guesses[index], camera), held)


def _resized(values: Array, camera: Intrinsics) -> Array:
    """(H, W) at a camera's size, each the nearest of them: depth is never averaged, nor are numbers."""
    if values.shape == (camera.height, camera.width):
        return values
    return np.asarray(cv2.resize(values, (camera.width, camera.height), interpolation=cv2.INTER_NEAREST))
