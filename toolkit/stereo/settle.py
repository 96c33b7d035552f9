"""Depth maps that are mostly right, such as a field's, made to agree with each other before a surface is made of them.

What other views confirm and pictures tell stays. Elsewhere a field's depth is a guess: few views see the place, or nothing there could be
recognised. Where a plane of what is sure explains the pictures as well as the guess does (`on_planes.py`), it goes on there; what is left
of the guesses stays unless some other view sees through it.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from toolkit.camera import Array, Intrinsics
from toolkit.capture.types import Views
from toolkit.progress import SILENT, Progress
from toolkit.stereo.bare import points_of
from toolkit.stereo.check import agreement, confirmed
from toolkit.stereo.cost import grey_view, shrunk
from toolkit.stereo.match import CHECKED, StereoDepth, shrunk_camera, side_by_side, usable_neighbours, usable_pixels
from toolkit.stereo.on_planes import SLANT, Unsure, shown_planes
from toolkit.stereo.plane_maps import depth_of, in_camera
from toolkit.stereo.planes import find_planes

CONFIRMED = 3  # views beside a view that must have the same point
ON = 0.003  # share of its depth by which a point may miss a plane that it is counted to: a fifth of what matched depth needs
LEAST, MOST = 0.003, 40  # share of the points that a plane has, and planes: twice as many as matched depth needs, since depth is better
MEASURED = 0.03  # share of a sensor's depth by which a field's may differ and be the same place
RATHER = (0.1, -0.1)  # how much more a plane may cost than a guess, and where a sensor's depth stands behind the guesses
ASKED_SIDE = 320  # pixels along the side, at most, of the pictures that are asked which plane they show


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

    def checked(index: int) -> StereoDepth:
        progress.check()
        depth, confidence = confirmed(index, others[index], reliable, lenses, poses, needed=min(CONFIRMED, max(1, len(others[index]))))
        # Its own depth, not the mean with theirs, which are looked up at the nearest pixel; fusing the maps averages better.
        known = told[index] | _same(reliable[index], measured[index]) if backed else told[index]
        return StereoDepth(np.where((depth > 0) & known, reliable[index], 0).astype(np.float32), confidence, lenses[index])

    found = side_by_side(checked, len(views))
    sure = [one.depth for one in found]
    planes = find_planes(points_of(found, poses), on=ON, least=LEAST, most=MOST)
    if len(planes):
        asked = [_asked(views, index, lenses[index], sure[index], guesses[index]) for index in range(len(views))]

        def continued(index: int) -> Array:
            progress.check()
            which = _resized(shown_planes(index, asked, planes, RATHER[backed]), lenses[index])
            there = depth_of(which, lenses[index], in_camera(planes, poses[index]), SLANT)
            open_, usable = (sure[index] <= 0) & (guesses[index] > 0), usable_pixels(views, index, lenses[index])
            return np.where(open_ if usable is None else open_ & usable, there, sure[index])

        sure = side_by_side(continued, len(views))

    def filled(index: int) -> Array:
        return np.where(sure[index] > 0, sure[index], reliable[index]).astype(np.float32)

    depths = [filled(index) for index in range(len(views))]

    def kept(index: int) -> Array:
        progress.check()
        through = agreement(index, others[index], depths, lenses, poses).through
        return np.where((sure[index] > 0) | (through == 0), depths[index], np.float32(0)).astype(np.float32)

    return side_by_side(kept, len(views))


def _same(depth: Array, measured: Array | None) -> Array:
    """(H, W) bool where a sensor measured about this depth."""
    if measured is None:
        return np.zeros(depth.shape, bool)
    theirs = cv2.resize(measured, depth.shape[::-1], interpolation=cv2.INTER_NEAREST)
    return np.asarray((theirs > 0) & (np.abs(theirs - depth) < MEASURED * theirs))


def _asked(views: Views, index: int, lens: Intrinsics, sure: Array, guess: Array) -> Unsure:
    """A view at the size that it is asked at."""
    camera = shrunk_camera(lens, ASKED_SIDE)
    picture = views.images[index]
    grey = grey_view(picture, camera, views.world_from_camera[index])
    return Unsure(grey, shrunk(picture, camera), _resized(sure, camera), _resized(guess, camera))


def _resized(values: Array, camera: Intrinsics) -> Array:
    """(H, W) at a camera's size, each the nearest of them: depth is never averaged, nor are numbers."""
    if values.shape == (camera.height, camera.width):
        return values
    return np.asarray(cv2.resize(values, (camera.width, camera.height), interpolation=cv2.INTER_NEAREST))
