"""The score at training views, and which part of a held-out view training cameras see."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fieldfuse.camera import Array, Intrinsics, pixel_grid, rays
from fieldfuse.evaluation.score import every_nth, seen_share, training_psnr
from tests.evaluation.samples import make_views


@pytest.mark.parametrize("step", [1, 2, 3, 7])
def test_fewer_rays_are_the_same_rays(step: int) -> None:
    camera, pose = Intrinsics(23, 17, 20.0, 21.0, 11.3, 8.1), np.eye(4)
    few = every_nth(camera, step)
    all_of = rays(camera, pose, pixel_grid(23, 17))[1].reshape(17, 23, 3)[::step, ::step]
    assert (few.height, few.width) == all_of.shape[:2]
    assert np.allclose(rays(few, pose, pixel_grid(few.width, few.height))[1].reshape(all_of.shape), all_of, atol=1e-6)


def test_training_views_are_compared_where_they_are_valid() -> None:
    views = make_views(30, 150, 200)
    asked: list[float] = []

    def show(camera: Intrinsics, pose: Array) -> Array:
        index = int(pose[0, 3])
        asked.append(index)
        assert not views.test[index] and camera.width * camera.height <= 4096
        step = -(-views.images[index].shape[1] // camera.width)
        shown = views.images[index][::step, ::step].astype(float) / 255
        shown[: len(shown) // 2] = 0  # the upper half is wrong
        return shown

    low = training_psnr(show, views)
    assert low is not None and low < 20 and len(asked) == len(set(asked)) == 8
    lower = np.zeros((150, 200), bool)
    lower[80:] = True
    assert training_psnr(show, replace(views, valid=[lower] * 30)) == 100.0
    assert training_psnr(show, replace(views, test=np.ones(30, bool))) is None


def test_a_surface_is_seen_by_two_or_it_is_not() -> None:
    views = make_views(4, every=4)  # at x = 0 (held out), 1, 2, 3, all looking along z; half the width is 0.56 of the depth
    assert seen_share(np.full((40, 56), 100.0), views, 0) == pytest.approx(1, abs=0.05)  # far away all see the same
    assert seen_share(np.full((40, 56), 1.0), views, 0) == 0
    half = np.full((40, 56), 100.0)
    half[:20] = 1
    assert seen_share(half, views, 0) == pytest.approx(0.5, abs=0.05)
    half[:20] = 0  # nothing is rendered there
    assert seen_share(half, views, 0) == pytest.approx(1, abs=0.05)
    assert seen_share(np.zeros((40, 56)), views, 0) is None
    half[0, :] = np.inf
    turned = views.world_from_camera.copy()
    turned[1:, :3, :3] = np.diag([-1.0, 1.0, -1.0])  # training cameras look the other way
    assert seen_share(half, replace(views, world_from_camera=turned), 0) == 0
