"""The floor under every score: for each held-out view, the training picture taken nearest to it, shown unchanged."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np

from fieldfuse.camera import Array
from fieldfuse.capture.types import Views
from fieldfuse.evaluation.images import psnr
from fieldfuse.evaluation.pixels import as_float
from fieldfuse.evaluation.score import entry, mean

SCORES = ("psnr", "psnr_uncorrected")


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
    """PSNR of the nearest training picture at each of `indices`, resized where sizes differ.

    Returns:
        `views`, the mean `psnr` (dB), `psnr_uncorrected` (the same of images as they were taken, where colours were corrected; else None),
        and `per_view` with `index`, `name`, `nearest` (a name) and both; None without training views.
    """
    per_view: list[dict[str, Any]] = []
    for index in (int(i) for i in indices):
        nearest = nearest_training(views, index)
        value = uncorrected = None
        if nearest is not None:
            truth, picture, tone = views.photo(index), as_float(views.images[nearest]), entry(views.tones, nearest)
            taken = None if tone is None else tone.applied(picture, views.intrinsics[nearest])
            value = psnr(views.as_taken(index, _resized(picture, truth)), truth, entry(views.valid, index))
            uncorrected = None if taken is None else psnr(_resized(taken, truth), truth, entry(views.valid, index))
        shown = None if nearest is None else views.names[nearest]
        per_view.append({"index": index, "name": views.names[index], "nearest": shown, "psnr": value, "psnr_uncorrected": uncorrected})
    return {"views": len(per_view), **{key: mean(view[key] for view in per_view) for key in SCORES}, "per_view": per_view}


def _resized(picture: Array, like: Array) -> Array:
    """`picture` in the size of `like`."""
    if picture.shape == like.shape:
        return picture
    return np.asarray(cv2.resize(picture, (like.shape[1], like.shape[0]), interpolation=cv2.INTER_AREA))
