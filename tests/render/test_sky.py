"""Colours behind everything, by direction: found from pictures, shown where a field has nothing, kept in files."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from fieldfuse.camera import Intrinsics, pixel_grid, rays
from fieldfuse.capture.types import Views
from fieldfuse.errors import InputError
from fieldfuse.evaluation.sphere import around, lens, sphere_field
from fieldfuse.nerfusion.encoding import SH
from fieldfuse.render.bake import bake
from fieldfuse.render.bake_file import read_baked, write_baked
from fieldfuse.render.field import Field
from fieldfuse.render.image import render_view
from fieldfuse.render.sky import on_sky, sky_colours
from fieldfuse.training.background_sh import sky_behind
from tests.render.made import random_field, random_rays

CAMERA = Intrinsics(40, 30, 30.0, 30.0, 20.0, 15.0)


def gentle_sky(seed: int = 0) -> torch.Tensor:
    """Colours around 0.5 that stay inside (0, 1) in every direction."""
    sky = 0.08 * torch.randn(9, 3, generator=torch.Generator().manual_seed(seed))
    sky[0] = 0.5 / SH[0]
    return sky


def turned(angle: float, tilt: float) -> np.ndarray:
    """A camera at the origin that looks along this azimuth and elevation."""
    forward = np.array([np.cos(angle) * np.cos(tilt), np.sin(angle) * np.cos(tilt), np.sin(tilt)])
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    return pose


def views_of(sky: torch.Tensor, poses: list[np.ndarray], test: int = 0) -> Views:
    images = []
    for pose in poses:
        _, directions, _ = rays(CAMERA, pose, pixel_grid(40, 30))
        images.append((sky_colours(sky, directions) * 255).round().byte().view(30, 40, 3).numpy())
    held_out = np.arange(len(poses)) >= len(poses) - test
    return Views([f"{i}" for i in range(len(poses))], images, [CAMERA] * len(poses), np.stack(poses), held_out)


def all_around() -> list[np.ndarray]:
    return [turned(angle, tilt) for tilt in (-1.2, -0.4, 0.4, 1.2) for angle in np.linspace(0, 2 * np.pi, 8, endpoint=False)]


def test_what_is_seen_all_around_is_found() -> None:
    sky = gentle_sky()
    found = sky_behind(views_of(sky, all_around()))
    assert found is not None
    _, directions = random_rays(500)
    assert float((sky_colours(found, directions) - sky_colours(sky, directions)).abs().max()) < 0.01


def test_held_out_pictures_and_masked_pixels_are_not_looked_at() -> None:
    views = views_of(gentle_sky(), all_around(), test=4)
    expected = sky_behind(views)
    assert expected is not None
    for index in range(28, 32):
        views.images[index][:] = 0
    assert torch.equal(sky_behind(views), expected)  # type: ignore[arg-type]
    half = np.ones((30, 40), bool)
    half[:, 20:] = False
    left = replace(views, valid=[half] * len(views))
    first = sky_behind(left)
    for picture in left.images:
        picture[:, 20:] = 255
    assert first is not None and torch.equal(sky_behind(left), first)  # type: ignore[arg-type]


@pytest.mark.parametrize("pictures", [1, 2, 5])
def test_where_nobody_looked_it_stays_a_colour_near_those_beside(pictures: int) -> None:
    """Pictures of a green wall do not make the other side of the world blue."""
    views = views_of(gentle_sky(), [turned(0.1 * index, 0.0) for index in range(pictures)])
    for picture in views.images:
        picture[:] = (40, 200, 60)
    found = sky_behind(views)
    assert found is not None
    _, directions = random_rays(500)
    colours = sky_colours(found, directions)
    assert float((colours - torch.tensor([40, 200, 60]) / 255).abs().max()) < 0.02


def mean_error(sky: torch.Tensor, views: Views, indices: range) -> float:
    """Mean squared error of the sky at these pictures."""
    errors = []
    for index in indices:
        _, directions, _ = rays(CAMERA, views.world_from_camera[index], pixel_grid(40, 30))
        colours = torch.from_numpy(views.images[index].reshape(-1, 3) / 255).float()
        errors.append(float((sky_colours(sky, directions) - colours).square().mean()))
    return float(np.mean(errors))


def test_pictures_that_tell_nothing_of_others_leave_the_mean_colour() -> None:
    """Each picture has a colour of its own, without any order: nine harmonics fit that, and predict nothing."""
    views = views_of(gentle_sky(), all_around()[:6])
    colours = [(250, 10, 10), (10, 250, 10), (10, 10, 250), (10, 250, 10), (250, 10, 10), (10, 10, 250)]
    for picture, colour in zip(views.images, colours, strict=True):
        picture[:] = colour
    found = sky_behind(views)
    assert found is not None
    mean = torch.tensor(np.mean(colours, axis=0) / 255).float()
    assert float((found[0] * SH[0] - mean).abs().max()) < 0.03 and float(found[4:].abs().max()) < 0.02


@pytest.mark.parametrize("pictures", [3, 5, 9])
def test_what_is_chosen_predicts_unseen_pictures_better_than_the_mean_colour(pictures: int) -> None:
    """Few noisy pictures of one side of a sky; the others are elsewhere."""
    noise = np.random.default_rng(0)
    everywhere = all_around()
    order = [*range(8, 8 + pictures), *(i for i in range(32) if not 8 <= i < 8 + pictures)]
    views = views_of(gentle_sky(3), [everywhere[i] for i in order], test=32 - pictures)
    for picture in views.images[:pictures]:
        picture[:] = (picture + noise.normal(0, 60, picture.shape)).clip(0, 255).astype(np.uint8)
    found = sky_behind(views)
    assert found is not None
    mean = torch.zeros(9, 3)
    mean[0] = torch.tensor(np.mean([picture.reshape(-1, 3).mean(0) for picture in views.images[:pictures]], 0) / 255).float() / SH[0]
    assert mean_error(found, views, range(pictures, 32)) < mean_error(mean, views, range(pictures, 32))


def test_alpha_has_a_background_of_its_own() -> None:
    assert sky_behind(replace(views_of(gentle_sky(), all_around()), background=(1.0, 1.0, 1.0))) is None


def test_on_sky_is_compositing_on_it() -> None:
    generator = torch.Generator().manual_seed(0)
    _, directions = random_rays(200)
    own, opacity = torch.rand(200, 3, generator=generator), torch.rand(200, generator=generator)
    opacity[:10], opacity[10:20] = 1.0, 0.0
    background, sky = torch.tensor([0.2, 0.7, 0.4]), gentle_sky(1)
    on_one = opacity[:, None] * own + (1 - opacity)[:, None] * background
    expected = opacity[:, None] * own + (1 - opacity)[:, None] * sky_colours(sky, directions)
    given = on_one.clone()
    out = on_sky(on_one, opacity, directions, background, sky)
    torch.testing.assert_close(out, expected, atol=2e-3, rtol=0)  # what is closed to a thousandth is left as it is
    assert torch.equal(out[:10], on_one[:10]) and torch.equal(on_one, given)
    assert on_sky(on_one, opacity, directions, background, None) is on_one


def test_pictures_of_a_field_and_of_what_is_baked_from_it_show_the_sky() -> None:
    field = replace(sphere_field(32), background=torch.tensor([0.9, 0.2, 0.4]))
    camera, pose = lens(40, 30), around()[1]
    plain, sky = render_view(field, camera, pose), gentle_sky(2)
    field = replace(field, sky=sky)
    shown = render_view(field, camera, pose)
    empty = shown.opacity == 0
    assert 0.1 < empty.mean() < 0.9
    _, directions, _ = rays(camera, pose, pixel_grid(40, 30))
    np.testing.assert_allclose(shown.rgb[empty], sky_colours(sky, directions).view(30, 40, 3).numpy()[empty], atol=1e-6)
    np.testing.assert_array_equal(shown.rgb[shown.opacity > 0.999], plain.rgb[plain.opacity > 0.999])
    baked = render_view(bake(field).to_field(), camera, pose)
    np.testing.assert_allclose(baked.rgb[empty], shown.rgb[empty], atol=1e-3)
    assert float(np.abs(baked.rgb - shown.rgb).mean()) < 2 / 255


def test_files_keep_it_and_older_ones_have_none(tmp_path: Path) -> None:
    field = random_field()
    field.save(tmp_path / "plain.safetensors")
    assert Field.load(tmp_path / "plain.safetensors").sky is None
    field = replace(field, sky=gentle_sky())
    field.save(tmp_path / "field.safetensors")
    torch.testing.assert_close(Field.load(tmp_path / "field.safetensors").sky, field.sky)
    baked = bake(replace(sphere_field(32), sky=gentle_sky()))
    write_baked(tmp_path / "baked.safetensors", baked)
    np.testing.assert_allclose(read_baked(tmp_path / "baked.safetensors").sky, baked.sky)  # type: ignore[arg-type]


@pytest.mark.parametrize("sky", [[[0.0] * 3] * 8, [[1e30] * 3] * 9, "blue", [[None] * 3] * 9, 3])
def test_a_sky_that_is_none_is_refused(tmp_path: Path, sky: object) -> None:
    field, path = replace(random_field(), sky=gentle_sky()), tmp_path / "field.safetensors"
    field.save(path)
    with safe_open(str(path), framework="pt") as file:
        tensors, about = {name: file.get_tensor(name) for name in file.keys()}, dict(file.metadata())  # noqa: SIM118
    key = next(name for name, text in about.items() if '"sky"' in text)
    header = json.loads(about[key])
    header.get("config", header)["sky"] = sky
    save_file(tensors, path, metadata={**about, key: json.dumps(header)})
    with pytest.raises(InputError, match="does not hold a field"):
        Field.load(path)
