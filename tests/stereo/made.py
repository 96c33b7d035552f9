"""Exact pictures that depth is looked for in."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.capture.types import Views
from fieldfuse.progress import Progress
from fieldfuse.stereo.match import StereoDepth
from tests.poses.textured import PLANES, arc, render, texture

CAMERA = Intrinsics(160, 120, 150.0, 150.0, 80.0, 60.0)
NEAR, FAR, MEDIAN = 1.0, 9.0, 3.4
PASSED = {1: (20, 30), 4: (95, 50)}  # picture → left and top of somebody who stands before it
WIDE, TALL = 38, 60


class Stopping(Progress):
    """The user asks to stop at once."""

    def stopping(self) -> bool:
        return True


def views_of(poses: Array, pictures: list[Array], camera: Intrinsics = CAMERA) -> Views:
    names = [f"{index:02d}" for index in range(len(poses))]
    return Views(names, pictures, [camera] * len(poses), np.asarray(poses), np.zeros(len(poses), bool))


@lru_cache(maxsize=1)
def corner() -> tuple[Views, list[Array]]:
    """Seven pictures and their exact depth."""
    poses = arc(7, 36.0)
    made = [render(pose, CAMERA) for pose in poses]
    return views_of(poses, [picture for picture, _ in made]), [depth for _, depth in made]


def filmed(paint: dict[int, tuple[int, int]]) -> tuple[Views, list[Array]]:
    """Seven pictures of the corner, some of whose sides are painted in one grey but for a frame so wide, and their exact depth."""
    textures = [texture(index) for index in range(len(PLANES))]
    for side, (grey, frame) in paint.items():
        textures[side][frame : 512 - frame, frame : 512 - frame] = grey
    planes = [(*plane, painted) for plane, painted in zip(PLANES, textures, strict=True)]
    poses = arc(7, 36.0)
    made = [render(pose, CAMERA, planes) for pose in poses]
    return views_of(poses, [picture for picture, _ in made]), [depth for _, depth in made]


def with_passer() -> tuple[Views, list[Array], list[Array]]:
    """The corner with somebody before two of its pictures, the exact depth with them, and where they are."""
    views, depths = corner()
    images, with_them, masks = list(views.images), list(depths), []
    stripes = np.array([[(200, 40, 30), (30, 60, 180)][row // 6 % 2] for row in range(TALL)], np.uint8)[:, None]
    for index in range(len(views)):
        mask = np.zeros((CAMERA.height, CAMERA.width), bool)
        if index in PASSED:
            left, top = PASSED[index]
            part = (slice(top, top + TALL), slice(left, left + WIDE))
            mask[part] = True
            images[index], with_them[index] = images[index].copy(), with_them[index].copy()
            images[index][part] = stripes
            with_them[index][part] = 1.2
        masks.append(mask)
    return replace(views, images=images), with_them, masks


def relative_errors(depths: list[StereoDepth], truth: list[Array]) -> tuple[Array, float]:
    """Errors over the truth where both are known, and the share of the true pixels that are."""
    both = [(one.depth > 0) & (true > 0) for one, true in zip(depths, truth, strict=True)]
    errors = [np.abs(one.depth - true)[known] / true[known] for one, true, known in zip(depths, truth, both, strict=True)]
    return np.concatenate(errors), float(sum(known.sum() for known in both) / sum((true > 0).sum() for true in truth))
