"""View dependence: light that changes with the direction of view, and does so alike for points that lie beside each other.

Wrong matches and the texture round a point change its light too, but each point's on its own. A highlight that wanders over a surface
changes neighbours together. With g_o what is left of observation o's light after its point's own and its frame's gain are taken out, and N
the pairs of observations beside each other in one picture,

    I = mean over N of g_i · g_j / mean of g²                                   (Moran's coefficient, with g held within ± LIMIT)
"""

from __future__ import annotations

import numpy as np

from fieldfuse.camera import Array
from fieldfuse.effects.evidence import Evidence

THRESHOLD = 0.11  # share of the variance
LIMIT = 0.3  # stops: more is a wrong match, or the mirror image of a lamp that says enough at this value
NEAREST, FARTHEST = 4.0, 24.0  # working pixels between neighbours: not the same blob twice, not another surface
NEIGHBOURS = 3
FEWEST = 200  # pairs


def evidence(left: Array, frame: Array, place: Array) -> Evidence:
    """Share of the variance of points' light that neighbours share.

    Args:
        left: (O,) stops, from `light.left_over`.
        frame: (O,). place: (O, 2) working pixels.
    """
    held = np.clip(left, -LIMIT, LIMIT)
    first, second = neighbours(frame, place)
    variance = float(np.mean(held**2)) if len(held) else 0.0
    if len(first) < FEWEST or variance <= 0:
        return Evidence("view_dependence", 0.0, THRESHOLD, "too few points lie beside each other to compare how their light changes")
    products = held[first] * held[second]
    sure = float(products.mean()) - 3 * float(products.std()) / np.sqrt(len(products))
    number = max(sure, 0.0) / variance
    return Evidence(
        "view_dependence",
        number,
        THRESHOLD,
        f"points beside each other share {100 * number:.0f}% of the variance with which their light changes between views; "
        f"{100 * THRESHOLD:.0f}% or more speak for highlights or reflections",
        {"stops": float(np.sqrt(variance))},
    )


def neighbours(frame: Array, place: Array) -> tuple[Array, Array]:
    """Pairs (N,), (N,) of observations in the same frame that lie beside each other, up to three an observation."""
    firsts, seconds = [], []
    for index in np.unique(frame):
        mine = np.flatnonzero(frame == index)
        if len(mine) < 2:
            continue
        away = np.linalg.norm(place[mine][:, None] - place[mine][None], axis=2)
        away[away < NEAREST] = np.inf
        near = np.argsort(away, axis=1)[:, :NEIGHBOURS]
        beside = np.take_along_axis(away, near, 1) < FARTHEST
        firsts.append(np.repeat(mine, near.shape[1])[beside.ravel()])
        seconds.append(mine[near.ravel()[beside.ravel()]])
    if not firsts:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    return np.concatenate(firsts), np.concatenate(seconds)
