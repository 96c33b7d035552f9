"""Scores of rendered views against held-out images, of several methods on the same pixels, and what their numbers are held against."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Protocol

import cv2
import numpy as np

from fieldfuse.camera import Array, Intrinsics, invert
from fieldfuse.capture.types import Views
from fieldfuse.errors import InputError
from fieldfuse.evaluation.metrics import DEPTH_KEYS, WITHIN, as_float, depth_accuracy, depth_metrics, has_depth, psnr, right_half_psnr, ssim
from fieldfuse.evaluation.perceptual import lpips

if TYPE_CHECKING:
    from fieldfuse.stereo.match import StereoDepth

MEANS = ("psnr", "ssim", "lpips", "depth_abs_err", "psnr_corrected", "psnr_masked", "coverage")
MEASURES: dict[str, Callable[..., float | None]] = {"psnr": psnr, "ssim": ssim, "lpips": lpips}
MOST_VIEWS = 8  # training views that are rendered
MOST_PIXELS = 4096  # of each: its mean error is then known to a few per cent, in a tenth of a second
MOST_POINTS = 1024  # of a held-out image
TEXTURE_WINDOW = 7  # pixels a side
TEXTURE = 4.0  # grey levels: standard deviation in a window from which on a pixel counts as textured


class RenderedView(Protocol):
    """What a renderer answers. A surface's has `mask` (H, W) bool besides: where there is surface."""

    @property
    def rgb(self) -> Array: ...  # (H, W, 3) float in [0, 1] or uint8

    @property
    def depth(self) -> Array: ...  # (H, W) along z, working units, 0 = missing


def entry(values: list[Any] | None, index: int) -> Any:
    """The entry of one of the optional lists of `Views`, None when the list is empty."""
    return values[index] if values else None


