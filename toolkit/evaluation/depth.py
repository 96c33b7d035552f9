"""Depth metrics of a rendered depth map against a measured or true one, in the style of the paper's tables."""

from __future__ import annotations

from typing import Any

import numpy as np

from fieldfuse.camera import Array
from fieldfuse.errors import InputError

KEYS = ("abs_err", "abs_rel", "rmse", "median_rel", "delta_1", "delta_2", "delta_3", "within_5_percent", "coverage")
NEAREST, FARTHEST = 1e-12, 1e30


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
    rendered = np.asarray(rendered, dtype=np.float64)
    truth = np.asarray(truth, dtype=np.float64)
    if rendered.shape != truth.shape or rendered.ndim != 2:
        raise InputError(f"the rendered depth has shape {rendered.shape} and the true one {truth.shape}; both must be (height, width)")
    known = has_depth(truth)
    if valid is not None:
        if np.shape(valid) != truth.shape:
            raise InputError(f"a mask of shape {np.shape(valid)} does not fit a depth map of shape {truth.shape}")
        known &= np.asarray(valid).astype(bool)
    both = known & has_depth(rendered)
    pixels = int(both.sum())
    out: dict[str, Any] = dict.fromkeys(KEYS)
    out["pixels"] = pixels
    if known.any():
        out["coverage"] = pixels / int(known.sum())
    if pixels == 0:
        return out
    d, t = rendered[both], truth[both]
    error = np.abs(d - t)
    relative = error / t
    ratio = np.maximum(d / t, t / d)
    out["abs_err"] = float(error.mean())
    out["rmse"] = float(np.sqrt(np.mean(error**2)))
    out["abs_rel"] = float(relative.mean())
    out["median_rel"] = float(np.median(relative))
    for power in (1, 2, 3):
        out[f"delta_{power}"] = float(np.mean(ratio < 1.25**power))
    out["within_5_percent"] = float(np.mean(relative < 0.05))
    return out
