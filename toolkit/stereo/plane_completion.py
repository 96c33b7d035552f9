"""Depth where matching found nothing to compare: planes of what is known beside it go on.

Floors, walls and doors have nothing that could be recognised but at their edges, and where no depth is known a fit puts things that hang
in the air. `continued` lets the planes of the scene (`planes.py`) go on in each image: pixels with a depth vote for their plane, along the
image and not across its edges (Gastal and Oliveira 2011); a depth is kept when other images have the same point, and colours as alike
there as those of what was matched.

`shown_planes` is for scenes of planes, where a guess of all depth is there, too: it compares how well each plane, and a pixel's own guess,
explain what is seen. Neighbours that see the place show the same there, and none of them sees through it to what is sure. What is sure
nearby counts, too: costs spread along the image and not across its edges (cost-volume filtering, Rhemann et al. 2011); the lowest wins.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from fieldfuse.backends.numba.depth_maps import pass_on
from fieldfuse.camera import Array, Intrinsics, project, unproject
from fieldfuse.capture.types import Views
from fieldfuse.progress import SILENT, Progress
from fieldfuse.stereo.consistency import DepthMaps, agreement
from fieldfuse.stereo.cost_volume import GreyView, Matcher, shrunk
from fieldfuse.stereo.match import CHECKED, Demands, StereoDepth, side_by_side, usable_neighbours, usable_pixels
from fieldfuse.stereo.planes import depth_of, find_planes, in_camera, numbers_of, points_of

# Planes that go on beside what was matched
ON = 0.03  # share of its depth by which a pixel may miss the plane that it votes for
SLANT = 80.0  # degrees beyond which a plane has no depth: a small error of it is a large one of the depth
AWAY = 0.5  # of the image's long side: how far votes go where nothing stands in their way …
EDGE = 30.0  # … and the step of colour, in levels, that is as much in their way as that
LEAST_VOTES = 1e-6
MAJORITY = 0.6  # share of the votes
CONFIRMED = 2  # images that must have the same point
ALIKE = 0.9  # quantile of the differences of colour of what was matched: what is more different is not kept
PASSES = 3  # of the filter that spreads votes
BLUR = (0.7, 1.0)  # pixels, before votes and before colours are compared

# Planes that images show where there is a guess
SHOWN_SLANT, SHOWN_AWAY, SHOWN_EDGE = 85.0, 0.1, 45.0  # as above
SEEN_THROUGH = 1.0  # is added to the cost of what neighbours see through: as much as nothing alike
RECOGNISED = 0.4  # matching cost up to which images show that a plane is there …
ELSEWHERE = 0.2  # … without which this is added to that of one that lies elsewhere than the guess, …
HELD = 0.5  # … or this, shown or not, where other views confirm the guess, such as a bare leg of a table before the floor, …
NEARBY = 0.05  # … by more than this share of it
MOST_COST = 0.6  # of a plane that is taken
NEIGHBOURS = 8  # views that an image is compared with
SAMPLED = 400  # pixels of a view, at most, that its neighbours are chosen by
ANGLE = (0.7, 45.0)  # degrees of parallax outside which a neighbour measures nothing of a place, or looks too different …
FULL = 2.0  # … and from which on it measures all that it can
ENOUGH = 3.0  # so many neighbours that measure all they can are enough for a pixel


def continued(
    found: Sequence[StereoDepth], views: Views, median_depth: float, progress: Progress = SILENT, required: Demands | None = None
) -> list[StereoDepth]:
    """What matching `found` of `views`, and depth beside it where a plane goes on.

    Args:
        found: `match.stereo_depths` of the views, in their order.
        median_depth: depth at which parallax and overlap of images are judged.
        required: of the neighbours that confirm a plane; None: as `match.demands` has it.

    Returns:
        depths as matched where there were any; others confident as what `consistency.confirmed` keeps.

    Raises:
        Interrupted: the user asked to stop.
    """
    poses, count = np.asarray(views.world_from_camera, dtype=np.float64), len(found)
    cameras, matched = [one.intrinsics for one in found], [one.depth for one in found]
    planes = find_planes(points_of(DepthMaps(matched, cameras, poses)))
    neighbours = usable_neighbours(poses, cameras, median_depth, CHECKED, required) if count > 1 else [[]]
    if not len(planes) or not any(neighbours):
        return list(found)
    others = [[other for other in row if neighbours[other]] for row in neighbours]
    small = [shrunk(image, camera) for image, camera in zip(views.images, cameras, strict=True)]
    soft = [cv2.GaussianBlur(image, (0, 0), BLUR[1]) for image in small]

    def proposed(index: int) -> Array:
        progress.check()
        return proposal(found[index], small[index], in_camera(planes, poses[index]), usable_pixels(views, index, cameras[index]))

    def compared(index: int) -> tuple[Array, StereoDepth]:
        progress.check()
        one, depth = found[index], depths[index]
        seen = agreement(index, others[index], DepthMaps(depths, cameras, poses), one.noise, soft)
        sure = (depth > 0) & (one.depth <= 0) & (seen.agree >= min(CONFIRMED, len(others[index]))) & (seen.agree > seen.through)
        confidence = np.where(sure, seen.agree / (seen.agree + seen.through + 1), one.confidence).astype(np.float32)
        return _median(seen.colours), replace(one, depth=np.where(sure, depth, one.depth), confidence=confidence)

    depths = list(side_by_side(proposed, count))
    differences, sure = zip(*side_by_side(compared, count), strict=True)
    usual = np.concatenate([values[depth > 0] for values, depth in zip(differences, matched, strict=True)])
    usual = usual[np.isfinite(usual)].astype(np.float32)
    limit = float(np.quantile(usual, ALIKE)) if len(usual) else 0.0
    alike = [(depth > 0) | (values <= limit) for values, depth in zip(differences, matched, strict=True)]
    return [replace(one, depth=one.depth * kept, confidence=one.confidence * kept) for one, kept in zip(sure, alike, strict=True)]


def proposal(one: StereoDepth, image: Array, local: Array, usable: Array | None) -> Array:
    """(H, W) float32 depth as matched, and where pixels that have a depth, by their votes, let one of the planes go on.

    Args:
        image: (H, W, 3) uint8 of the depth map's size; votes do not go across its edges.
        local: (K, 4) planes of `planes.in_camera`.
        usable: (H, W) bool where there is something to see, None: everywhere.
    """
    voter = numbers_of(one.depth, one.intrinsics, local, ON, SLANT)
    present = [plane for plane in np.unique(voter) if plane >= 0]  # len(planes): those that lie on none
    if not present:
        return one.depth
    votes = np.stack([voter == plane for plane in present], axis=2).astype(np.float32)
    spread_along(cv2.GaussianBlur(image, (0, 0), BLUR[0]), votes, AWAY * max(one.depth.shape), EDGE)
    total, winner = votes.sum(axis=2), np.array(present, np.int32)[votes.argmax(axis=2)]
    open_ = (one.depth <= 0) & (total > LEAST_VOTES) & (votes.max(axis=2) > MAJORITY * total) & (winner < len(local))
    if usable is not None:
        open_ &= usable
    there = depth_of(np.where(open_, winner, np.int32(-1)), one.intrinsics, local, SLANT)
    return np.where(there > 0, there, one.depth)


def spread_along(guide: Array, values: Array, away: float, edge: float) -> None:
    """Let `values` (H, W, K) float32 spread along the image `guide` (H, W, 3) uint8, in place: the domain transform's recursive filter.

    Args:
        away: standard deviation in pixels where the image is even.
        edge: a step of colour, in levels summed over the channels, that is as much in the way as `away` pixels.
    """
    image = guide.astype(np.float32)
    across, down = (1 + away / edge * np.abs(np.diff(image, axis=axis)).sum(axis=2) for axis in (1, 0))
    for number in range(PASSES):
        reach = away * np.sqrt(3) * 2 ** (PASSES - 1 - number) / np.sqrt(4**PASSES - 1)
        keep = np.exp(-np.sqrt(2) / reach)
        pass_on(values[:, :, None], (keep**across).astype(np.float32)[:, :, None])
        pass_on(values[None], (keep**down).astype(np.float32)[None])


def _median(values: Array) -> Array:
    """(H, W) float16 median of (N, H, W) float32, which it sorts, over N, without those that are NaN; NaN: all are.

    np.nanmedian takes ten times as long.
    """
    if not len(values):
        return np.full(values.shape[1:], np.nan, np.float16)
    values.sort(axis=0)
    count = np.isfinite(values).sum(axis=0)
    middles = np.maximum((count - 1) // 2, 0), np.minimum(count // 2, len(values) - 1)
    low, high = (np.take_along_axis(values, at[None], axis=0)[0] for at in middles)
    return np.asarray((low + high) / 2, dtype=np.float16)


@dataclass(frozen=True)
class Unsure:
    """A view of which some depth is sure and some is guessed."""

    grey: GreyView
    image: Array  # (H, W, 3) uint8
    sure: Array  # (H, W) float32 along z, 0 = not sure
    guess: Array  # (H, W) float32, the same where it is no more than that; 0 = none
    held: Array  # (H, W) bool guesses that other views confirm, too

    @property
    def camera(self) -> Intrinsics:
        return self.grey.camera


def shown_planes(index: int, views: Sequence[Unsure], planes: Array, rather: Array) -> Array:
    """(H, W) int32 the plane that each pixel of the view `index` shows, −1: none, or what it shows is sure.

    Args:
        planes: (K, 4) of `planes.find_planes`.
        rather: (K,) how much more than the guess each plane may cost, and is taken.
    """
    view = views[index]
    local = in_camera(planes, view.grey.world_from_camera)
    open_ = view.sure <= 0
    depths = [depth_of(np.where(open_, np.int32(n), np.int32(-1)), view.camera, local, SHOWN_SLANT) for n in range(len(planes))]
    depths.append(np.where(open_, view.guess, 0).astype(np.float32))
    compared = best_placed(index, views)
    costs = matching_costs(view.grey, [views[other].grey for other in compared], depths)
    known, cameras = [one.sure for one in views], [one.camera for one in views]
    poses = np.stack([one.grey.world_from_camera for one in views])
    for number, depth in enumerate(depths):
        seen = agreement(index, compared, DepthMaps([*known[:index], depth, *known[index + 1 :]], cameras, poses))
        elsewhere = np.abs(depth - view.guess) > NEARBY * view.guess
        costs[..., number] += SEEN_THROUGH * ((seen.through > 0) & (seen.through >= seen.agree))
        costs[..., number] += elsewhere * np.where(view.held, HELD, ELSEWHERE * (costs[..., number] > RECOGNISED)).astype(np.float32)
    speaks_for = numbers_of(view.sure, view.camera, local, ON, SHOWN_SLANT)
    costs[~open_] = speaks_for[~open_][:, None] != np.arange(len(depths))
    spread_along(cv2.GaussianBlur(view.image, (0, 0), BLUR[0]), costs, SHOWN_AWAY * max(open_.shape), SHOWN_EDGE)
    claims = costs[..., :-1] - rather.astype(np.float32)
    best = claims.argmin(axis=2)
    lowest, claim = (np.take_along_axis(of, best[..., None], axis=2)[..., 0] for of in (costs, claims))
    there = np.take_along_axis(np.stack(depths[:-1]), best[None], axis=0)[0] > 0
    taken = open_ & there & (view.guess > 0) & (claim < costs[..., -1]) & (lowest < MOST_COST)
    return np.where(taken, best, -1).astype(np.int32)


def matching_costs(view: GreyView, others: Sequence[GreyView], depths: Sequence[Array]) -> Array:
    """(H, W, N) float32 costs of N depth maps, 0 to 1: how unlike the others' images are there; 1 where a map has no depth."""
    matcher = Matcher(view, others)
    out = np.ones((*view.grey.shape, len(depths)), np.float32)
    for number, depth in enumerate(depths):
        known = depth > 0
        if known.any():
            inverse = np.where(known, 1 / np.where(known, depth, 1), 1 / np.median(depth[known])).astype(np.float32)
            out[..., number] = np.where(known, matcher.cost(inverse), 1)
    return out


