"""Depth maps that are mostly right, such as a field's, moved to where images agree best, and made to agree with each other.

A surface is made of them afterwards. What other views confirm and images show stays. Elsewhere a field's depth is a guess: few views see
the place, or nothing there could be recognised. There planes of what is sure go on: where most of it lies on a few large ones, as in a
room, wherever one explains the images as well as the guess does; else, since small planes are found in what is round, too, only beside
what is sure and near the guess (`plane_completion.py`). What is left of the guesses stays unless some other view sees through it.
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
from fieldfuse.stereo.consistency import DepthMaps, agreement, confirmed
from fieldfuse.stereo.cost_volume import GreyView, grey_view, refined, shrunk
from fieldfuse.stereo.match import (
    CHECKED,
    StereoDepth,
    inverse_depths,
    resized,
    shrunk_camera,
    side_by_side,
    usable_neighbours,
    usable_pixels,
)
from fieldfuse.stereo.plane_completion import SHOWN_SLANT, Unsure, proposal, shown_planes
from fieldfuse.stereo.planes import depth_of, find_planes, in_camera, points_of, shares

T = TypeVar("T")

NEIGHBOURS = 6  # images that a view is compared with
RECOGNISED = 0.3  # matching cost up to which a pixel was recognised in its neighbours; others keep the depth they had
MEASURED = 0.03  # share of a sensor's depth by which a field's may differ and be the same place

# Scenes of planes, where images decide which plane they show
CONFIRMED = 3  # views beside a view that must have the same point
ON = 0.003  # share of its depth by which a point may miss a plane that it is counted to: a fifth of what matched depth needs
MIN_SHARE, MAX_PLANES = 0.003, 40  # share of the points that a plane has, and planes: twice as many as in matched depth, which is worse
LARGE = 0.05  # share of the points that a large plane has
PLANAR = 0.6  # share of the points on large planes from which a scene is one of planes: small ones are found in what is round, too
RATHER = (0.1, -0.1)  # how much more a large plane may cost than a guess, and where a sensor's depth stands behind the guesses …
SMALL = 0.0  # … and how much more a small one may at most
COMPARED_SIDE = 320  # pixels along the side, at most, of the images that planes are compared in

# Others, where planes go on beside what is sure
CONFIRMED_BESIDE, ON_BESIDE = 2, 0.004
REACH = 3.0  # pixels of parallax between a guess and the plane that takes its place, at most


class Polisher:
    """Polishes depth maps of some views by the images of all of them: the last step of matching without its search.

    Args:
        views: images that may be looked at; leave held-out ones out before.
        cameras: pinhole of each view, of the size that its depth maps have.
        near, far: nearest and farthest depth, working units; they decide how far a step of depth moves a pixel.
        median_depth: depth at which parallax and overlap of images are judged.
    """

    def __init__(self, views: Views, cameras: Sequence[Intrinsics], near: float, far: float, median_depth: float) -> None:
        self._views, self._cameras, self._range = views, [camera.pinhole() for camera in cameras], (near, far)
        self._grey: dict[int, GreyView] = {}
        self._neighbours = usable_neighbours(views.world_from_camera, self._cameras, median_depth, NEIGHBOURS) if len(views) > 1 else [[]]

    def polished(self, index: int, depth: Array, measured: Array | None = None) -> tuple[Array, Array]:
        """(H, W) float32 depth of the view `index` along z, 0 = missing; moved by at most about a pixel of parallax, or as it was.

        And (H, W) bool, where it was recognised in other images: elsewhere, on bare walls, these show nothing of the depth.

        Args:
            measured: (H, W), in whatever size, a sensor's depth that went into `depth`, 0 = missing. Where it measured the same place
                nothing is moved: what errors poses and lenses have draw images away from it, and the surface is to lie on the sensor's.
        """
        near, far = self._range
        known = np.isfinite(depth) & (depth > 0)
        others = [self._image(other) for other in self._neighbours[index]]
        if not others or not known.any() or not 0 < near < far:
            return np.asarray(depth, dtype=np.float32), np.zeros(depth.shape, bool)
        view = self._image(index)
        planes = inverse_depths(view, others, near, far)
        start = 1 / np.where(known, depth, np.median(depth[known]))
        inverse, cost = refined(view, others, start, float(planes[1] - planes[0]))
        moved = known & (cost <= RECOGNISED) & (inverse > 0) & ~_same_place(depth, measured)
        return np.where(moved, 1 / np.maximum(inverse, 1e-12), np.where(known, depth, 0)).astype(np.float32), moved

    def _image(self, index: int) -> GreyView:
        if index not in self._grey:
            self._grey[index] = grey_view(self._views.images[index], self._cameras[index], self._views.world_from_camera[index])
        return self._grey[index]


@dataclass(frozen=True)
class FieldDepths:
    """What a field gives; lists have an entry a view, in one order."""

    reliable: Sequence[Array]  # (H, W) along z, working units, 0 = missing
    guesses: Sequence[Array]  # the same with what is less than reliable, such as edges; planes replace these, and none of missing ones
    # (H, W) bool where images show the depth; other views of one field agree on bare walls without more reason
    recognised: Sequence[Array]


def settled(
    given: FieldDepths,
    views: Views,
    cameras: Sequence[Intrinsics],
    median_depth: float,
    measured: Sequence[Array | None] = (),
    progress: Progress = SILENT,
) -> list[Array]:
    """The depth maps of all `views`, made to agree.

    Args:
        cameras: of the depth maps.
        median_depth: depth at which parallax and overlap of images are judged.
        measured: (H, W) a sensor's depth, in whatever size, 0 = missing, that went into the maps; empty: none did.

    Returns:
        (H, W) float32; as they were where no two views see the same from different places.

    Raises:
        Interrupted: the user asked to stop.
    """
    poses = np.asarray(views.world_from_camera, dtype=np.float64)
    lenses = [camera.pinhole() for camera in cameras]
    beside = usable_neighbours(poses, lenses, median_depth, CHECKED) if len(views) > 1 else [[]]
    if not any(beside):
        return [np.asarray(depth, dtype=np.float32) for depth in given.reliable]
    others = [[other for other in row if beside[other]] for row in beside]
    known, backed = given.recognised, any(depth is not None for depth in measured)
    if backed:
        known = [here | _same_place(depth, one) for here, depth, one in zip(known, given.reliable, measured, strict=True)]
    scene = _Settling(FieldDepths(given.reliable, given.guesses, known), views, lenses, poses, others, progress)
    sure = scene.sure(CONFIRMED)
    points = points_of(DepthMaps([one.depth for one in sure], lenses, poses))
    planes = find_planes(points, on=ON, least=MIN_SHARE, most=MAX_PLANES)
    share = shares(points, planes, ON)
    if share[share >= LARGE].sum() >= PLANAR:
        depths = scene.as_images_show(sure, planes, np.where(share >= LARGE, RATHER[backed], min(SMALL, RATHER[backed])))
    else:
        depths = scene.beside_what_is_sure()
    filled = [np.where(depth > 0, depth, guess).astype(np.float32) for depth, guess in zip(depths, given.reliable, strict=True)]
    return scene.not_seen_through(filled, [depth > 0 for depth in depths])


@dataclass(frozen=True)
class _Settling:
    """What `settled` works on."""

    given: FieldDepths
    views: Views
    lenses: list[Intrinsics]
    poses: Array  # (N, 4, 4)
    others: list[list[int]]  # views that a view's depth is checked against
    progress: Progress

    def each(self, of: Callable[[int], T]) -> list[T]:
        """`of` each view, several at once."""

        def interruptible(index: int) -> T:
            self.progress.check()
            return of(index)

        return list(side_by_side(interruptible, len(self.lenses)))

    def sure(self, needed: int) -> list[StereoDepth]:
        """What `needed` other views confirm, or all where there are fewer, and what images or a sensor show."""
        maps = DepthMaps(self.given.reliable, self.lenses, self.poses)

        def checked(index: int) -> StereoDepth:
            depth, confidence = confirmed(index, self.others[index], maps, min(needed, max(1, len(self.others[index]))))
            # Its own depth, not the mean with theirs, which are looked up at the nearest pixel; fusing the maps averages better.
            kept = np.where((depth > 0) & self.given.recognised[index], maps.depths[index], 0).astype(np.float32)
            return StereoDepth(kept, confidence, self.lenses[index])

        return self.each(checked)

    def not_seen_through(self, depths: Sequence[Array], sure: Sequence[Array]) -> list[Array]:
        """`depths` without what is not `sure` and some other view sees through."""
        maps = DepthMaps(depths, self.lenses, self.poses)

        def kept(index: int) -> Array:
            through = agreement(index, self.others[index], maps).through
            return np.where(sure[index] | (through == 0), depths[index], np.float32(0)).astype(np.float32)

        return self.each(kept)

    def as_images_show(self, sure: Sequence[StereoDepth], planes: Array, rather: Array) -> list[Array]:
        """What is sure, and planes wherever images show them."""
        small = []
        for index, one in enumerate(sure):
            camera, image = shrunk_camera(self.lenses[index], COMPARED_SIDE), self.views.images[index]
            held = resized((one.confidence > 0).astype(np.uint8), camera) > 0
            maps = (resized(one.depth, camera), resized(self.given.guesses[index], camera), held)
            small.append(Unsure(grey_view(image, camera, self.poses[index]), shrunk(image, camera), *maps))

        def continued(index: int) -> Array:
            lens, one, guess = self.lenses[index], sure[index], self.given.guesses[index]
            which = resized(shown_planes(index, small, planes, rather), lens)
            there = depth_of(which, lens, in_camera(planes, self.poses[index]), SHOWN_SLANT)
            open_, usable = (one.depth <= 0) & (guess > 0), usable_pixels(self.views, index, lens)
            return np.where(open_ if usable is None else open_ & usable, there, one.depth)

        return self.each(continued)

    def beside_what_is_sure(self) -> list[Array]:
        """What is sure, and planes that go on beside it in the image, near the guess and where no other view sees through."""
        sure = self.sure(CONFIRMED_BESIDE)
        depths = [one.depth for one in sure]
        planes = find_planes(points_of(DepthMaps(depths, self.lenses, self.poses)), on=ON_BESIDE)
        if not len(planes):
            return depths

        def continued(index: int) -> Array:
            one, lens, guess, pose = sure[index], self.lenses[index], self.given.guesses[index], self.poses[index]
            image = shrunk(self.views.images[index], lens)
            more = proposal(one, image, in_camera(planes, pose), usable_pixels(self.views, index, lens))
            apart = max((float(np.linalg.norm(self.poses[other][:3, 3] - pose[:3, 3])) for other in self.others[index]), default=0.0)
            both = (guess > 0) & (more > 0)
            shift = lens.fx * apart * np.abs(1 / np.where(both, guess, 1) - 1 / np.where(both, more, 1))
            return np.where(both & (one.depth <= 0) & (shift <= REACH), more, one.depth)

        return self.not_seen_through(self.each(continued), [depth > 0 for depth in depths])


def _same_place(depth: Array, measured: Array | None) -> Array:
    """(H, W) bool where a sensor measured about this depth (H, W), which it may have done in another size; None: it measured nothing."""
    if measured is None:
        return np.zeros(depth.shape, bool)
    theirs = cv2.resize(measured, depth.shape[::-1], interpolation=cv2.INTER_NEAREST)
    return np.asarray((theirs > 0) & (np.abs(theirs - depth) < MEASURED * theirs))
