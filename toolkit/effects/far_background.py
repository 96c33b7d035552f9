"""What lies so far away that parallax does not reach it, measured by patches: do other images show them where infinity would be?

Skies and skylines have hardly a feature that survives matching. But where a patch at infinity must appear in another image follows from
the cameras' turns alone, so it only has to be looked at. For a patch P of image r and another image s, with w_ρ the way from r to s at
the inverse depth ρ and both patches without their mean (in log light, so that exposure drops out),

    c_s(ρ) = mean (P_s(w_ρ) − P_r)²,        a_s = mean (P_r shifted by the parallax of ρ₁ − P_r)²

with ρ₁ = 1 / (NEAR_LIMIT · usual depth). A patch is *informative* when a is large: nearer it would look different. It is *far* when
c(0) is small beside a, beside c at every nearer ρ, and beside the patch's own contrast. Half of the images s decide that; the other
half shows how much worse the best nearer place explains them.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import cv2
import numpy as np

from fieldfuse.camera import Array, distort
from fieldfuse.effects.adjust import Problem
from fieldfuse.effects.evidence import Finding, median_of_finite
from fieldfuse.effects.tracks import Tracks
from fieldfuse.poses.cloud import every
from fieldfuse.poses.points import undistorted
from fieldfuse.tone import LINEAR

THRESHOLD = 0.002  # share of the informative patches
MIN_FAR = 5  # far ones: fewer may be chance
FEWEST = 50  # informative patches
NEAR_LIMIT = 10.0  # times as far as the scene usually is
REFERENCES, OTHERS = 8, 8  # images whose patches are looked at, and in how many others each
TURN = 25.0  # degrees between the axes of images that are compared
HALF, CELL = 3, 10  # working pixels: half a patch; one patch a cell
BLUR = 1.0  # working pixels: poses are a little off
CONTRAST = 2e-4  # squared stops: least of a
SAME, BETTER, OWN = 0.25, 0.4, 0.15  # most of c(0) beside a, beside c nearer, and beside the patch's variance
STEPS = np.array([1, 1.5, 2.2, 3.2, 4.6, 6.5, 9, 12.5, 17, 24, 33, 46, -1])  # of ρ₁: where else a patch may be
CROSS = np.array([[0, 0], [HALF, 0], [0, HALF]])  # working pixels: a patch is carried by its middle and one step across and down
AROUND = np.stack(np.meshgrid(*[np.arange(-HALF, HALF + 1)] * 2), axis=-1).reshape(-1, 2)  # (K, 2) pixels of a patch from its middle
GAIN = 0.3  # least relative fall of the held-out error


def find_far_background(seen: Tracks, problem: Problem, usual: float) -> Finding:
    """Look at patches of some images in others.

    Args:
        problem: cameras that explain what is seen (`geometry.Explained.problem`): poses, lens and rows. usual: median depth of the points.
    """
    near = 1 / max(NEAR_LIMIT * usual, 1e-12)
    informative, distant, errors = 0, 0, np.zeros((0, 2))

    @cache
    def image(index: int) -> Array:
        return np.asarray(cv2.GaussianBlur(np.log2(np.maximum(LINEAR[seen.images[index]], LINEAR[8])), (0, 0), BLUR))

    for one in every(len(seen.images), REFERENCES):
        others = _others(problem.poses, int(one))
        if len(others) >= 4:
            these, gone, off = _compared(seen, problem, near, int(one), others, image)
            informative, distant, errors = informative + these, distant + gone, np.concatenate([errors, off])
    share = distant / informative if informative >= FEWEST and distant >= MIN_FAR else 0.0
    before, after = (float(value) for value in np.sqrt(np.median(errors, axis=0))) if len(errors) else (None, None)
    there = share > THRESHOLD and before is not None and after is not None and after < (1 - GAIN) * before
    reason = (
        f"{100 * share:.1f}% of the patches lie more than {2 * NEAR_LIMIT:g} times as far as the scene usually is: other pictures show them"
        f" where infinity would be; {100 * THRESHOLD:.1f}% or more speak for a distant background"
    )
    return Finding("background", share, THRESHOLD, reason, there, before, after, "stops")


def _others(poses: Array, one: int) -> Array:
    """Images that look the same way from places far aside; sorted by how far, so that every second of them is a fair half."""
    axis = poses[one, :3, 2]
    step = poses[:, :3, 3] - poses[one, :3, 3]
    along = step @ axis
    aside = np.linalg.norm(step - along[:, None] * axis, axis=1) + 0.3 * np.abs(along)
    able = np.flatnonzero((poses[:, :3, 2] @ axis > np.cos(np.deg2rad(TURN))) & (aside > 0))
    return np.asarray(able[np.argsort(-aside[able], kind="stable")[:OTHERS]])


def _compared(
    seen: Tracks, problem: Problem, near: float, one: int, others: Array, image: Callable[[int], Array]
) -> tuple[int, int, Array]:
    """Informative patches of image `one`, those that are far, and (N, 2) squared stops: errors of the far ones in held-out images."""
    own = image(one)
    pixels, patch = _patches(own)
    if not len(pixels):
        return 0, 0, np.zeros((0, 2))
    rays = rays_of(seen, problem, one, (pixels[:, len(AROUND) // 2, None] + CROSS).reshape(-1, 2)).reshape(len(pixels), 3, 3)

    def patches(other: int, some: Array, nearness: float) -> Array:
        """(n, K, 2) working pixels of image `other` for patches with rays (n, 3, 3)."""
        to = carried(seen, problem, one, other, some.reshape(-1, 3), nearness).reshape(len(some), 3, 2)
        across, down = (to[:, 1] - to[:, 0]) / HALF, (to[:, 2] - to[:, 0]) / HALF
        return np.asarray(to[:, :1] + AROUND[:, :1] * across[:, None] + AROUND[:, 1:] * down[:, None])

    fit = np.arange(len(others)) % 2 == 0
    infinity, alike = np.full((len(others), len(pixels)), np.nan), np.full((len(others), len(pixels)), np.nan)
    for k, other in enumerate(others):
        there = patches(int(other), rays, 0.0)
        infinity[k] = _difference(image(int(other)), there, patch)
        moved = pixels + (carried(seen, problem, one, int(other), rays[:, 0], near) - there[:, len(AROUND) // 2])[:, None]
        alike[k] = np.where(np.isfinite(infinity[k]), _difference(own, moved, patch), np.nan)
    variance = (patch**2).mean(1)
    enough = (np.isfinite(infinity[fit]).sum(0) >= 2) & (np.isfinite(infinity[~fit]).sum(0) >= 2)
    shift, zero = median_of_finite(alike[fit], 2), median_of_finite(infinity[fit], 2)
    informative = enough & (shift > CONTRAST) & (shift > 0.1 * variance)
    maybe = np.flatnonzero(informative & (zero < SAME * shift) & (zero < OWN * variance))
    if not len(maybe):
        return int(informative.sum()), 0, np.zeros((0, 2))
    errors = np.full((len(STEPS), len(others), len(maybe)), np.nan)
    for k, other in enumerate(others):
        for n, step in enumerate(STEPS):
            errors[n, k] = _difference(image(int(other)), patches(int(other), rays[maybe], float(step) * near), patch[maybe])
    nearer_fit = np.stack([median_of_finite(error[fit], 2) for error in errors])
    nearer_fit = np.where(np.isfinite(nearer_fit), nearer_fit, np.inf)
    best = nearer_fit.argmin(0)
    gone = np.flatnonzero(zero[maybe] < BETTER * nearer_fit.min(0))
    after = median_of_finite(infinity[~fit], 2)[maybe[gone]]
    before = median_of_finite(errors[best[gone][None], np.flatnonzero(~fit)[:, None], gone[None]], 2)
    both = np.stack([before, after], axis=1)
    return int(informative.sum()), len(gone), both[np.isfinite(both).all(1)]


def _patches(own: Array) -> tuple[Array, Array]:
    """(N, K, 2) working pixels of one patch a cell, at its best corner, and (N, K) their log light without its mean."""
    height, width = (side // CELL * CELL for side in own.shape)
    edge = HALF + 2
    quality = np.asarray(cv2.cornerMinEigenVal(np.asarray(own, dtype=np.float32), 5, ksize=3))
    for border in (np.s_[:edge], np.s_[-edge:], np.s_[:, :edge], np.s_[:, -edge:]):
        quality[border] = 0
    cells = quality[:height, :width].reshape(height // CELL, CELL, width // CELL, CELL).transpose(0, 2, 1, 3).reshape(-1, CELL * CELL)
    row, column = np.divmod(np.arange(len(cells)), max(width // CELL, 1))
    best = cells.argmax(1)
    corner = np.stack([column * CELL + best % CELL, row * CELL + best // CELL], axis=1)[cells.max(1) > 0]
    pixels = corner[:, None] + AROUND[None]
    patch = own[pixels[..., 1], pixels[..., 0]].reshape(len(corner), len(AROUND))
    return pixels.astype(np.float64), patch - patch.mean(1, keepdims=True) if len(patch) else patch


def rays_of(seen: Tracks, problem: Problem, one: int, pixels: Array) -> Array:
    """(N, 3) directions in camera axes of working pixels, by the lens and rows that were found."""
    camera = seen.cameras[one]
    pixel = (pixels + 0.5) / seen.scale[one]
    bent = undistorted(camera, pixel)
    ideal, (k1, k2) = bent, problem.lens
    for _ in range(6 if k1 or k2 else 0):
        square = (ideal**2).sum(1, keepdims=True)
        ideal = bent / (1 + square * (k1 + k2 * square))
    rays = np.concatenate([ideal, np.ones((len(ideal), 1))], axis=1)
    turn = problem.motion[one, :3]
    return rays + (pixel[:, 1:] / camera.height - 0.5) * np.cross(turn, rays) if turn.any() else rays


def carried(seen: Tracks, problem: Problem, one: int, other: int, rays: Array, nearness: float | Array) -> Array:
    """(N, 2) working pixels of image `other` that show what lies on rays (N, 3) of image `one` at an inverse depth, one or (N, 1)."""
    camera, first, second = seen.cameras[other], problem.poses[one], problem.poses[other]
    there = rays @ (second[:3, :3].T @ first[:3, :3]).T + nearness * (second[:3, :3].T @ (first[:3, 3] - second[:3, 3]))
    motion = problem.motion[other]

    def shown(rays: Array) -> Array:
        flat = rays[:, :2] / np.where(rays[:, 2:] > 1e-6, rays[:, 2:], np.nan)
        square = (flat**2).sum(1, keepdims=True)
        bent = flat * (1 + square * (problem.lens[0] + problem.lens[1] * square))
        bent = distort(camera, bent) if camera.distorted else bent
        return np.asarray(bent * [camera.fx, camera.fy] + [camera.cx, camera.cy])

    pixel = shown(there)
    if motion[:3].any():
        row = np.clip(pixel[:, 1:] / camera.height - 0.5, -0.5, 0.5)
        pixel = shown(there - row * (np.cross(motion[:3], there) + nearness * motion[3:]))
    return pixel * seen.scale[other] - 0.5


def _difference(light: Array, pixels: Array, patch: Array) -> Array:
    """(N,) mean square of how patches (N, K) differ from what stands at pixels (N, K, 2); NaN where these leave the image."""
    height, width = light.shape
    inside = ((pixels >= 0) & (pixels <= [width - 1, height - 1])).all((1, 2))
    out = np.full(len(pixels), np.nan)
    if inside.any():
        at = pixels[inside].astype(np.float32)
        values = cv2.remap(light, at[..., 0], at[..., 1], cv2.INTER_LINEAR)
        out[inside] = ((values - values.mean(1, keepdims=True) - patch[inside]) ** 2).mean(1)
    return out
