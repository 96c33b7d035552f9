"""Features lie where the picture has them, in COLMAP's convention, and are the same every time."""

from __future__ import annotations

import numpy as np
import pytest

from fieldfuse.camera import Array
from fieldfuse.poses.database import sift


def blobs() -> tuple[Array, Array]:
    """A grey picture of bright and dark blobs, and (N, 3) where their centres lie (pixel centres at +0.5) and how wide they are."""
    rng = np.random.default_rng(0)
    column, row = np.meshgrid(np.arange(400) + 0.5, np.arange(240) + 0.5)
    places = np.array(
        [(30 + 60 * i + rng.uniform(-5, 5), 30 + 60 * j + rng.uniform(-5, 5), rng.uniform(1.5, 6)) for i in range(6) for j in range(4)]
    )
    picture = np.full(column.shape, 128.0)
    for number, (x, y, wide) in enumerate(places):
        picture += (90 if number % 2 else -90) * np.exp(-((column - x) ** 2 + (row - y) ** 2) / (2 * wide**2))
    return np.clip(picture + rng.normal(0, 1, picture.shape), 0, 255).astype(np.uint8), places


def test_features_lie_where_the_picture_has_them() -> None:
    picture, places = blobs()
    keypoints, descriptors = sift(picture, 2000)
    assert keypoints.dtype == np.float32 and descriptors.dtype == np.uint8 and descriptors.shape == (len(keypoints), 128)
    away = keypoints[:, None, :2] - places[None, :, :2]
    nearest = np.linalg.norm(away, axis=2).argmin(axis=0)
    off = away[nearest, np.arange(len(places))]
    found = np.linalg.norm(off, axis=1) < 1
    assert found.mean() > 0.85
    assert np.abs(off[found].mean(axis=0)).max() < 0.03, "a shift of a quarter of a pixel would be COLMAP's points moved"
    assert np.abs(off[found]).max() < 0.2
    assert np.allclose(keypoints[nearest[found], 2] / places[found, 2], 0.9, atol=0.2), "the scale is that of the blob, not its diameter"


def test_descriptors_are_roots_of_shares() -> None:
    _, descriptors = sift(blobs()[0], 2000)
    length = np.linalg.norm(descriptors.astype(np.float64), axis=1)
    full = (descriptors < 255).all(axis=1)
    assert full.any() and np.abs(length[full] - 512).max() < 4


def test_the_largest_are_kept_and_always_the_same() -> None:
    picture, _ = blobs()
    every, few = sift(picture, 2000), sift(picture, 20)
    assert all(np.array_equal(a, b) for a, b in zip(every, sift(picture, 2000), strict=True))
    assert len(few[0]) == len(few[1]) == 20 < len(every[0])
    assert np.array_equal(few[0][:, 2], np.sort(every[0][:, 2])[::-1][:20])
    assert all(np.array_equal(a, b[:20]) for a, b in zip(few, every, strict=True))


@pytest.mark.parametrize("size", [(60, 80), (1, 1), (3, 400)])
def test_a_blank_picture_has_none(size: tuple[int, int]) -> None:
    keypoints, descriptors = sift(np.full(size, 90, np.uint8), 100)
    assert keypoints.shape == (0, 4) and descriptors.shape == (0, 128)
