"""Renders from coarse to fine, and frames of a film, beside whole renders."""

from __future__ import annotations

import numpy as np
import pytest

from fieldfuse.camera import Intrinsics
from fieldfuse.render.coarse_to_fine import SAME_SURFACE, SMOOTH, coarse_to_fine, render_coarse_to_fine
from fieldfuse.render.film import film
from fieldfuse.render.image import make_renderer, render_view
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


def test_depth_is_as_in_whole_renders_and_so_is_where_there_is_none() -> None:
    field, lens = coloured_field(), Intrinsics(61, 47, 40.0, 40.0, 30.5, 23.5)
    (pose,) = look_at(np.array([[3.0, 0.3, 0.2]]), np.zeros((1, 3)), UP)
    made, whole = render_coarse_to_fine(field, lens, pose, make_renderer(field)), render_view(field, lens, pose)
    assert made.depth.shape == whole.depth.shape and np.square(made.rgb - whole.rgb).mean() < 1e-5
    both = (made.depth > 0) & (whole.depth > 0)
    assert both.any() and not both.all() and ((made.depth > 0) == (whole.depth > 0)).mean() > 0.999
    assert np.abs(made.depth / np.where(both, whole.depth, 1) - 1)[both].max() < 2 * SAME_SURFACE
    assert np.abs(made.opacity - whole.opacity).mean() < 0.01


@pytest.mark.parametrize(("coarsest", "share"), [(2, 0.35), (4, 0.2), (8, 0.2)])
def test_fewer_pixels_are_asked_where_it_is_smooth(coarsest: int, share: float) -> None:
    counts = []

    def half(pixels: np.ndarray) -> np.ndarray:
        counts.append(len(pixels))
        return np.repeat((pixels[:, :1] > 20.0).astype(np.float32), 3, axis=1)  # an edge at column 20

    out = coarse_to_fine(Intrinsics(40, 30, 1.0, 1.0, 0.0, 0.0), half, np.full(3, SMOOTH), coarsest)
    assert np.array_equal(out[0, :, 0], np.arange(40) + 0.5 > 20.0) and (out == out[:1]).all()
    assert sum(counts) < share * 40 * 30


def test_between_is_the_mean_of_what_is_around() -> None:
    """A plane of values is itself, but for the border, beside which nothing is known."""
    lens = Intrinsics(16, 16, 1.0, 1.0, 0.0, 0.0)
    out = coarse_to_fine(lens, lambda pixels: pixels @ np.array([[1.0], [2.0]]), np.array([100.0]), 4)[..., 0]
    v, u = np.mgrid[:13, :13]
    assert np.allclose(out[:13, :13], u + 2 * v + 1.5, atol=4.1) and np.allclose(out[4:9, 4:9], (u + 2 * v + 1.5)[4:9, 4:9])
