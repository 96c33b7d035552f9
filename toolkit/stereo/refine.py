"""Depth between the planes: pictures are warped by the depth map itself, so a window follows the slope of the surface that it shows."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from fieldfuse.camera import Array
from fieldfuse.stereo.cost import GreyView, Matcher

EVEN = 5  # pixels a side of the median that the depth map is evened out with before pictures are warped by it
LEAST_BEND = 1e-4  # of the costs' parabola; flatter ones have no lowest point worth moving to


def refined(view: GreyView, others: Sequence[GreyView], inverse_depth: Array, step: float, rounds: int = 2) -> tuple[Array, Array]:
    """Each pixel moved to the lowest point of a parabola through three costs; the first round reaches half a `step` (the planes' distance)
    to either side, each next one half as far.

    Returns:
        (H, W) float32 inverse depth, and (H, W) float32 the lowest of the last round's costs.
    """
    matcher = Matcher(view, others)
    now = inverse_depth.astype(np.float32)
    three = np.empty((3, *now.shape), np.float32)
    for number in range(rounds):
        reach = np.float32(0.5 * step / 2**number)
        even = cv2.medianBlur(now, EVEN)
        for place, side in enumerate((-1, 0, 1)):
            three[place] = matcher.cost(even + side * reach)
        low, mid, high = three
        bend = low - 2 * mid + high
        shift = np.clip(0.5 * (low - high) / np.maximum(bend, LEAST_BEND), -1, 1)
        now = even + np.where(bend > LEAST_BEND, shift, 0).astype(np.float32) * reach
    return np.asarray(cv2.medianBlur(now, 3)), three.min(axis=0)
