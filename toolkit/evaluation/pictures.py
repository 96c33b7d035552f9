"""Pictures for people: truth, render, error and depth of held-out views, as tiles for the pages.

Error maps have one fixed scale everywhere; depth maps have one range a run, so that tiles can be compared with each other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from fieldfuse.camera import Array
from fieldfuse.capture.types import Views
from fieldfuse.evaluation.metrics import as_float, has_depth
from fieldfuse.evaluation.score import RenderedView, as_photo, entry
from fieldfuse.export.surface import spread
from fieldfuse.stereo.transients import LeftOut

ERROR_TOP = 0.2  # mean absolute difference of the three channels, in [0, 1], that gets the brightest colour
ERROR_COLOURS = cv2.COLORMAP_INFERNO
DEPTH_COLOURS = cv2.COLORMAP_TURBO
TINT = (235, 40, 60)  # of what was left out
MISSING = (128, 128, 128)  # neutral grey: no depth, or no truth to compare with


@dataclass(frozen=True)
class Tiles:
    """What one method made of one view, all (H, W, 3) uint8 RGB."""

    render: Array
    error: Array
    depth: Array
    depth_error: Array | None = None  # where there is a true depth


@dataclass(frozen=True)
class ViewPictures:
    """One held-out view. `measured` is the capture's own depth in the same colours, when there is one."""

    name: str
    truth: Array  # (H, W, 3) uint8
    methods: dict[str, Tiles]  # "field", "tsdf", …
    measured: Array | None = None


@dataclass(frozen=True)
class Pictures:
    """Pictures of (some of) the test views; `depth_range` near and far in `unit`, None when no depth was seen."""

    views: list[ViewPictures] = field(default_factory=list)
    depth_range: tuple[float, float] | None = None
    unit: str = "units"
    left_out: int = 0  # test views of which no pictures were made
    moving: list[tuple[str, Array]] = field(default_factory=list)  # name, picture: training views, with what was left out of the fit tinted


def coloured(values: Array, colours: int) -> Array:
    """(H, W) floats in [0, 1] → (H, W, 3) uint8 RGB in an OpenCV colour map; what is outside is clamped."""
    levels = np.round(np.clip(np.nan_to_num(values), 0, 1) * 255).astype(np.uint8)
    return np.asarray(cv2.applyColorMap(levels, colours))[..., ::-1].copy()


def error_picture(rendered: Array, truth: Array, valid: Array | None = None) -> Array:
    """Mean absolute difference over channels on the fixed scale 0 … `ERROR_TOP`, (H, W, 3) uint8; grey where there is no truth."""
    picture = coloured(np.abs(as_float(rendered) - as_float(truth)).mean(axis=2) / ERROR_TOP, ERROR_COLOURS)
    if valid is not None:
        picture[~np.asarray(valid).astype(bool)] = MISSING
    return picture


def depth_range(depths: Sequence[Array]) -> tuple[float, float] | None:
    """Near and far (2nd and 98th percentile) over all depth maps (H, W) of a run; None when none holds a depth."""
    known = [depth[has_depth(depth)] for depth in depths]
    values = np.concatenate(known) if known else np.zeros(0)
    if values.size == 0:
        return None
    near, far = np.percentile(values, [2, 98])
    return float(near), float(max(far, near * 1.001))


def depth_picture(depth: Array, limits: tuple[float, float] | None) -> Array:
    """(H, W) depth → (H, W, 3) uint8, near blue to far red; grey where depth is missing."""
    depth = np.asarray(depth, dtype=np.float64)
    known = has_depth(depth)
    near, far = limits or (0.0, 1.0)
    picture = coloured(np.where(known, (depth - near) / (far - near), 0), DEPTH_COLOURS)
    picture[~known] = MISSING
    return picture


def depth_error_picture(depth: Array, truth: Array, top: float) -> Array:
    """|d − d*| on a scale of 0 … `top`, (H, W, 3) uint8; grey where either depth is missing."""
    known = has_depth(depth) & has_depth(truth)
    gap = np.abs(np.where(known, depth, 0) - np.where(known, truth, 0))
    picture = coloured(gap / max(top, 1e-12), ERROR_COLOURS)
    picture[~known] = MISSING
    return picture


def moving_pictures(views: Views, left_out: LeftOut | None, most: int = 12) -> list[tuple[str, Array]]:
    """Those training pictures of which most was left out of the fit, these pixels tinted, (H, W, 3) uint8, by name."""
    if left_out is None:
        return []
    worst = sorted(left_out.masks, key=lambda name: -float(left_out.masks[name].mean()))[:most]
    out = []
    for picture, name in zip(views.images, views.names, strict=True):
        if name not in worst:
            continue
        shown = left_out.mask(name, picture.shape[1], picture.shape[0])
        tinted = picture.copy()
        tinted[shown] = np.round(picture[shown] * np.float32(0.4) + np.float32(0.6) * np.array(TINT, np.float32))
        out.append((name, tinted))
    return out


def method_pictures(
    views: Views,
    indices: Sequence[int] | Array,
    methods: Mapping[str, Sequence[RenderedView]],
    unit: str = "units",
    most: int = 24,
    depth_error_top: float | None = None,
) -> Pictures:
    """Tiles of the views at `indices`; each of `methods` holds one rendering for each of them, in that order.

    At most `most` views are shown, evenly spread. With `depth_error_top` (working units) errors of depth are shown up to that.
    """
    chosen = spread(len(indices), most)
    rendered = {name: [list(of)[i] for i in chosen] for name, of in methods.items()}
    shown = [int(indices[i]) for i in chosen]
    measured = [entry(views.depths, index) for index in shown]
    limits = depth_range(
        [np.asarray(one.depth) for of in rendered.values() for one in of] + [depth for depth in measured if depth is not None]
    )
    out = []
    for place, index in enumerate(shown):
        truth, valid, sensor = views.photo(index), entry(views.valid, index), measured[place]
        tiles = {}
        for name, of in rendered.items():
            rgb, depth = as_photo(of[place], views, index), of[place].depth
            off = None if sensor is None or depth_error_top is None else depth_error_picture(depth, sensor, depth_error_top)
            render = np.round(rgb * 255).astype(np.uint8)
            tiles[name] = Tiles(render, error_picture(rgb, truth, valid), depth_picture(depth, limits), off)
        out.append(ViewPictures(views.names[index], truth, tiles, None if sensor is None else depth_picture(sensor, limits)))
    return Pictures(out, limits, unit, len(indices) - len(chosen))
