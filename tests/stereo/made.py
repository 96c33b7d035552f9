"""Exact pictures that depth is looked for in."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.capture.types import Views
from fieldfuse.stereo.match import StereoDepth
from tests.poses.textured import arc, render

CAMERA = Intrinsics(160, 120, 150.0, 150.0, 80.0, 60.0)
NEAR, FAR, MEDIAN = 1.0, 9.0, 3.4


def views_of(poses: Array, pictures: list[Array], camera: Intrinsics = CAMERA) -> Views:
    names = [f"{index:02d}" for index in range(len(poses))]
    return Views(names, pictures, [camera] * len(poses), np.asarray(poses), np.zeros(len(poses), bool))


@lru_cache(maxsize=1)
def corner() -> tuple[Views, list[Array]]:
    """Seven pictures and their exact depth."""
    poses = arc(7, 36.0)
    made = [render(pose, CAMERA) for pose in poses]
    return views_of(poses, [picture for picture, _ in made]), [depth for _, depth in made]


def relative_errors(depths: list[StereoDepth], truth: list[Array]) -> tuple[Array, float]:
    """Errors over the truth where both are known, and the share of the true pixels that are."""
    both = [(one.depth > 0) & (true > 0) for one, true in zip(depths, truth, strict=True)]
    errors = [np.abs(one.depth - true)[known] / true[known] for one, true, known in zip(depths, truth, both, strict=True)]
    return np.concatenate(errors), float(sum(known.sum() for known in both) / sum((true > 0).sum() for true in truth))
