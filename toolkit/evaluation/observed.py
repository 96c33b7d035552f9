"""What tells a field that learned its training images by heart from one that shows the scene: its score at training views, and which part
of a held-out image the training cameras saw."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.capture.types import Views
from fieldfuse.evaluation.coverage import in_picture
from fieldfuse.evaluation.depth import has_depth
from fieldfuse.evaluation.images import psnr
from fieldfuse.evaluation.score import entry, mean

MOST_VIEWS = 8  # training views that are rendered
MOST_PIXELS = 4096  # of each: its mean error is known to a few per cent, in a tenth of a second
MOST_POINTS = 1024  # of a held-out image


def every_nth(camera: Intrinsics, step: int) -> Intrinsics:
    """The camera of an image's rows and columns 0, `step`, 2 `step`, …: the same rays, fewer of them."""
    return replace(
        camera,
        width=-(-camera.width // step),
        height=-(-camera.height // step),
        fx=camera.fx / step,
        fy=camera.fy / step,
        cx=(camera.cx - 0.5) / step + 0.5,
        cy=(camera.cy - 0.5) / step + 0.5,
    )


def step_for(width: int, height: int, most: int) -> int:
    """The least step at which an image has at most `most` pixels left."""
    return max(1, int(np.ceil(np.sqrt(width * height / most))))


def training_psnr(show: Callable[[Intrinsics, Array], Array], views: Views) -> float | None:
    """Mean PSNR of a few training views at some of their pixels, in the colours in which the fit saw them; None without training views.

    Args:
        show: answers (H, W, 3), float in [0, 1] or uint8, for a camera and its pose (4, 4) in the working frame.
    """
    train = np.flatnonzero(~np.asarray(views.test, dtype=bool))
    chosen = train[np.unique(np.linspace(0, len(train) - 1, min(MOST_VIEWS, len(train))).round().astype(int))] if len(train) else train
    scores = []
    for index in map(int, chosen):
        camera, valid = views.intrinsics[index], entry(views.valid, index)
        step = step_for(camera.width, camera.height, MOST_PIXELS)
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
    step = step_for(camera.width, camera.height, MOST_POINTS)
    z = np.asarray(depth, dtype=np.float64)[step // 2 :: step, step // 2 :: step]
    v, u = np.mgrid[step // 2 : camera.height : step, step // 2 : camera.width : step] + 0.5
    local = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=-1)[has_depth(z)]
    if len(local) == 0:
        return None
    points = local @ pose[:3, :3].T + pose[:3, 3]
    count = np.zeros(len(points), dtype=int)
    for other in np.flatnonzero(~np.asarray(views.test, dtype=bool)):
        count += in_picture(points, views.intrinsics[other], views.world_from_camera[other])
    return float(np.mean(count >= 2))