def mean(values: Iterable[float | None]) -> float | None:
    """Mean of what is known, None when nothing is."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def as_photo(rendered: RenderedView, views: Views, index: int) -> Array:
    """The render (H, W, 3) float64 in the colours in which the photo of view `index` was taken; where a surface has nothing, the capture's
    known background colour is filled in."""
    rgb, mask = as_float(rendered.rgb), getattr(rendered, "mask", None)
    if mask is not None and views.background is not None:
        rgb = np.where(np.asarray(mask).astype(bool)[..., None], rgb, np.asarray(views.background, dtype=np.float64))
    return views.as_taken(index, rgb)


def score_view(rendered: RenderedView, views: Views, index: int) -> dict[str, Any]:
    """Scores of one view: `name`, `psnr`, `ssim`, `lpips`, `depth_abs_err`, `depth` (all depth metrics or None), `psnr_corrected`,
    `psnr_masked`, `coverage`.

    The last two are for renders with a mask: PSNR where there is surface, and its share of the valid pixels; else None.

    Raises:
        InputError: the render has another size than the view.
    """
    truth, valid, rgb = views.photo(index), entry(views.valid, index), as_photo(rendered, views, index)
    out: dict[str, Any] = {
        "name": views.names[index],
        **{key: measure(rgb, truth, valid) for key, measure in MEASURES.items()},
        "psnr_corrected": right_half_psnr(rgb, truth, valid),
        **dict.fromkeys(("depth_abs_err", "psnr_masked", "coverage", "depth")),
    }
    true_depth, mask = entry(views.depths, index), getattr(rendered, "mask", None)
    if true_depth is not None and rendered.depth is not None:
        out["depth"] = depth_metrics(rendered.depth, true_depth, valid)
        out["depth_abs_err"] = out["depth"]["abs_err"]
    if mask is not None:
        wanted = np.ones(np.shape(mask), dtype=bool) if valid is None else np.asarray(valid).astype(bool)
        seen = np.asarray(mask).astype(bool) & wanted
        out["psnr_masked"] = psnr(rgb, truth, seen)
        out["coverage"] = float(seen.sum() / wanted.sum()) if wanted.any() else None
    return out


def score_views(
    rendered: Iterable[RenderedView], views: Views, indices: Sequence[int] | Array, seconds_per_view: float | Sequence[float] | None = None
) -> dict[str, Any]:
    """Scores over views: `rendered` has one render for each of `indices` (a generator is fine, renders are not kept).

    Returns:
        plain JSON data: `views` (how many), the means `psnr`, `ssim`, `lpips`, `depth_abs_err` (working units), `psnr_masked`, `coverage`,
        `seconds_per_view`, `depth` (means of all depth metrics, or None) and `per_view`, the list of `score_view`. What is not available
        is None; a mean is over the views that have the number.

    Raises:
        InputError: a render has another size than its view, or there are more or fewer renders than indices.
    """
    wanted, given = [int(index) for index in indices], iter(rendered)
    per_view = [{"index": index, **score_view(one, views, index)} for index, one in zip(wanted, given, strict=False)]
    if len(per_view) < len(wanted) or next(given, None) is not None:
        count = "more" if len(per_view) == len(wanted) else str(len(per_view))
        raise InputError(f"there are {count} renders for {len(wanted)} views to score; give one for each")
    each = [seconds_per_view] if isinstance(seconds_per_view, (int, float)) else seconds_per_view
    depths = [view["depth"] for view in per_view if view["depth"] is not None]
    return {
        "views": len(per_view),
        **{key: mean(view[key] for view in per_view) for key in MEANS},
        "seconds_per_view": mean(float(value) for value in each or []),
        "depth": {key: mean(depth[key] for depth in depths) for key in DEPTH_KEYS} if depths else None,
        "per_view": per_view,
    }


def compare_views(
    renders: Mapping[str, Sequence[RenderedView]],
    views: Views,
    indices: Sequence[int] | Array,
    seconds: Mapping[str, Sequence[float]] | None = None,
    depths: Sequence[Array | None] | None = None,
) -> dict[str, dict[str, Any]]:
    """Scores of each method so that one with holes and one without can be compared; `renders` holds one for each of `indices`, in order.

    Args:
        seconds: of each render, by method.
        depths: true depth (H, W) of the views at `indices`, working units; None: what `views` holds (a sensor's).

    Returns:
        method → what `score_views` answers over the whole image, and besides: `on`, for each method that has a mask, `psnr`, `ssim` and
        `lpips` on those pixels where that one shows surface (so a field and a surface can be compared on the same pixels); `depth_scale`,
        the median of all true depths, and `abs_err`, `acc_1`, `acc_5` of `depth_accuracy`.
    """
    chosen = [int(index) for index in indices]
    if depths is not None:
        by_view: list[Array | None] = [None] * len(views)
        for index, depth in zip(chosen, depths, strict=True):
            by_view[index] = depth
        views = replace(views, depths=by_view)
    true = {index: depth for index in chosen if (depth := entry(views.depths, index)) is not None}
    known = np.concatenate([np.zeros(0), *(depth[has_depth(depth)][::7] for depth in true.values())])
    scale = float(np.median(known)) if len(known) else None
    surfaces = [name for name, shown in renders.items() if shown and getattr(shown[0], "mask", None) is not None]
    out: dict[str, dict[str, Any]] = {}
    for name, shown in renders.items():
        others = [other for other in surfaces if name == other or name not in surfaces]
        on = {other: _on(shown, renders[other], views, chosen) for other in others}
        each = []
        for one, index in zip(shown, chosen, strict=True):
            if index in true and scale is not None:
                each.append(depth_accuracy(one.depth, true[index], scale, entry(views.valid, index)))
        errors = {key: mean(one[key] for one in each) for key in ("abs_err", *WITHIN)}
        score = score_views(shown, views, chosen, None if seconds is None else list(seconds[name]))
        out[name] = score | {"on": on, "depth_scale": scale} | errors
    return out


def _on(shown: Sequence[RenderedView], surface: Sequence[RenderedView], views: Views, indices: Sequence[int]) -> dict[str, float | None]:
    """Means of the image measures where `surface` shows something."""
    found: list[list[float | None]] = []
    for one, other, index in zip(shown, surface, indices, strict=True):
        valid, mask = entry(views.valid, index), np.asarray(getattr(other, "mask", None)).astype(bool)
        mask = mask if valid is None else mask & np.asarray(valid).astype(bool)
        rgb, truth = as_photo(one, views, index), views.photo(index)
        found.append([measure(rgb, truth, mask) for measure in MEASURES.values()])
    return {key: mean(values) for key, values in zip(MEASURES, zip(*found, strict=True), strict=True)}


def matched_depth_scores(views: Views, found: Sequence[StereoDepth], truths: Sequence[Array | None]) -> dict[str, Any] | None:
    """Depth maps by matching against known ones, over all pixels, and over those that show some texture.

    Args:
        found: one depth map a view.
        truths: (H, W) depth of each view on its own pixels, 0 = unknown; None: not known.

    Returns:
        `views`, how many could be compared; `median_rel`, the median of |d − d*| / d*, and `coverage`, the share of pixels with a known
        depth that have a matched one; both again as `median_rel_textured` and `coverage_textured`; `textured`, the share of textured
        pixels. Medians and shares are over the pixels of all views together. None when no depth is known.
    """
    known, matched, textured, errors = [], [], [], []
    for image, one, truth in zip(views.images, found, truths, strict=True):
        if truth is None or not has_depth(truth).any():
            continue
        height, width = one.depth.shape
        target = truth if truth.shape == one.depth.shape else cv2.resize(truth, (width, height), interpolation=cv2.INTER_NEAREST)
        small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        grey, window = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY).astype(np.float32), (TEXTURE_WINDOW, TEXTURE_WINDOW)
        average = cv2.boxFilter(grey, cv2.CV_32F, window)
        variance = cv2.boxFilter(grey * grey, cv2.CV_32F, window) - average * average
        at = has_depth(target)
        known.append(np.count_nonzero(at))
        matched.append(has_depth(one.depth)[at])
        textured.append((np.sqrt(np.maximum(variance, 0)) >= TEXTURE)[at])
        errors.append(np.abs(one.depth - target)[at] / target[at])
    if not known:
        return None
    both, rough, error = (np.concatenate(parts) for parts in (matched, textured, errors))
    out: dict[str, Any] = {"views": len(known)}
    for suffix, some in (("", np.ones(len(both), bool)), ("_textured", rough)):
        out[f"median_rel{suffix}"] = float(np.median(error[both & some])) if (both & some).any() else None
        out[f"coverage{suffix}"] = float(both[some].mean()) if some.any() else None
    return out | {"textured": float(rough.mean())}


# ------------------------------------------------------------------------------------ what scores are held against


def nearest_training(views: Views, index: int) -> int | None:
    """The training view whose camera is closest to that of view `index`; None without training views.

    Distance between centres in units of the cameras' spread (root mean square distance from their mean), plus the angle between the
    optical axes in radians: either alone picks a wrong neighbour (same place, other direction; same direction, other side).
    """
    train = np.flatnonzero(~np.asarray(views.test, dtype=bool))
    train = train[train != index]
    if len(train) == 0:
        return None
    poses = np.asarray(views.world_from_camera, dtype=np.float64)
    centres, axes = poses[:, :3, 3], poses[:, :3, 2]
    spread = float(np.sqrt(np.mean(np.sum((centres - centres.mean(axis=0)) ** 2, axis=1))))
    gap = np.linalg.norm(centres[train] - centres[index], axis=1)
    turn = np.arccos(np.clip(axes[train] @ axes[index], -1, 1))
    return int(train[np.argmin((gap / spread if spread > 0 else gap) + turn)])


def nearest_image_scores(views: Views, indices: Sequence[int] | Array) -> dict[str, Any]:
    """PSNR of the nearest training image at each of `indices`, resized where sizes differ: the floor under every score.

    Returns:
        `views`, the mean `psnr` (dB), `psnr_uncorrected` (the same of images as they were taken, where colours were corrected; else None),
        and `per_view` with `index`, `name`, `nearest` (a name) and both; None without training views.
    """

    def resized(image: Array, like: Array) -> Array:
        size = (like.shape[1], like.shape[0])
        return image if image.shape == like.shape else np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))

    per_view: list[dict[str, Any]] = []
    for index in (int(i) for i in indices):
        out = {"index": index, "name": views.names[index], **dict.fromkeys(("nearest", "psnr", "psnr_uncorrected"))}
        nearest = nearest_training(views, index)
        if nearest is not None:
            truth, valid = views.photo(index), entry(views.valid, index)
            image, tone = as_float(views.images[nearest]), entry(views.tones, nearest)
            out |= {"nearest": views.names[nearest], "psnr": psnr(views.as_taken(index, resized(image, truth)), truth, valid)}
            if tone is not None:
                out["psnr_uncorrected"] = psnr(resized(tone.applied(image, views.intrinsics[nearest]), truth), truth, valid)
        per_view.append(out)
    means = {key: mean(view[key] for view in per_view) for key in ("psnr", "psnr_uncorrected")}
    return {"views": len(per_view), **means, "per_view": per_view}


def every_nth(camera: Intrinsics, step: int) -> Intrinsics:
    """The camera of an image's rows and columns 0, `step`, 2 `step`, …: the same rays, fewer of them."""
    width, height = -(-camera.width // step), -(-camera.height // step)
    cx, cy = ((at - 0.5) / step + 0.5 for at in (camera.cx, camera.cy))
    return replace(camera, width=width, height=height, fx=camera.fx / step, fy=camera.fy / step, cx=cx, cy=cy)


def _step(camera: Intrinsics, most: int) -> int:
    """The least step at which an image has at most `most` pixels left."""
    return max(1, int(np.ceil(np.sqrt(camera.width * camera.height / most))))


def training_psnr(show: Callable[[Intrinsics, Array], Array], views: Views) -> float | None:
    """Mean PSNR of a few training views at some of their pixels, in the colours in which the fit saw them; None without training views.

    Beside the score of held-out views it shows whether a field has learned its training images by heart.

    Args:
        show: answers (H, W, 3), float in [0, 1] or uint8, for a camera and its pose (4, 4) in the working frame.
    """
    train = np.flatnonzero(~np.asarray(views.test, dtype=bool))
    chosen = train[np.unique(np.linspace(0, len(train) - 1, min(MOST_VIEWS, len(train))).round().astype(int))] if len(train) else train
    scores = []
    for index in map(int, chosen):
        camera, valid = views.intrinsics[index], entry(views.valid, index)
        step = _step(camera, MOST_PIXELS)
        shown = show(every_nth(camera, step), views.world_from_camera[index])
        scores.append(psnr(shown, views.images[index][::step, ::step], None if valid is None else valid[::step, ::step]))
    return mean(scores)


def seen_share(depth: Array, views: Views, index: int) -> float | None:
    """Share of view `index`'s rendered surface that at least two training cameras have in their image, whatever stands before it; None
    where nothing is rendered.

    Args:
        depth: (H, W) along z in working units, 0 = none.
    """
    camera, pose = views.intrinsics[index], np.asarray(views.world_from_camera[index], dtype=np.float64)
    step = _step(camera, MOST_POINTS)
    z = np.asarray(depth, dtype=np.float64)[step // 2 :: step, step // 2 :: step]
    v, u = np.mgrid[step // 2 : camera.height : step, step // 2 : camera.width : step] + 0.5
    local = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=-1)[has_depth(z)]
    if len(local) == 0:
        return None
    points = local @ pose[:3, :3].T + pose[:3, 3]
    train = np.flatnonzero(~np.asarray(views.test, dtype=bool))
    count = sum((in_image(points, views.intrinsics[i], views.world_from_camera[i]).astype(int) for i in train), np.zeros(len(points), int))
    return float(np.mean(count >= 2))


def in_image(points: Array, camera: Intrinsics, world_from_camera: Array) -> Array:
    """(N,) bool: which (N, 3) points lie in front of a pinhole camera and inside its image."""
    pose = invert(world_from_camera)
    local = points @ pose[:3, :3].T + pose[:3, 3]
    z = np.where(local[:, 2] > 1e-9, local[:, 2], np.nan)
    with np.errstate(invalid="ignore"):
        u, v = local[:, 0] / z * camera.fx + camera.cx, local[:, 1] / z * camera.fy + camera.cy
        return np.asarray((u >= 0) & (u <= camera.width) & (v >= 0) & (v <= camera.height))
