"""View dependence between the points: patches that one image shows brighter than others show the same surface.

A highlight is small, wanders, and seldom lies where features do. So one patch a cell of image r is carried into other images s by the
plane through the points round it. With P the patch's log light without its mean, and l the logarithm of its mean light,

    d_s = l_r − l_s − median of the same over all patches of r in s,     used where  mean (P_s − P_r)² < SAME · mean P_r² + NOISE

so the texture has to agree while the light may differ, and exposure drops out. A patch's excess is the median of d_s over the images s.
It is *shiny* when at least three quarters of the patches round it are BRIGHTER: what noise, edges and wrong planes do is not alike over an
area. Half of the images s predict, from the patches round each shiny one, what the other half sees.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from fieldfuse.camera import Array
from fieldfuse.effects.adjust import Problem
from fieldfuse.effects.evidence import Finding, median_of_finite
from fieldfuse.effects.far_background import AROUND, BLUR, CELL, CROSS, HALF, carried, rays_of
from fieldfuse.effects.light import VIGNETTING, Light
from fieldfuse.effects.tracks import Tracks
from fieldfuse.poses.cloud import every
from fieldfuse.tone import LINEAR, share, square_radius

THRESHOLD = 0.0014  # share of the patches
MIN_SHINY = 3  # shiny ones
FEWEST = 150  # patches
BRIGHTER = 0.1  # stops
GAIN = 0.2  # least relative fall of the held-out error
REFERENCES, OTHERS = 16, 8  # images whose patches are looked at, and in how many others each
TURN = 40.0  # degrees between the axes of images that are compared
SAME, NOISE = 0.4, 0.0012  # of the patch's variance, and squared stops
STIFF = 0.01  # squared stops a pixel, over a patch: what keeps a patch without texture where its plane puts it
FARTHEST = 2.0  # working pixels that a patch may be moved for its texture to agree
ZOOM = 1.4  # most that a patch may be larger or smaller: blur takes light over the edges of what is small
DARKEST, CLIPPED = 24, 200  # stored grey: noise below; beyond, a channel may have lost light that darker images show
NEAREST, FLAT, REACH = 7, 0.02, 45.0  # points that make a plane, their relative error, and how far off the third of them may be
VIEWS = 3  # others that show a patch


@dataclass(frozen=True)
class _Image:
    log: Array  # (h, w) log₂ light, a little blurred
    usable: Array  # (h, w) bool: no pixel round it is too dark, nor clipped where exposure or vignetting differ

    @classmethod
    def of(cls, seen: Tracks, index: int, found: Light) -> _Image:
        grey, camera = seen.images[index], seen.cameras[index]
        light = np.maximum(LINEAR[grey], LINEAR[8])
        if VIGNETTING in found.kept:
            light = light / share(found.corner, square_radius(camera.scaled(grey.shape[1], grey.shape[0])))
        log = np.log2(cv2.GaussianBlur(light, (0, 0), BLUR))
        square = np.ones((2 * HALF + 1, 2 * HALF + 1), np.uint8)
        usable = cv2.erode(grey, square) > DARKEST
        return cls(log.astype(np.float32), usable & (cv2.dilate(grey, square) < CLIPPED) if found.kept else usable)


def find_specularity(seen: Tracks, problem: Problem, depth: Array, found: Light) -> Finding:
    """Look at patches of some images in others.

    Args:
        seen: the observations that `problem` explains. depth: (O,) along z, of each of them.
        found: what is known about light; vignetting that is there is taken out.
    """
    images = [_Image.of(seen, index, found) for index in range(len(seen.images))]
    total, hits, errors = 0, 0, np.zeros((0, 2))
    for one in every(len(images), REFERENCES):
        excess = _excess(seen, problem, depth, images, int(one))
        if excess is None:
            continue
        least, _, known = _around(excess[0])
        hit = known & (least > BRIGHTER)
        _, expected, _ = _around(excess[1])
        off = np.stack([np.abs(excess[2][hit]), np.abs(excess[2][hit] - expected[hit])], axis=1)
        total, hits, errors = total + int(known.sum()), hits + int(hit.sum()), np.concatenate([errors, off])
    part = hits / total if total >= FEWEST and hits >= MIN_SHINY else 0.0
    errors = errors[np.isfinite(errors).all(1)]
    before, after = (float(value) for value in np.median(errors, axis=0)) if len(errors) else (None, None)
    there = part > THRESHOLD and before is not None and after is not None and after < (1 - GAIN) * before
    reason = (
        f"{100 * part:.2f}% of the patches lie in areas that one picture shows more than {BRIGHTER:g} stops brighter than others show the "
        f"same surface; {100 * THRESHOLD:.2f}% or more speak for highlights or reflections"
    )
    return Finding("view_dependence", part, THRESHOLD, reason, there, before, after, "stops")


def _excess(seen: Tracks, problem: Problem, depth: Array, images: list[_Image], one: int) -> Array | None:
    """(3, rows, columns) stops by which patches of image `one` are brighter than others show them: by all others, by every second, and by
    the rest. NaN: not known. None: there is nothing to compare."""
    own, mine = images[one], seen.frame == one
    height, width = own.log.shape
    rows, columns = np.arange(CELL // 2, height - HALF - 1, CELL), np.arange(CELL // 2, width - HALF - 1, CELL)
    middle = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    place = seen.pixel[mine] * seen.scale[one] - 0.5
    others = _others(problem.poses, one)
    if len(place) < NEAREST or len(others) < VIEWS:
        return None
    nearness = _nearness(place, 1 / depth[mine], middle)
    some = np.flatnonzero(np.isfinite(nearness))
    if len(some) == 0:
        return None
    rays = rays_of(seen, problem, one, (middle[some][:, None] + CROSS).reshape(-1, 2).astype(np.float64))
    column, row = (middle[some][:, None] + AROUND).transpose(2, 0, 1)
    texture, light = _split(own.log[row, column])
    slope = np.stack([cv2.Sobel(own.log, cv2.CV_32F, *order, scale=0.125)[row, column] for order in ((1, 0), (0, 1))], axis=2)
    slope -= slope.mean(1, keepdims=True)
    steer = np.linalg.inv(np.einsum("nka,nkb->nab", slope, slope) + STIFF * np.eye(2))
    able = own.usable[middle[some][:, 1], middle[some][:, 0]]
    excess = np.full((len(others), len(some)), np.nan)
    for k, other in enumerate(others):
        theirs = images[int(other)]
        to = carried(seen, problem, one, int(other), rays, np.repeat(nearness[some], 3)[:, None]).reshape(-1, 3, 2)
        step = (to[:, 1:] - to[:, :1]) / HALF  # (n, 2, 2): one pixel across and one down
        with np.errstate(invalid="ignore"):  # behind the other camera it is NaN, and out of sight below
            zoom = np.sqrt(np.abs(np.linalg.det(step)))
        at = to[:, :1] + np.einsum("ka,nab->nkb", AROUND, step)
        there, inside = _sampled(theirs.log, at)
        turn = np.einsum("nab,nkb,nk->na", steer, slope, _split(there)[0] - texture)
        at = at - np.einsum("na,nab->nb", np.clip(turn, -FARTHEST, FARTHEST), step)[:, None]
        there, still = _sampled(theirs.log, at)
        shape, level = _split(there)
        same = ((shape - texture) ** 2).mean(1) < SAME * (texture**2).mean(1) + NOISE
        rim = np.array(theirs.log.shape[::-1]) - 1  # images may have several shapes
        centre = np.clip(np.nan_to_num(at[:, len(AROUND) // 2]).round(), 0, rim).astype(int)
        known = able & inside & still & same & (zoom > 1 / ZOOM) & (zoom < ZOOM) & theirs.usable[centre[:, 1], centre[:, 0]]
        if known.sum() > 2 * VIEWS:
            excess[k] = np.where(known, light - level - np.median((light - level)[known]), np.nan)
    out = np.full((3, len(middle)), np.nan)
    out[0, some] = median_of_finite(excess, VIEWS)
    out[1, some], out[2, some] = median_of_finite(excess[::2], 1), median_of_finite(excess[1::2], 1)
    return out.reshape(3, len(rows), len(columns))


def _others(poses: Array, one: int) -> Array:
    """Images that look about the same way, spread over how far away they were taken."""
    step = np.linalg.norm(poses[:, :3, 3] - poses[one, :3, 3], axis=1)
    able = np.flatnonzero((poses[:, :3, 2] @ poses[one, :3, 2] > np.cos(np.deg2rad(TURN))) & (step > 0))
    able = able[np.argsort(-step[able], kind="stable")]
    return np.asarray(able[every(len(able), OTHERS)])


def _nearness(place: Array, inverse: Array, cells: Array) -> Array:
    """(N,) inverse depth in the middle of cells, by the plane through the points round each; NaN where these lie on none."""
    away = np.linalg.norm(cells[:, None] - place[None], axis=2)
    near = np.argsort(away, axis=1)[:, :NEAREST]
    reach = np.take_along_axis(away, near[:, 2:3], 1)[:, 0]
    matrix = np.concatenate([(place[near] - cells[:, None]) / REACH, np.ones((*near.shape, 1))], axis=2)
    wanted, weight = inverse[near], np.ones(near.shape)
    plane, error = np.zeros((len(cells), 3)), np.zeros(near.shape)
    for _ in range(3):  # an inverse depth is even over a plane's image
        normal = np.einsum("nki,nk,nkj->nij", matrix, weight, matrix) + 1e-3 * np.diag([1.0, 1.0, 1e-6])
        plane = np.linalg.solve(normal, np.einsum("nki,nk,nk->ni", matrix, weight, wanted)[..., None])[..., 0]
        error = np.abs(np.einsum("nki,ni->nk", matrix, plane) - wanted) / np.maximum(plane[:, 2:], 1e-9)
        weight = np.minimum(1.0, FLAT / np.maximum(error, 1e-12)) ** 2
    even = ((error < FLAT).sum(1) >= NEAREST - 2) & (reach < REACH) & (plane[:, 2] > 0)
    return np.where(even, plane[:, 2], np.nan)


def _split(log: Array) -> tuple[Array, Array]:
    """Patches (N, K) of log light without their mean, and (N,) the logarithm of their mean light."""
    return log - log.mean(1, keepdims=True), np.log2(np.exp2(log).mean(1))


def _sampled(log: Array, at: Array) -> tuple[Array, Array]:
    """(N, K) values at pixels (N, K, 2), and (N,) whether all lie in the image."""
    inside = np.asarray(((at >= 0) & (at <= [log.shape[1] - 1, log.shape[0] - 1])).all((1, 2)))
    pixels = np.nan_to_num(at, nan=-9.0).astype(np.float32)
    return cv2.remap(log, pixels[..., 0], pixels[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(np.float64), inside


def _around(excess: Array) -> tuple[Array, Array, Array]:
    """Of the 3×3 cells round each (rows, columns): their lower quartile, their median, and whether six of them at least are known."""
    padded = np.pad(excess, 1, constant_values=np.nan)
    rows, columns = excess.shape
    near = np.sort([padded[i : i + rows, j : j + columns] for i in range(3) for j in range(3)], axis=0)
    count = np.isfinite(near).sum(0)
    low, middle = (np.take_along_axis(near, np.minimum(share, 8)[None], 0)[0] for share in (count // 4, count // 2))
    return low, middle, count >= 6
