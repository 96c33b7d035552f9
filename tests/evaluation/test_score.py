"""Scores of views, of several methods side by side, and what they are held against."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from fieldfuse.camera import Array, Intrinsics, pixel_grid, rays
from fieldfuse.capture.types import Views
from fieldfuse.errors import InputError
from fieldfuse.evaluation.metrics import PSNR_CAP, psnr, ssim
from fieldfuse.evaluation.score import (
    compare_views,
    every_nth,
    matched_depth_scores,
    nearest_image_scores,
    nearest_training,
    score_views,
    seen_share,
    training_psnr,
)
from fieldfuse.stereo.match import StereoDepth
from tests.evaluation.samples import Drawn, draw, make_views

CAMERA = Intrinsics(48, 36, 40.0, 40.0, 24.0, 18.0)


@pytest.fixture(autouse=True)
def no_weights(monkeypatch: pytest.MonkeyPatch) -> None:
    """LPIPS has tests of its own; here it would only take time."""
    monkeypatch.setattr("fieldfuse.evaluation.perceptual._layers", lambda: None)


def test_means_are_of_the_views() -> None:
    views = make_views()
    indices = np.flatnonzero(views.test)
    found = score_views((draw(views, i) for i in indices), views, indices, seconds_per_view=[0.5, 1.5])
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


def test_one_render_of_the_views_size_for_each_index() -> None:
    views = make_views()
    found = score_views([], views, [])
    assert found["views"] == 0 and found["psnr"] is None and found["per_view"] == []
    for count in (1, 3):
        with pytest.raises(InputError, match="one for each"):
            score_views((draw(views, 0) for _ in range(count)), views, [0, 3])
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


def made(count: int = 3) -> tuple[Views, list[Drawn], list[Drawn]]:
    """Views with depth; a field that is a little off everywhere; a surface that is exact on the left half and missing on the right."""
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 256, (36, 48, 3)).astype(np.uint8) for _ in range(count)]
    depths: list[Array | None] = [np.full((36, 48), 2.0, np.float32) for _ in range(count)]
    views = Views([str(i) for i in range(count)], images, [CAMERA] * count, np.tile(np.eye(4), (count, 1, 1)), np.ones(count, bool))
    views.depths = depths
    left = np.broadcast_to(np.arange(48) < 24, (36, 48))
    field = [Drawn(np.clip(image / 255 + 0.05, 0, 1), np.full((36, 48), 2.06, np.float32)) for image in images]
    surface = [Drawn(np.where(left[..., None], image, 0).astype(np.uint8), np.where(left, 2.0, 0), left) for image in images]
    return views, field, surface


def test_both_are_scored_on_the_same_pixels() -> None:
    views, field, surface = made()
    out = compare_views({"field": field, "tsdf": surface}, views, [0, 1, 2], {"field": [1, 2, 3], "tsdf": [0.1, 0.1, 0.1]})
    assert out["tsdf"]["on"]["tsdf"]["psnr"] == 100 and out["tsdf"]["psnr"] < 15
    assert out["tsdf"]["coverage"] == 0.5 and out["field"]["coverage"] is None
    assert out["field"]["seconds_per_view"] == 2
    left = surface[0].mask
    expected = [psnr(one.rgb, image, left) for one, image in zip(field, views.images, strict=True)]
    assert out["field"]["on"]["tsdf"]["psnr"] == pytest.approx(np.mean(np.array(expected, float)))
    expected = [ssim(one.rgb, image, left) for one, image in zip(field, views.images, strict=True)]
    assert out["field"]["on"]["tsdf"]["ssim"] == pytest.approx(np.mean(np.array(expected, float)))
    assert set(out["tsdf"]["on"]) == {"tsdf"}  # one surface on the pixels of another says nothing


def test_depth_is_told_in_shares_of_the_scale() -> None:
    views, field, surface = made()
    out = compare_views({"field": field, "tsdf": surface}, views, [0, 1, 2])
    assert out["field"]["depth_scale"] == 2
    assert out["field"]["abs_err"] == pytest.approx(0.03, rel=1e-5)
    assert (out["field"]["acc_1"], out["field"]["acc_5"]) == (0, 1)
    assert (out["tsdf"]["abs_err"], out["tsdf"]["acc_1"], out["tsdf"]["acc_5"]) == (0, 0.5, 0.5)
    assert out["tsdf"]["depth"]["coverage"] == 0.5


def test_true_depth_replaces_the_sensors() -> None:
    views, field, _ = made()
    exact: list[Array | None] = [np.full((36, 48), 4.12, np.float32), None]
    out = compare_views({"field": field[1:]}, views, [1, 2], depths=exact)
    assert out["field"]["abs_err"] == pytest.approx(0.5, rel=1e-4) and out["field"]["depth_scale"] == pytest.approx(4.12)
    assert views.depths[1] is not None and views.depths[1][0, 0] == 2  # the views themselves stay
    views.depths = []
    assert compare_views({"field": field}, views, [0, 1, 2])["field"]["abs_err"] is None


def test_matched_depth_is_measured_on_textured_pixels_too() -> None:
    rng = np.random.default_rng(0)
    image = np.full((36, 48, 3), 120, np.uint8)
    image[:, :24] = rng.integers(0, 256, (36, 24, 3))  # texture on the left half
    views = Views(["a", "b"], [image, image], [CAMERA] * 2, np.tile(np.eye(4), (2, 1, 1)), np.zeros(2, bool))
    truth = np.full((36, 48), 2.0, np.float32)
    depth = np.where(np.arange(48) < 18, np.float32(2.02), np.float32(0)) * np.ones((36, 1), np.float32)
    depth[:, 40:] = 3.0
    found = StereoDepth(depth, (depth > 0).astype(np.float32), CAMERA)
    scores = matched_depth_scores(views, [found, found], [truth, None])
    assert scores is not None and scores["views"] == 1
    assert scores["coverage"] == pytest.approx(26 / 48) and scores["median_rel"] == pytest.approx(0.01, rel=1e-4)
    assert scores["coverage_textured"] == pytest.approx(18 / 27, abs=0.03)  # windows reach three pixels over the edge
    assert scores["textured"] == pytest.approx(27 / 48, abs=0.03)
    large = np.full((72, 96), 2.0, np.float32)
    again = matched_depth_scores(views, [found, found], [large, large])
    assert again is not None and again["views"] == 2 and again["coverage"] == scores["coverage"]
    assert matched_depth_scores(views, [found, found], [None, np.zeros_like(truth)]) is None
