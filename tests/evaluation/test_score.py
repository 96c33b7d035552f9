"""Scores of views and the floor of the nearest training picture."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from fieldfuse.errors import InputError
from fieldfuse.evaluation.metrics import PSNR_CAP, psnr, ssim
from fieldfuse.evaluation.score import nearest_image_scores, nearest_training, score_views
from tests.evaluation.samples import Drawn, draw, make_views

MEANS = {"psnr", "ssim", "lpips", "depth_abs_err", "psnr_corrected", "psnr_masked", "coverage"}
NAMES = {"views", "seconds_per_view", "depth", "per_view", *MEANS}


def test_means_are_of_the_views() -> None:
    views = make_views()
    indices = np.flatnonzero(views.test)
    found = score_views((draw(views, i) for i in indices), views, indices, seconds_per_view=[0.5, 1.5])
    assert set(found) == NAMES
    assert found["views"] == 2 and [view["name"] for view in found["per_view"]] == ["0000.jpg", "0003.jpg"]
    singles = [psnr(draw(views, i).rgb, views.images[i]) for i in indices]
    assert found["psnr"] == pytest.approx(np.mean(singles))  # type: ignore[arg-type]
    assert found["ssim"] == pytest.approx(np.mean([ssim(draw(views, i).rgb, views.images[i]) for i in indices]))  # type: ignore[arg-type]
    assert found["depth_abs_err"] == pytest.approx(0.1 * float(np.mean(views.depths[0])), rel=1e-5)
    assert found["depth"]["delta_1"] == 1 and found["depth"]["abs_rel"] == pytest.approx(0.1, rel=1e-5)
    assert found["seconds_per_view"] == 1
    assert found["psnr_masked"] is None and found["coverage"] is None
    json.dumps(found, allow_nan=False)


def test_surface_is_scored_where_it_is_and_over_all() -> None:
    views = make_views()
    found = score_views([draw(views, 0, masked=True)], views, [0], 0.1)
    assert found["coverage"] == 0.5
    assert found["psnr_masked"] > found["psnr"] + 5
    assert found["depth"]["coverage"] == 0.5
    assert found["seconds_per_view"] == 0.1


def test_valid_pixels_only() -> None:
    views = make_views()
    one = draw(views, 0, masked=True)
    one.rgb = np.where(one.mask[..., None], views.images[0] / 255, 0)  # type: ignore[index]
    views.valid = [one.mask] * len(views)
    found = score_views([one], views, [0])
    assert found["psnr"] == PSNR_CAP and found["coverage"] == 1
    views.valid = [np.zeros_like(one.mask)] * len(views)
    nothing = score_views([one], views, [0])
    assert nothing["psnr"] is None and nothing["coverage"] is None and nothing["depth_abs_err"] is None and nothing["lpips"] is None


def test_known_background_fills_what_a_surface_lacks() -> None:
    views = make_views(depth=False)
    views.images[0][:, : views.images[0].shape[1] // 2] = 255
    one = draw(views, 0, masked=True)
    black = score_views([one], views, [0])["psnr"]
    views.background = (1.0, 1.0, 1.0)
    white = score_views([one], views, [0])
    assert white["psnr"] > black + 10
    assert white["depth_abs_err"] is None and white["depth"] is None


def test_no_views() -> None:
    found = score_views([], make_views(), [])
    assert found["views"] == 0 and found["psnr"] is None and found["per_view"] == []


@pytest.mark.parametrize("given", [1, 3])
def test_as_many_pictures_as_indices(given: int) -> None:
    views = make_views()

    def pictures() -> Iterator[Any]:
        for _ in range(given):
            yield draw(views, 0)

    with pytest.raises(InputError, match="one for each"):
        score_views(pictures(), views, [0, 3])


def test_size_must_fit() -> None:
    views = make_views()
    with pytest.raises(InputError, match="size of the view"):
        score_views([Drawn(np.zeros((10, 10, 3)), np.zeros((10, 10)))], views, [0])


def test_nearest_by_place_and_direction() -> None:
    views = make_views(count=6)  # test views 0 and 3 on a line, one unit apart
    assert nearest_training(views, 0) == 1
    assert nearest_training(views, 3) in (2, 4)
    turned = views.world_from_camera[2].copy()
    turned[:3, :3] = np.diag([-1.0, 1.0, -1.0])  # view 2 looks back
    views.world_from_camera[2] = turned
    assert nearest_training(views, 3) == 4


def test_nearest_when_all_stand_on_one_spot() -> None:
    views = make_views(count=4)
    views.world_from_camera[:] = np.eye(4)
    for index, angle in enumerate((0.0, 0.9, 0.1, 0.5)):
        c, s = np.cos(angle), np.sin(angle)
        views.world_from_camera[index, :3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    assert nearest_training(views, 0) == 2


def test_nearest_scores() -> None:
    views = make_views()
    found = nearest_image_scores(views, np.flatnonzero(views.test))
    assert found["views"] == 2
    assert found["per_view"][0]["nearest"] == "0001.jpg"
    assert found["per_view"][0]["psnr"] == pytest.approx(psnr(views.images[1], views.images[0]))
    views.images[1] = views.images[0].repeat(2, axis=0).repeat(2, axis=1)  # another size, the same picture
    assert nearest_image_scores(views, [0])["psnr"] == PSNR_CAP


def test_no_training_view() -> None:
    views = make_views()
    views.test[:] = True
    assert nearest_training(views, 0) is None
    assert nearest_image_scores(views, [0])["psnr"] is None
