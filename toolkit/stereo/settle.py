"""Depth maps that are mostly right, such as a field's, made to agree with each other before a surface is made of them.

What other views confirm stays. Elsewhere a field's depth is a guess: few views see the place, or nothing there could be recognised. A plane
that goes on from what was confirmed (`bare.py`) knows it better, as long as no view sees through it; a guess stays where there is no such
plane and no view sees through the guess either.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from toolkit.camera import Array, Intrinsics
from toolkit.capture.types import Views
from toolkit.progress import SILENT, Progress
from toolkit.stereo.bare import CONFIRMED, points_of, proposal
from toolkit.stereo.check import agreement, confirmed
from toolkit.stereo.cost import shrunk
from toolkit.stereo.match import CHECKED, StereoDepth, side_by_side, usable_neighbours, usable_pixels
from toolkit.stereo.planes import find_planes

ON = 0.004  # share of its depth by which a point may miss a plane that it is counted to: a quarter of what matched depth needs
REACH = 3.0  # pixels of parallax between a guess and the plane that takes its place, at most


def settled(
    reliable: Sequence[Array],
    guesses: Sequence[Array],
    told: Sequence[Array],
    views: Views,
    cameras: Sequence[Intrinsics],
    median_depth: float,
    progress: Progress = SILENT,
) -> list[Array]:
    """The depth maps of all `views`, made to agree.

    Args:
        reliable: (H, W) along z, working units, one a view, 0 = missing.
        guesses: the same with what is less than reliable, such as edges; planes take the place of these, and none of missing ones.
        told: (H, W) bool where the pictures tell the depth; other views of one field agree on bare walls without knowing more.
        cameras: of the depth maps.
        median_depth: what parallax and overlap of pictures are judged at.

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

    def checked(index: int) -> StereoDepth:
        progress.check()
        depth, confidence = confirmed(index, others[index], reliable, lenses, poses, needed=min(CONFIRMED, max(1, len(others[index]))))
        # Its own depth, not the mean with theirs, which are looked up at the nearest pixel; fusing the maps averages better.
        return StereoDepth(np.where((depth > 0) & told[index], reliable[index], 0).astype(np.float32), confidence, lenses[index])

    sure = side_by_side(checked, len(views))
    planes = find_planes(points_of(sure, poses), on=ON)

    def continued(index: int) -> Array:
        progress.check()
        one = sure[index]
        picture, usable = shrunk(views.images[index], lenses[index]), usable_pixels(views, index, lenses[index])
        plan = proposal(one, picture, poses[index], planes, usable)
        near = _near(guesses[index], plan.depth, _parallax(index, others, lenses, poses))
        return np.where(plan.new & near, plan.depth, one.depth)

    gone_on = side_by_side(continued, len(views)) if len(planes) else [one.depth for one in sure]
    kept = _seen_through(gone_on, [one.depth > 0 for one in sure], others, lenses, poses, progress)
    filled = [np.where(depth > 0, depth, guess).astype(np.float32) for depth, guess in zip(kept, reliable, strict=True)]
    return _seen_through(filled, [depth > 0 for depth in kept], others, lenses, poses, progress)


def _parallax(index: int, others: Sequence[Sequence[int]], lenses: Sequence[Intrinsics], poses: Array) -> float:
    """Pixels by which the farthest of the views beside shifts what is nearer by one unit of inverse depth."""
    apart = [float(np.linalg.norm(poses[other][:3, 3] - poses[index][:3, 3])) for other in others[index]]
    return lenses[index].fx * max(apart, default=0.0)


def _near(guess: Array, depth: Array, parallax: float) -> Array:
    """(H, W) bool: there is a guess, and `depth` lies within `REACH` of it."""
    known = (guess > 0) & (depth > 0)
    shift = parallax * np.abs(1 / np.where(known, guess, 1) - 1 / np.where(known, depth, 1))
    return np.asarray(known & (shift <= REACH))


def _seen_through(
    depths: Sequence[Array],
    sure: Sequence[Array],
    others: Sequence[Sequence[int]],
    lenses: Sequence[Intrinsics],
    poses: Array,
    progress: Progress,
) -> list[Array]:
    """`depths` without what is not `sure` and some other view sees through."""

    def kept(index: int) -> Array:
        progress.check()
        through = agreement(index, others[index], depths, lenses, poses).through
        return np.where(sure[index] | (through == 0), depths[index], np.float32(0)).astype(np.float32)

    return side_by_side(kept, len(depths))
