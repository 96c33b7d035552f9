"""Scores of rendered views against held-out pictures: a list of views and the means that reports show."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Protocol

import numpy as np

from fieldfuse.camera import Array
from fieldfuse.capture.types import Views
from fieldfuse.errors import InputError
from fieldfuse.evaluation.affine import right_half_psnr
from fieldfuse.evaluation.depth import KEYS as DEPTH_KEYS
from fieldfuse.evaluation.depth import depth_metrics
from fieldfuse.evaluation.images import lpips, psnr, ssim
from fieldfuse.evaluation.pixels import as_float


class RenderedView(Protocol):
    """What a renderer answers. A surface's has `mask` (H, W) bool besides: where there is surface."""

    @property
    def rgb(self) -> Array: ...  # (H, W, 3) float in [0, 1] or uint8

    @property
    def depth(self) -> Array: ...  # (H, W) along z, working units, 0 = missing


MEANS = ("psnr", "ssim", "lpips", "depth_abs_err", "psnr_corrected", "psnr_masked", "coverage")


def entry(values: list[Any] | None, index: int) -> Any:
    """The entry of one of the optional lists of `Views`, None when the list is empty."""
    return values[index] if values else None


def mean(values: Iterable[float | None]) -> float | None:
    """Mean of what is known, None when nothing is."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def as_photo(rendered: RenderedView, views: Views, index: int) -> Array:
    """The rendered picture (H, W, 3) float64 in the colours in which the photo of view `index` was taken; where a surface has nothing,
    the capture's known background colour is filled in."""
    rgb = as_float(rendered.rgb)
    mask = getattr(rendered, "mask", None)
    if mask is not None and views.background is not None:
        rgb = np.where(np.asarray(mask).astype(bool)[..., None], rgb, np.asarray(views.background, dtype=np.float64))
    return views.as_taken(index, rgb)


def score_view(rendered: RenderedView, views: Views, index: int) -> dict[str, Any]:
    """Scores of one view: `name`, `psnr`, `ssim`, `lpips`, `depth_abs_err`, `depth` (all depth metrics or None), `psnr_corrected`,
    `psnr_masked`, `coverage`.

    The last two are for renders with a mask: PSNR where there is surface, and its share of the valid pixels; else None.

    Raises:
        InputError: the rendering has another size than the view.
    """
    truth = views.photo(index)
    valid = entry(views.valid, index)
    rgb = as_photo(rendered, views, index)
    out: dict[str, Any] = {
        "name": views.names[index],
        "psnr": psnr(rgb, truth, valid),
        "ssim": ssim(rgb, truth, valid),
        "lpips": lpips(rgb, truth, valid),
        "depth_abs_err": None,
        "psnr_corrected": right_half_psnr(rgb, truth, valid),
        "psnr_masked": None,
        "coverage": None,
        "depth": None,
    }
    true_depth = entry(views.depths, index)
    if true_depth is not None and rendered.depth is not None:
        out["depth"] = depth_metrics(rendered.depth, true_depth, valid)
        out["depth_abs_err"] = out["depth"]["abs_err"]
    mask = getattr(rendered, "mask", None)
    if mask is not None:
        wanted = np.ones(np.shape(mask), dtype=bool) if valid is None else np.asarray(valid).astype(bool)
        seen = np.asarray(mask).astype(bool) & wanted
        out["psnr_masked"] = psnr(rgb, truth, seen)
        out["coverage"] = float(seen.sum() / wanted.sum()) if wanted.any() else None
    return out


def score_views(
    rendered: Iterable[RenderedView], views: Views, indices: Sequence[int] | Array, seconds_per_view: float | Sequence[float] | None = None
) -> dict[str, Any]:
    """Scores over views: `rendered` has one picture for each of `indices` (a generator is fine, pictures are not kept).

    Returns:
        plain JSON data: `views` (how many), the means `psnr`, `ssim`, `lpips`, `depth_abs_err` (working units), `psnr_masked`, `coverage`,
        `seconds_per_view`, `depth` (means of all depth metrics, or None) and `per_view`, the list of `score_view`. What is not available
        is None; a mean is over the views that have the number.

    Raises:
        InputError: a rendering has another size than its view, or there are more or fewer renderings than indices.
    """
    wanted = [int(index) for index in indices]
    per_view: list[dict[str, Any]] = []
    for picture in rendered:
        if len(per_view) == len(wanted):
            raise InputError(f"there are more rendered pictures than the {len(wanted)} views to score; give one for each")
        index = wanted[len(per_view)]
        per_view.append({"index": index, **score_view(picture, views, index)})
    if len(per_view) < len(wanted):
        raise InputError(f"there are {len(per_view)} rendered pictures for {len(wanted)} views to score; give one for each")
    if isinstance(seconds_per_view, (int, float)) or seconds_per_view is None:
        seconds = None if seconds_per_view is None else float(seconds_per_view)
    else:
        seconds = mean(float(value) for value in seconds_per_view)
    depths = [view["depth"] for view in per_view if view["depth"] is not None]
    return {
        "views": len(per_view),
        **{key: mean(view[key] for view in per_view) for key in MEANS},
        "seconds_per_view": seconds,
        "depth": {key: mean(depth[key] for depth in depths) for key in DEPTH_KEYS} if depths else None,
        "per_view": per_view,
    }
