"""Fewer training pictures than a capture has: what a reconstruction from a handful of pictures would be."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from fieldfuse.camera import Array
from fieldfuse.capture.listing import natural_key
from fieldfuse.capture.prepare import held_out
from fieldfuse.capture.types import Capture


def limited(capture: Capture, holdout: int, limit: int | None) -> Capture:
    """`limit` evenly spread training pictures by name (all when there are no more), and every held-out one.

    Held-out pictures are the same whatever the limit is. The other training pictures are gone from the answer.
    """
    test = held_out(capture, holdout)
    train = sorted(np.flatnonzero(~test).tolist(), key=lambda index: natural_key(capture.frames[index].name))
    if limit is None or limit >= len(train):
        return capture
    kept = {train[place] for place in evenly(len(train), limit)}
    frames = [
        replace(frame, split="test" if test[index] else "train")  # said outright: with fewer frames every n-th is another
        for index, frame in enumerate(capture.frames)
        if test[index] or index in kept
    ]
    return capture.with_frames(frames)


def evenly(count: int, some: int) -> list[int]:
    """`some` of `count` places, the first and the last among them; the middle one when it is a single one."""
    if some == 1:
        return [count // 2]
    return [int(place) for place in np.unique(np.linspace(0, count - 1, min(some, count)).round().astype(int))]


def sharpness(image: Array) -> float:
    """How sharp a picture (H, W, 3) uint8 is, to be compared with others of nearly the same view: the Laplacian's variance."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    # A light blur first: otherwise sensor noise and blocks of a codec count as detail.
    return float(cv2.Laplacian(cv2.GaussianBlur(grey, (0, 0), 0.8), cv2.CV_32F).var())
