"""Which of a scene's planes a picture shows where its depth is not known for sure.

Floor and walls are seen well from somewhere, and go on to where few views see them, or nothing but their colour is to be seen. So of each
pixel that is not sure it is asked how well each plane, and the pixel's own guess of a depth, explain what is seen: neighbours that see the
place show the same there (`cost.py`), and none of them sees through it to what is sure. What is sure nearby counts, too: costs spread along
the picture and not across its edges (cost-volume filtering, Rhemann et al. 2011, by the domain transform of `bare.py`); the lowest wins.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.stereo.bare import BLUR, spread_along
from fieldfuse.stereo.check import agreement
from fieldfuse.stereo.cost import GreyView, Matcher
from fieldfuse.stereo.plane_maps import depth_of, in_camera, numbers_of

ON = 0.03  # share of its depth by which a sure pixel may miss the plane that it speaks for
SLANT = 85.0  # degrees beyond which a plane tells no depth
AWAY = 0.1  # of the picture's long side: how far costs go where nothing stands in their way …
EDGE = 45.0  # … and the step of colour, in levels, that is as much in their way as that
SEEN_THROUGH = 1.0  # is added to the cost of what neighbours see through: as much as nothing alike
RECOGNISED = 0.4  # matching cost up to which pictures show that a plane is there …
ELSEWHERE = 0.2  # … without which this is added to that of one that lies elsewhere than the guess, …
HELD = 0.5  # … or this, shown or not, where other views hold the guess, such as a bare leg of a table before the floor, …
NEARBY = 0.05  # … by more than this share of it
MOST_COST = 0.6  # of a plane that is taken
NEIGHBOURS = 8  # views that a picture is compared with
ASKED = 400  # pixels of a view, at most, that its neighbours are chosen by
ANGLE = (0.7, 45.0)  # degrees of parallax outside which a neighbour tells nothing of a place, or looks too different …
FULL = 2.0  # … and from which on it tells all that it can
ENOUGH = 3.0  # so many neighbours that tell all they can is what a pixel wants


@dataclass(frozen=True)
class Unsure:
    """A view of which some depth is sure and some is guessed."""

    grey: GreyView
    picture: Array  # (H, W, 3) uint8
    sure: Array  # (H, W) float32 along z, 0 = not sure
    guess: Array  # (H, W) float32, the same where it is no more than that; 0 = none
    held: Array  # (H, W) bool guesses that other views hold, too

    @property
    def camera(self) -> Intrinsics:
        return self.grey.camera


def shown_planes(index: int, views: Sequence[Unsure], planes: Array, rather: Array) -> Array:
    """(H, W) int32 the plane that each pixel of the view `index` shows, −1: none, or what it shows is sure.

    Args:
        planes: (K, 4) of `planes.find_planes`.
        rather: (K,) how much more than the guess each plane may cost, and is taken.
    """
    view, pose = views[index], views[index].grey.world_from_camera
    local = in_camera(planes, pose)
    open_ = view.sure <= 0
    depths = [depth_of(np.where(open_, np.int32(number), np.int32(-1)), view.camera, local, SLANT) for number in range(len(planes))]
    depths.append(np.where(open_, view.guess, 0).astype(np.float32))
    compared = best_placed(index, views)
    costs = matching_costs(view.grey, [views[other].grey for other in compared], depths)
    known, cameras = [one.sure for one in views], [one.camera for one in views]
    poses = np.stack([one.grey.world_from_camera for one in views])
    for number, depth in enumerate(depths):
        said = agreement(index, compared, [*known[:index], depth, *known[index + 1 :]], cameras, poses)
        elsewhere = np.abs(depth - view.guess) > NEARBY * view.guess
        costs[..., number] += SEEN_THROUGH * ((said.through > 0) & (said.through >= said.agree))
        costs[..., number] += elsewhere * np.where(view.held, HELD, ELSEWHERE * (costs[..., number] > RECOGNISED)).astype(np.float32)
    speaks_for = numbers_of(view.sure, view.camera, local, ON, SLANT)
    costs[~open_] = speaks_for[~open_][:, None] != np.arange(len(depths))
    spread_along(cv2.GaussianBlur(view.picture, (0, 0), BLUR[0]), costs, AWAY * max(open_.shape), EDGE)
    claims = costs[..., :-1] - rather.astype(np.float32)
    best = claims.argmin(axis=2)
    lowest, claim = (np.take_along_axis(of, best[..., None], axis=2)[..., 0] for of in (costs, claims))
    there = np.take_along_axis(np.stack(depths[:-1]), best[None], axis=0)[0] > 0
    taken = open_ & there & (view.guess > 0) & (claim < costs[..., -1]) & (lowest < MOST_COST)
    return np.where(taken, best, -1).astype(np.int32)


def matching_costs(view: GreyView, others: Sequence[GreyView], depths: Sequence[Array]) -> Array:
    """(H, W, N) float32 costs of N depth maps, 0 to 1: how unlike the others' pictures are there; 1 where a map has no depth."""
    matcher = Matcher(view, others)
    out = np.ones((*view.grey.shape, len(depths)), np.float32)
    for number, depth in enumerate(depths):
        known = depth > 0
        if not known.any():
            continue
        inverse = np.where(known, 1 / np.where(known, depth, 1), 1 / np.median(depth[known])).astype(np.float32)
        out[..., number] = np.where(known, matcher.cost(inverse), 1)
    return out


def best_placed(index: int, views: Sequence[Unsure]) -> list[int]:
    """At most `NEIGHBOURS` views, those first that see most of what is guessed in the view `index`, from where it tells depth.

    Neighbours of a whole picture (`match.usable_neighbours`) may all look past the corner that nobody is sure of.
    """
    view = views[index]
    rows, columns = np.nonzero((view.sure <= 0) & (view.guess > 0))
    if not len(rows):
        return []
    some = np.random.default_rng(0).permutation(len(rows))[:ASKED]
    rows, columns = rows[some], columns[some]
    camera, pose, depth = view.camera, view.grey.world_from_camera, view.guess[rows, columns].astype(np.float64)
    local = np.column_stack([(columns + 0.5 - camera.cx) / camera.fx * depth, (rows + 0.5 - camera.cy) / camera.fy * depth, depth])
    places = local @ pose[:3, :3].T + pose[:3, 3]
    worth = np.stack([_worth(places, pose[:3, 3], other) for other in views])  # (N, P)
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


def _worth(places: Array, eye: Array, other: Unsure) -> Array:
    """(P,) from 0 to 1: how much another view tells of the depth of places (P, 3) seen from `eye`."""
    camera, pose = other.camera, other.grey.world_from_camera
    local = (places - pose[:3, 3]) @ pose[:3, :3]
    front = local[:, 2] > 0
    z = np.where(front, local[:, 2], 1.0)
    u, v = local[:, 0] / z * camera.fx + camera.cx, local[:, 1] / z * camera.fy + camera.cy
    seen = front & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    here, there = places - eye, places - pose[:3, 3]
    lengths = np.linalg.norm(here, axis=1) * np.linalg.norm(there, axis=1)
    angle = np.rad2deg(np.arccos(np.clip((here * there).sum(axis=1) / np.maximum(lengths, 1e-12), -1, 1)))
    return np.asarray(np.where(seen & (angle >= ANGLE[0]) & (angle <= ANGLE[1]), np.minimum(angle / FULL, 1.0), 0.0))
