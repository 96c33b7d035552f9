"""Lens models of other programs as OpenCV's: exact where it has the same, else fitted to a small part of a pixel."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from fieldfuse.camera import OPENCV, PINHOLE, Array, Intrinsics
from fieldfuse.errors import InputError

WIDEST = 5.0  # x/z up to which a lens is fitted: 79° off the axis
CLOSE = 0.25  # pixels by which the fitted lens may be off anywhere in the image
STEPS = 800
SMALLEST = 1e-6  # singular value, of the largest: what is smaller only makes coefficients large
POWERS = (2, 4, 6)


def with_brown_lens(camera: Intrinsics, radial: Sequence[float], tangential: tuple[float, float], where: str) -> Intrinsics:
    """The pinhole `camera` with Brown's lens.

    Args:
        radial: factors of r², r⁴, r⁶ and r⁸, as many as there are; r is the distance from the axis in units of x/z.
        tangential: OpenCV's p1 and p2.

    Raises:
        InputError: a value is not finite, or r⁸ cannot be fitted.
    """
    factors = [*radial, *[0.0] * (4 - len(radial))]
    k1, k2, k3, k4 = factors
    if k4:
        powers = np.arange(2, 10, 2)

        def bend(r: Array) -> Array:
            return np.asarray(r * (1 + (r[:, None] ** powers) @ np.array(factors)))

        return with_fitted_lens(camera, bend, where, tangential)
    if not any((*radial, *tangential)):
        return replace(camera, lens=PINHOLE, distortion=()).checked(where)
    return replace(camera, lens=OPENCV, distortion=(k1, k2, *tangential, k3)).checked(where)


def with_division_lens(camera: Intrinsics, k: float, where: str) -> Intrinsics:
    """The pinhole `camera` with the one-parameter division model (Fitzgibbon 2001): ideal = distorted / (1 + k · distorted²)."""
    if not k:
        return camera

    def bend(r: Array) -> Array:
        root = np.sqrt(np.maximum(1 - 4 * k * r**2, 0))
        return np.asarray(2 * r / (1 + root))

    return with_fitted_lens(camera, bend, where)


def with_fitted_lens(
    camera: Intrinsics, bend: Callable[[Array], Array], where: str, tangential: tuple[float, float] = (0.0, 0.0)
) -> Intrinsics:
    """The pinhole `camera` with OpenCV's rational lens, whose radial terms are fitted to `bend`: (N,) ideal radius → (N,) distorted one.

    Raises:
        InputError: no such lens comes close within the image.
    """
    camera.checked(where)
    across = max(camera.cx, camera.width - camera.cx) / camera.fx
    down = max(camera.cy, camera.height - camera.cy) / camera.fy
    corner = float(np.hypot(across, down))
    r = np.linspace(0, WIDEST, STEPS * 4)[1:]
    with np.errstate(all="ignore"):
        bent = bend(r)
        rising = np.isfinite(bent) & (np.diff(bent, prepend=0.0) > 0)
    end = len(r) if rising.all() else int(np.argmin(rising))  # beyond, the lens folds
    end = min(end, int(np.searchsorted(bent[:end], corner)) + 1)
    if end < 8:
        raise InputError(f"{where}: the lens coefficients are those of no lens; correct them, or undistort the images first")
    tiny = np.array([1e-4])
    slope = float(bend(tiny)[0] / tiny[0])  # OpenCV's lenses leave the middle as it is, so the focal length takes what others do not
    camera = replace(camera, fx=camera.fx * slope, fy=camera.fy * slope).checked(where)
    r = np.linspace(0, r[min(end, len(r)) - 1], STEPS)[1:]
    bent = bend(r) / slope
    scaled, ratio = r / r[-1], bent / r
    columns = np.stack([*(scaled**power for power in POWERS), *(-ratio * scaled**power for power in POWERS)], axis=1)
    solved = np.linalg.lstsq(columns, ratio - 1, rcond=SMALLEST)[0] / np.tile(r[-1] ** np.array(POWERS, dtype=np.float64), 2)
    above, below = (1 + (r[:, None] ** np.array(POWERS)) @ part for part in (solved[:3], solved[3:]))
    off = np.abs(r * above / below - bent).max() * max(camera.fx, camera.fy) if (below > 0).all() else np.inf
    if not off <= CLOSE:
        raise InputError(f"{where}: OpenCV's coefficients cannot describe the lens (off by {off:.2g} pixels); undistort the images first")
    k1, k2, k3, k4, k5, k6 = solved.tolist()
    return replace(camera, lens=OPENCV, distortion=(k1, k2, *tangential, k3, k4, k5, k6)).checked(where)
