"""Frames of a film beside whole renders."""

from __future__ import annotations

import numpy as np
import pytest

from fieldfuse.camera import Intrinsics
from fieldfuse.render.film import SMOOTH, film, refined
from fieldfuse.render.image import render_view
from fieldfuse.render.paths import look_at

from .made import coloured_field, random_field

UP = np.array([0.0, 0.0, 1.0])


@pytest.mark.parametrize("size", [(96, 64), (61, 47)])
def test_frames_are_as_whole_renders(size: tuple[int, int]) -> None:
    field, lens = coloured_field(), Intrinsics(*size, 1.2 * size[0], 1.2 * size[0], 0.5 * size[0], 0.5 * size[1])
    places = np.array([[3.0, 0.3, 0.2], [-1.0, -3.0, 0.5], [0.5, 2.9, -0.6]])
    poses = look_at(places, np.zeros_like(places), UP)
    frames = list(film(field, [lens] * len(poses), poses))
    assert len(frames) == len(poses)
    for frame, pose in zip(frames, poses, strict=True):
        whole = render_view(field, lens, pose).rgb
        assert frame.shape == whole.shape and np.abs(frame - whole).max() <= 4 * SMOOTH
        assert np.square(frame - whole).mean() < 1e-5  # 50 dB


def test_what_is_not_smooth_is_rendered_whole() -> None:
    """Voxels of random colours: nearly every pixel differs from its neighbours."""
    field, lens = random_field(), Intrinsics(48, 40, 30.0, 30.0, 24.0, 20.0)
    (pose,) = look_at(np.array([[2.2, 0.4, 0.3]]), np.zeros((1, 3)), UP)
    (frame,) = film(field, [lens], pose[None])
    whole = render_view(field, lens, pose).rgb
    assert (np.abs(frame - whole).max(axis=2) < 1e-5).mean() > 0.7 and np.square(frame - whole).mean() < 1e-4


def test_fewer_pixels_are_asked_where_it_is_smooth() -> None:
    counts = []

    def half(pixels: np.ndarray) -> np.ndarray:
        counts.append(len(pixels))
        return np.repeat((pixels[:, :1] > 20.0).astype(np.float32), 3, axis=1)  # an edge at column 20

    out = refined(Intrinsics(40, 30, 1.0, 1.0, 0.0, 0.0), half)
    assert np.array_equal(out[0, :, 0], np.arange(40) + 0.5 > 20.0) and (out == out[:1]).all()
    assert sum(counts) < 0.35 * 40 * 30