def best_placed(index: int, views: Sequence[Unsure]) -> list[int]:
    """At most `NEIGHBOURS` views, those first that see most of what is guessed in the view `index`, from where its depth can be measured.

    Neighbours of a whole image (`match.usable_neighbours`) may all look past the corner that nobody is sure of.
    """
    view = views[index]
    rows, columns = np.nonzero((view.sure <= 0) & (view.guess > 0))
    if not len(rows):
        return []
    some = np.random.default_rng(0).permutation(len(rows))[:SAMPLED]
    rows, columns = rows[some], columns[some]
    pose = view.grey.world_from_camera
    places = unproject(view.camera, pose, np.column_stack([columns + 0.5, rows + 0.5]), view.guess[rows, columns])
    worth = np.stack([_worth(places, pose[:3, 3], other.grey) for other in views])  # (N, P)
    worth[index] = 0
    chosen: list[int] = []
    have = np.zeros(len(places))
    while len(chosen) < NEIGHBOURS:
        gain = (np.minimum(have + worth, ENOUGH) - np.minimum(have, ENOUGH)).sum(axis=1)
        best = int(gain.argmax())
        if gain[best] <= 0.01 * len(places):
            break
        chosen.append(best)
        have += worth[best]
        worth[best] = 0
    return chosen


def _worth(places: Array, eye: Array, other: GreyView) -> Array:
    """(P,) from 0 to 1: how well another view measures the depth of places (P, 3) seen from `eye`."""
    pixels, _ = project(other.camera, other.world_from_camera, places)
    seen = ((pixels >= 0) & (pixels < [other.camera.width, other.camera.height])).all(axis=1)  # behind it they are NaN
    here, there = places - eye, places - other.world_from_camera[:3, 3]
    lengths = np.linalg.norm(here, axis=1) * np.linalg.norm(there, axis=1)
    angle = np.rad2deg(np.arccos(np.clip((here * there).sum(axis=1) / np.maximum(lengths, 1e-12), -1, 1)))
    return np.asarray(np.where(seen & (angle >= ANGLE[0]) & (angle <= ANGLE[1]), np.minimum(angle / FULL, 1.0), 0.0))
