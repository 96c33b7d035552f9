"""Image metrics: PSNR and SSIM on the pixels that have a truth, and LPIPS (from `perceptual`) under the same roof.

All take a rendered and a true picture (H, W, 3), float in [0, 1] or uint8, and an optional (H, W) bool mask of pixels to compare.
They answer None where nothing can be compared, never NaN.
"""

from __future__ import annotations

import cv2
import numpy as np

from fieldfuse.camera import Array
from fieldfuse.evaluation.perceptual import lpips
from fieldfuse.evaluation.pixels import checked_mask, pair

__all__ = ["PSNR_CAP", "lpips", "psnr", "ssim"]

PSNR_CAP = 100.0  # dB; identical pictures have no finite PSNR, and infinity is not JSON

WINDOW = 11  # Wang et al. 2004, section III.B: 11×11 Gaussian, standard deviation 1.5, K1 = 0.01, K2 = 0.03, L = 1 here
SIGMA = 1.5
C1 = 0.01**2
C2 = 0.03**2


def psnr(rendered: Array, truth: Array, valid: Array | None = None) -> float | None:
    """Peak signal-to-noise ratio in dB over all channels of the valid pixels, at most `PSNR_CAP`; None without a valid pixel.

    Raises:
        InputError: sizes differ.
    """
    first, second = pair(rendered, truth)
    mask = checked_mask(valid, first.shape)
    if not mask.any():
        return None
    error = float(np.mean((first[mask] - second[mask]) ** 2))
    return PSNR_CAP if error <= 10 ** (-PSNR_CAP / 10) else float(-10 * np.log10(error))


def ssim_map(first: Array, second: Array) -> Array:
    """(H, W, C) float64 pair → (H − 10, W − 10, C) structural similarity of every window that lies fully inside (Wang et al., eq. 13)."""
    kernel = cv2.getGaussianKernel(WINDOW, SIGMA, cv2.CV_64F)
    edge = WINDOW // 2

    def mean(values: Array) -> Array:
        filtered = cv2.sepFilter2D(values, cv2.CV_64F, kernel, kernel, borderType=cv2.BORDER_REFLECT)
        return np.asarray(filtered).reshape(values.shape)[edge:-edge, edge:-edge]

    m1, m2 = mean(first), mean(second)
    # Differences of nearly equal numbers: below zero only by rounding.
    v1 = np.maximum(mean(first * first) - m1 * m1, 0)
    v2 = np.maximum(mean(second * second) - m2 * m2, 0)
    covariance = mean(first * second) - m1 * m2
    return ((2 * m1 * m2 + C1) * (2 * covariance + C2)) / ((m1 * m1 + m2 * m2 + C1) * (v1 + v2 + C2))


def ssim(rendered: Array, truth: Array, valid: Array | None = None) -> float | None:
    """Structural similarity in [−1, 1] as in Wang et al. 2004, each channel alone, then the mean.

    Only windows that lie fully inside the picture and on valid pixels count; None when there is none (a side below 11 pixels).

    Raises:
        InputError: sizes differ.
    """
    first, second = pair(rendered, truth)
    mask = checked_mask(valid, first.shape)
    if min(mask.shape) < WINDOW:
        return None
    edge = WINDOW // 2
    full = cv2.erode(mask.astype(np.uint8), np.ones((WINDOW, WINDOW), np.uint8))[edge:-edge, edge:-edge].astype(bool)
    if not full.any():
        return None
    return float(np.clip(ssim_map(first, second)[full].mean(), -1, 1))
