"""Structure from motion placed on earth by the GPS of its images: a similarity between camera centres and metres east, north and up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from fieldfuse.camera import Array, Similarity
from fieldfuse.georeference import Georeference

LEAST, SHARE = 5, 0.5  # images with GPS, and their share of all, from which on it is looked at
TRIES = 400  # triples of images from which a similarity is made
ROBUST = 3.0  # times the usual distance: what is farther off takes no part
AGREE = 0.6  # share of the images that must take part
MOST_SCALE, MOST_TURN = 0.05, 5.0  # relative error of lengths, and degrees that the vertical may be off, beyond which GPS is not used
LEAST_NOISE = 0.02  # metres: no GPS is taken to be better


@dataclass(frozen=True)
class Placed:
    """Where camera centres lie on earth."""

    enu_from_centres: Similarity
    origin: Georeference
    used: int  # images that take part
    error: float  # metres: root mean square distance of their centres from their GPS
    scale_error: float  # relative
    turn_error: float  # degrees, of the vertical


def similarity(source: Array, target: Array) -> Similarity:
    """The one that brings (N, 3) points nearest to (N, 3) others (Umeyama 1991, eq. 34 to 42)."""
    a, b = source.mean(axis=0), target.mean(axis=0)
    u, values, vt = np.linalg.svd((target - b).T @ (source - a))
    flip = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt)) or 1.0])
    rotation = (u * flip) @ vt
    spread = float(((source - a) ** 2).sum())
    scale = float((values * flip).sum() / spread) if spread > 0 else 0.0
    return Similarity(scale, rotation, b - scale * (rotation @ a))


def fit_gps(centres: Array, places: Array) -> Placed | str:
    """The similarity from camera centres (N, 3) to local axes on earth, by their GPS (N, 3; degrees and metres, NaN: none).

    Or a sentence on why GPS is of no use: too few images, too far off, or cameras too near to each other, or to a line, for what it is off.
    """
    there = np.isfinite(places).all(axis=1)
    if there.sum() < LEAST:
        flat = np.isfinite(places[:, :2]).all(axis=1).sum()
        return f"{there.sum()} images have a place with altitude" + (f" ({flat} one without)" if flat > there.sum() else "")
    centres, places = centres[there], places[there]
    latitude, longitude, altitude = np.median(places, axis=0).tolist()
    origin = Georeference(latitude, longitude, altitude)
    target = origin.enu_of(places)
    best = _consensus(centres, target)
    if best is None:
        return "the places are all the same, or cameras stand on one spot"
    fitted, near, sigma = _refined(best, centres, target)
    if near.sum() < max(LEAST, AGREE * len(centres)):
        return f"the places of {len(near) - near.sum()} of {len(near)} images do not fit the cameras' way"
    off = fitted.points(centres[near]) - target[near]
    scale_error, turn_error = _errors(fitted, centres[near], sigma)
    error = float(np.sqrt((off**2).sum(axis=1).mean()))
    extent = float(np.linalg.norm(target[near] - target[near].mean(axis=0), axis=1).max())
    if not (scale_error <= MOST_SCALE and turn_error <= MOST_TURN):
        what = f"lengths would be uncertain by {100 * scale_error:.0f}% and the vertical by {turn_error:.0f}°"
        return f"cameras stand within {extent:.3g} m of their middle or in a line, and their places are off by {error:.2g} m: {what}"
    return Placed(fitted, origin, int(near.sum()), error, scale_error, turn_error)


def _consensus(centres: Array, target: Array) -> Similarity | None:
    """Of similarities through three images each, the one that leaves the smallest median distance."""
    rng, best, least = np.random.default_rng(0), None, np.inf
    for _ in range(TRIES):
        three = rng.choice(len(centres), 3, replace=False)
        made = similarity(centres[three], target[three])
        if made.scale <= 0 or not np.isfinite(made.scale):
            continue
        off = float(np.median(np.linalg.norm(made.points(centres) - target, axis=1)))
        best, least = (made, off) if off < least else (best, least)
    return best


def _refined(start: Similarity, centres: Array, target: Array) -> tuple[Similarity, Array, Array]:
    """Least squares over the images that are near, heights weighted by how far they are off; with these images (N,) bool, and (3,) metres
    that east, north and up are off (standard deviations)."""
    fitted, sigma = start, np.ones(3)
    near = np.ones(len(centres), dtype=bool)
    for _ in range(5):
        off = fitted.points(centres) - target
        usual = np.maximum(1.4826 * np.median(np.abs(off), axis=0), LEAST_NOISE)
        sigma = np.array([np.hypot(*usual[:2]) / np.sqrt(2)] * 2 + [usual[2]])
        near = np.linalg.norm(off / sigma, axis=1) < ROBUST * np.sqrt(3)
        if near.sum() < 3:
            break
        fitted = _least_squares(fitted, centres[near], target[near], sigma)
    off = (fitted.points(centres) - target)[near]
    free = 1 - 7 / (3 * max(near.sum(), 3))  # seven numbers were fitted to three an image
    flat, up = np.sqrt((off[:, :2] ** 2).mean() / free), np.sqrt((off[:, 2] ** 2).mean() / free)
    return fitted, near, np.maximum([flat, flat, up], LEAST_NOISE)


def _least_squares(start: Similarity, centres: Array, target: Array, sigma: Array) -> Similarity:
    """The similarity that minimises squared distances by `sigma`, from one near to it; parameters are its changes."""
    middle = centres.mean(axis=0)
    reach = max(float(np.linalg.norm(start.scale * (centres - middle), axis=1).mean()), 1e-9)

    def moved(change: Array) -> Similarity:
        turn = Rotation.from_rotvec(change[1:4] / reach).as_matrix() @ start.rotation
        scale = start.scale * np.exp(change[0] / reach)
        return Similarity(float(scale), turn, start.points(middle) + change[4:] - scale * (turn @ middle))

    found = least_squares(lambda change: ((moved(change).points(centres) - target) / sigma).ravel(), np.zeros(7), method="lm")
    return moved(found.x)


def _errors(fitted: Similarity, centres: Array, sigma: Array) -> tuple[float, float]:
    """Standard deviations of the scale (relative) and of the vertical (degrees), by the normal equations of the fit."""
    arms = fitted.scale * (centres - centres.mean(axis=0)) @ fitted.rotation.T
    rows = []
    for x, y, z in arms:
        rows.append(np.array([[x, 0, z, -y], [y, -z, 0, x], [z, y, -x, 0]]) / sigma[:, None])  # of scale, and turns about east, north, up
    design = np.concatenate(rows)
    inverse = np.linalg.pinv(design.T @ design)
    values = np.linalg.eigvalsh(design.T @ design)
    if values[0] < 1e-9 * max(values[-1], 1e-300):  # on a line: some turn is not seen at all
        return float("inf"), float("inf")
    return float(np.sqrt(inverse[0, 0])), float(np.rad2deg(np.sqrt(inverse[1, 1] + inverse[2, 2])))
