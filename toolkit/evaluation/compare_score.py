"""Scores of several methods on the same held-out views, told so that a method with holes and one without can be compared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from fieldfuse.camera import Array
from fieldfuse.capture.types import Views
from fieldfuse.evaluation.depth import has_depth
from fieldfuse.evaluation.images import lpips, psnr, ssim
from fieldfuse.evaluation.score import RenderedView, as_photo, entry, mean, score_views

WITHIN = (0.01, 0.05)  # thresholds of the depth's accuracy, in shares of the scale


def depth_scale(depths: Sequence[Array | None]) -> float | None:
    """The length that depth errors are told in: the median of all true depths; None when there is none."""
    known = [depth[has_depth(depth)][::7] for depth in depths if depth is not None]
    values = np.concatenate(known) if known else np.zeros(0)
    return float(np.median(values)) if len(values) else None


def depth_accuracy(rendered: Array, truth: Array, scale: float, valid: Array | None = None) -> dict[str, float | None]:
    """The two depth measures of MVSNeRF and NeRFusion, with lengths in shares of `scale` instead of a data set's units.

    Returns:
        `abs_err`, mean |d − d*| / scale where both maps have depth; `acc_1` and `acc_5`, the shares of all pixels with a true depth where
        |d − d*| is below 1% and 5% of scale (a pixel without a rendered depth is wrong). None when there is no such pixel.
    """
    known = has_depth(truth) if valid is None else has_depth(truth) & np.asarray(valid).astype(bool)
    both = known & has_depth(rendered)
    error = np.abs(np.asarray(rendered, np.float64)[both] - np.asarray(truth, np.float64)[both]) / scale
    out: dict[str, float | None] = {"abs_err": float(error.mean()) if len(error) else None}
    for threshold in WITHIN:
        out[f"acc_{round(100 * threshold)}"] = float((error < threshold).sum() / known.sum()) if known.any() else None
    return out


def compare_views(
    pictures: Mapping[str, Sequence[RenderedView]],
    views: Views,
    indices: Sequence[int] | Array,
    seconds: Mapping[str, Sequence[float]] | None = None,
    depths: Sequence[Array | None] | None = None,
) -> dict[str, dict[str, Any]]:
    """Scores of each method; `pictures` holds one rendering for each of `indices`, in that order.

    Args:
        seconds: of each picture, by method.
        depths: true depth (H, W) of the views at `indices`, working units; None: what `views` holds (a sensor's).

    Returns:
        method → what `score_views` answers over the whole picture, and besides: `on`, for each method that has a mask, `psnr`, `ssim` and
        `lpips` on those pixels where that one shows surface (so a field and a surface can be compared on the same pixels); `depth_scale`,
        and `abs_err`, `acc_1`, `acc_5` of `depth_accuracy`.
    """
    chosen = [int(index) for index in indices]
    if depths is not None:
        by_view: list[Array | None] = [None] * len(views)
        for index, depth in zip(chosen, depths, strict=True):
            by_view[index] = depth
        views = replace(views, depths=by_view)
    scale = depth_scale([entry(views.depths, index) for index in chosen])
    surfaces = [name for name, shown in pictures.items() if shown and getattr(shown[0], "mask", None) is not None]
    out: dict[str, dict[str, Any]] = {}
    for name, shown in pictures.items():
        score = score_views(shown, views, chosen, None if seconds is None else list(seconds[name]))
        score["on"] = {other: _on(shown, pictures[other], views, chosen) for other in surfaces if name == other or name not in surfaces}
        score["depth_scale"] = scale
        score |= _depth(shown, views, chosen, scale)
        out[name] = score
    return out


def _on(shown: Sequence[RenderedView], surface: Sequence[RenderedView], views: Views, indices: Sequence[int]) -> dict[str, float | None]:
    """Means of the picture measures where `surface` shows something."""
    found: dict[str, list[float | None]] = {"psnr": [], "ssim": [], "lpips": []}
    for picture, other, index in zip(shown, surface, indices, strict=True):
        valid = entry(views.valid, index)
        mask = np.asarray(getattr(other, "mask", None)).astype(bool)
        mask = mask if valid is None else mask & np.asarray(valid).astype(bool)
        rgb, truth = as_photo(picture, views, index), views.photo(index)
        for key, measure in (("psnr", psnr), ("ssim", ssim), ("lpips", lpips)):
            found[key].append(measure(rgb, truth, mask))
    return {key: mean(values) for key, values in found.items()}


def _depth(shown: Sequence[RenderedView], views: Views, indices: Sequence[int], scale: float | None) -> dict[str, float | None]:
    keys = ("abs_err", *(f"acc_{round(100 * threshold)}" for threshold in WITHIN))
    each = []
    for picture, index in zip(shown, indices, strict=True):
        truth = entry(views.depths, index)
        if truth is not None and scale is not None:
            each.append(depth_accuracy(picture.depth, truth, scale, entry(views.valid, index)))
    return {key: mean(one[key] for one in each) for key in keys}
