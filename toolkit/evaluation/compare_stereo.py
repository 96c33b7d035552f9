"""How good depth by matching is, beside a depth that is known: over all pixels, and over those that show some texture."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np

from fieldfuse.camera import Array
from fieldfuse.capture.types import Views
from fieldfuse.evaluation.depth import has_depth
from fieldfuse.stereo.match import StereoDepth

WINDOW = 7  # pixels a side
TEXTURE = 4.0  # grey levels: standard deviation in a window from which on a pixel counts as textured


def textured(picture: Array, width: int, height: int) -> Array:
    """(height, width) bool: where a picture (h, w, 3) uint8, at that size, varies enough to be matched."""
    small = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
    grey = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY).astype(np.float32)
    mean = cv2.boxFilter(grey, cv2.CV_32F, (WINDOW, WINDOW))
    variance = cv2.boxFilter(grey * grey, cv2.CV_32F, (WINDOW, WINDOW)) - mean * mean
    return np.asarray(np.sqrt(np.maximum(variance, 0)) >= TEXTURE)


def matched_depth_scores(views: Views, found: Sequence[StereoDepth], truths: Sequence[Array | None]) -> dict[str, Any] | None:
    """Depth maps by matching against known ones.

    Args:
        found: one depth map a view.
        truths: (H, W) depth of each view on its own pixels, 0 = unknown; None: not known.

    Returns:
        `views`, how many could be compared; `median_rel`, the median of |d − d*| / d*, and `coverage`, the share of pixels with a known
        depth that have a matched one; both again as `median_rel_textured` and `coverage_textured`; `textured`, the share of textured
        pixels. Medians and shares are over the pixels of all views together. None when no depth is known.
    """
    errors: dict[bool, list[Array]] = {False: [], True: []}
    known_count, matched_count = {False: 0, True: 0}, {False: 0, True: 0}
    count = 0
    for picture, one, truth in zip(views.images, found, truths, strict=True):
        if truth is None or not has_depth(truth).any():
            continue
        count += 1
        height, width = one.depth.shape
        target = truth if truth.shape == one.depth.shape else cv2.resize(truth, (width, height), interpolation=cv2.INTER_NEAREST)
        for only, mask in ((False, np.ones((height, width), bool)), (True, textured(picture, width, height))):
            known = has_depth(target) & mask
            both = known & has_depth(one.depth)
            known_count[only] += int(known.sum())
            matched_count[only] += int(both.sum())
            errors[only].append(np.abs(one.depth[both] - target[both]) / target[both])
    if not count:
        return None
    out: dict[str, Any] = {"views": count}
    for only, suffix in ((False, ""), (True, "_textured")):
        values = np.concatenate(errors[only])
        out[f"median_rel{suffix}"] = float(np.median(values)) if len(values) else None
        out[f"coverage{suffix}"] = matched_count[only] / known_count[only] if known_count[only] else None
    out["textured"] = known_count[True] / known_count[False]
    return out
