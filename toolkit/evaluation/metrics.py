"""Metrics of renders and depth maps on the pixels that have a truth.

Images (H, W, 3) are float in [0, 1] or uint8, masks (H, W) bool. A metric is None where nothing can be compared, never NaN.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from fieldfuse.camera import Array
from fieldfuse.errors import InputError

PSNR_CAP = 100.0  # dB; identical images have no finite PSNR, and infinity is not JSON
WINDOW = 11  # Wang et al. 2004, section III.B: 11×11 Gaussian, standard deviation 1.5, K1 = 0.01, K2 = 0.03, L = 1 here
SIGMA = 1.5
C1 = 0.01**2
C2 = 0.03**2
FEWEST = 64  # pixels that a correction of colour is fitted to
DEPTH_KEYS = ("abs_err", "abs_rel", "rmse", "median_rel", "delta_1", "delta_2", "delta_3", "within_5_percent", "coverage")
NEAREST, FARTHEST = 1e-12, 1e30
WITHIN = {"acc_1": 0.01, "acc_5": 0.05}  # thresholds of the depth's accuracy, in shares of the scale


def as_float(image: Array) -> Array:
    """(H, W, 3) uint8 or float → float64 in [0, 1]; what is not finite becomes black, as a viewer would show it.

    Raises:
        InputError: not a colour image.
    """
    image = np.asarray(image)
    if image.ndim != 3 or image.shape[2] != 3:
        raise InputError(f"an image of shape {image.shape} cannot be measured; it must be (height, width, 3)")
    if image.dtype == np.uint8:
        return image.astype(np.float64) / 255
    return np.clip(np.nan_to_num(image.astype(np.float64), nan=0, posinf=0, neginf=0), 0, 1)


def comparable(rendered: Array, truth: Array, valid: Array | None) -> tuple[Array, Array, Array]:
    """Both images as float64 in [0, 1], and the (H, W) mask of pixels to compare, all when `valid` is None.

    Raises:
        InputError: sizes differ.
    """
    first, second = as_float(rendered), as_float(truth)
    if first.shape != second.shape:
        sizes = f"{first.shape[1]}×{first.shape[0]} and the true one {second.shape[1]}×{second.shape[0]}"
        raise InputError(f"the render is {sizes}; render at the size of the view")
    return first, second, _mask(valid, first.shape)


def _mask(valid: Array | None, shape: tuple[int, ...]) -> Array:
    mask = np.ones(shape[:2], bool) if valid is None else np.array(valid).astype(bool)
    if mask.shape != tuple(shape[:2]):
        raise InputError(f"a mask of shape {mask.shape} does not fit an image of {shape[1]}×{shape[0]}")
    return mask


def psnr(rendered: Array, truth: Array, valid: Array | None = None) -> float | None:
    """Peak signal-to-noise ratio in dB over all channels of the valid pixels, at most `PSNR_CAP`; None without a valid pixel.

    Raises:
        InputError: sizes differ.
    """
    first, second, mask = comparable(rendered, truth, valid)
    if not mask.any():
        return None
    error = float(np.mean((first[mask] - second[mask]) ** 2))
    return PSNR_CAP if error <= 10 ** (-PSNR_CAP / 10) else float(-10 * np.log10(error))


def ssim(rendered: Array, truth: Array, valid: Array | None = None) -> float | None:
    """Structural similarity in [−1, 1] as in Wang et al. 2004 (eq. 13), each channel alone, then the mean.

    Only windows that lie fully inside the image and on valid pixels count; None when there is none (a side below 11 pixels).

    Raises:
        InputError: sizes differ.
    """
    first, second, mask = comparable(rendered, truth, valid)
    if min(mask.shape) < WINDOW:
        return None
    edge = WINDOW // 2
    full = cv2.erode(mask.astype(np.uint8), np.ones((WINDOW, WINDOW), np.uint8))[edge:-edge, edge:-edge].astype(bool)
    if not full.any():
        return None
    kernel = cv2.getGaussianKernel(WINDOW, SIGMA, cv2.CV_64F)

    def average(values: Array) -> Array:
        filtered = cv2.sepFilter2D(values, cv2.CV_64F, kernel, kernel, borderType=cv2.BORDER_REFLECT)
        return np.asarray(filtered)[edge:-edge, edge:-edge]

    m1, m2 = average(first), average(second)
    # Differences of nearly equal numbers: below zero only by rounding.
    v1 = np.maximum(average(first * first) - m1 * m1, 0)
    v2 = np.maximum(average(second * second) - m2 * m2, 0)
    covariance = average(first * second) - m1 * m2
    similarity = ((2 * m1 * m2 + C1) * (2 * covariance + C2)) / ((m1 * m1 + m2 * m2 + C1) * (v1 + v2 + C2))
    return float(np.clip(similarity[full].mean(), -1, 1))


def right_half_psnr(rendered: Array, truth: Array, valid: Array | None = None) -> float | None:
    """PSNR of the right half after a correction of colour that is fitted on the left; None where there is nothing to fit or to score.

    c' = A c + b, with A (3, 3) and b (3,) by least squares: exposure and white balance are forgiven, detail is not, and no pixel that is
    scored takes part in the fit.
    """
    source, target, right = comparable(rendered, truth, valid)
    left, middle = right.copy(), source.shape[1] // 2
    left[:, middle:], right[:, :middle] = False, False
    if left.sum() < FEWEST or not right.any():
        return None
    matrix, *_ = np.linalg.lstsq(np.c_[source[left], np.ones(left.sum())], target[left], rcond=None)
    return psnr(np.clip(source @ matrix[:3] + matrix[3], 0, 1), truth, right)


def has_depth(depth: Array) -> Array:
    """Where a depth map (H, W) holds a depth: above 0 and finite, by bounds between which no ratio and no square overflows."""
    with np.errstate(invalid="ignore"):
        return (np.asarray(depth) > NEAREST) & (np.asarray(depth) < FARTHEST)


def depth_metrics(rendered: Array, truth: Array, valid: Array | None = None) -> dict[str, Any]:
    """Compare z-depths (H, W) in the same unit of length, 0 or not finite = missing, on pixels where both have one (and `valid` is true).

    Returns:
        `abs_err` mean |d − d*| and `rmse`, in the unit of the maps; `abs_rel` mean and `median_rel` median of |d − d*| / d*;
        `delta_1..3`, the shares with max(d/d*, d*/d) below 1.25, 1.25², 1.25³; `within_5_percent`, the share with |d − d*| < 0.05·d*
        (both scale-free); `coverage`, the share of pixels with a true depth that have a rendered one; `pixels`, how many were compared.
        Each is None when there is no pixel for it.

    Raises:
        InputError: sizes differ.
    """
    rendered, truth = np.asarray(rendered, dtype=np.float64), np.asarray(truth, dtype=np.float64)
    if rendered.shape != truth.shape or rendered.ndim != 2:
        raise InputError(f"the rendered depth has shape {rendered.shape} and the true one {truth.shape}; both must be (height, width)")
    known = has_depth(truth) & _mask(valid, truth.shape)
    both = known & has_depth(rendered)
    out: dict[str, Any] = {**dict.fromkeys(DEPTH_KEYS), "pixels": int(both.sum())}
    if known.any():
        out["coverage"] = out["pixels"] / int(known.sum())
    if out["pixels"] == 0:
        return out
    d, t = rendered[both], truth[both]
    error, relative, ratio = np.abs(d - t), np.abs(d - t) / t, np.maximum(d / t, t / d)
    out |= {"abs_err": float(error.mean()), "rmse": float(np.sqrt(np.mean(error**2)))}
    out |= {"abs_rel": float(relative.mean()), "median_rel": float(np.median(relative))}
    out |= {f"delta_{power}": float(np.mean(ratio < 1.25**power)) for power in (1, 2, 3)}
    return out | {"within_5_percent": float(np.mean(relative < 0.05))}


def depth_accuracy(rendered: Array, truth: Array, scale: float, valid: Array | None = None) -> dict[str, float | None]:
    """The two depth measures of MVSNeRF and NeRFusion, with lengths in shares of `scale` instead of a data set's units.

    Returns:
        `abs_err`, mean |d − d*| / scale where both maps have depth; `acc_1` and `acc_5`, the shares of all pixels with a true depth where
        |d − d*| is below 1% and 5% of scale (a pixel without a rendered depth is wrong). None when there is no such pixel.
    """
    known = has_depth(truth) & _mask(valid, truth.shape)
    both = known & has_depth(rendered)
    error = np.abs(np.asarray(rendered, np.float64)[both] - np.asarray(truth, np.float64)[both]) / scale
    out: dict[str, float | None] = {"abs_err": float(error.mean()) if len(error) else None}
    return out | {key: float((error < limit).sum() / known.sum()) if known.any() else None for key, limit in WITHIN.items()}
