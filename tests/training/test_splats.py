"""Gaussian splats of a field: what they begin with, and what steps make of them."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from fieldfuse.camera import Array, Similarity
from fieldfuse.capture.types import Views
from fieldfuse.errors import InputError
from fieldfuse.evaluation.metrics import psnr
from fieldfuse.evaluation.sphere import around, lens
from fieldfuse.nerfusion.decoder import make_decoder
from fieldfuse.render.field import Field
from fieldfuse.render.image import make_renderer, render_view
from fieldfuse.render.splats import Splats
from fieldfuse.tone import Tone, exposed
from fieldfuse.training import splats as T
from tests.render.made import coloured_field

TURN = np.array([[0.0, -1.0, 0.0], [0.8, 0.0, -0.6], [0.6, 0.0, 0.8]])
FAR = Similarity(0.04, TURN, np.array([300.0, -2000.0, 50.0]))  # metres of an input far from its origin


def seen(field: Field, count: int = 12, away: float = 2.4) -> Views:
    """What cameras around it see of a field, every sixth held out."""
    poses, camera, view = around(count, away), lens(80, 64), make_renderer(field)
    images = [np.round(255 * render_view(field, camera, pose, view).rgb).astype(np.uint8) for pose in poses]
    return Views([f"{k}" for k in range(count)], images, [camera] * count, poses, np.arange(count) % 6 == 3)


def ticking(steps: int) -> Callable[[], float]:
    """A clock that lets so many steps fit into a second."""
    looks = itertools.count()
    return lambda: next(looks) / steps


def held_out(splats: Splats, views: Views, working_from_input: Similarity) -> float:
    """Mean PSNR at the held-out views."""
    back, found = working_from_input.inverse(), []
    for index in np.flatnonzero(views.test):
        behind = None if views.background is None else np.array(views.background)
        shown = splats.render(views.intrinsics[index], back.poses(views.world_from_camera[index]), behind).rgb
        found.append(psnr(shown, views.images[index]))
    return float(np.mean([value for value in found if value is not None]))


def made(field: Field, views: Views, working_from_input: Similarity, steps: int, degree: int = 1) -> Splats:
    settings = T.SplatSettings(degree=degree, seconds=1.0)
    targets = T.Targets(views.subset(np.flatnonzero(~views.test)), working_from_input)
    return T.polished(T.start(field, targets, settings), targets, settings, ticks=ticking(steps))


@pytest.fixture(scope="module")
def cut_out() -> tuple[Field, Views]:
    field = coloured_field()
    return field, replace(seen(field), background=tuple(field.background.tolist()))


def test_gaussians_begin_as_the_field_and_steps_improve_them(cut_out: tuple[Field, Views]) -> None:
    field, views = cut_out
    before, after = (held_out(made(field, views, Similarity.identity(), steps), views, Similarity.identity()) for steps in (1, 60))
    assert before > 22 and after > before + 2


def test_the_frame_of_the_input_changes_nothing(cut_out: tuple[Field, Views]) -> None:
    """Places, scales, rotations and harmonics are the input's, however far from its origin."""
    field, views = cut_out
    here, there = (made(field, views, frame, 8) for frame in (Similarity.identity(), FAR))
    assert held_out(there, views, FAR) == pytest.approx(held_out(here, views, Similarity.identity()), abs=0.1)
    np.testing.assert_allclose(FAR.points(there.centres).mean(0), here.centres.mean(0), atol=0.02)


def test_colours_are_as_bright_as_the_images_were_taken(cut_out: tuple[Field, Views]) -> None:
    field, views = cut_out
    bright = replace(views, tones=[Tone((1.6, 1.6, 1.6))] * len(views))
    assert bright.exposure == pytest.approx(1.6)
    splats = made(field, bright, Similarity.identity(), 40)
    taken = replace(views, images=[exposed(image, 1.6) for image in views.images])
    background = exposed(np.round(255 * np.array(views.background)).astype(np.uint8), 1.6) / 255
    taken = replace(taken, background=tuple(background.tolist()))
    assert held_out(splats, taken, Similarity.identity()) > held_out(splats, views, Similarity.identity()) + 5


def test_the_same_seed_gives_the_same_splats(cut_out: tuple[Field, Views], monkeypatch: pytest.MonkeyPatch) -> None:
    field, views = cut_out
    first = made(field, views, Similarity.identity(), 3)
    np.testing.assert_array_equal(made(field, views, Similarity.identity(), 3).values, first.values)


def test_what_shines_through_is_put_behind() -> None:
    """Without alpha the background is a shell of Gaussians, so that other programs show it, too."""
    field = coloured_field()
    views = seen(field)
    splats = made(field, views, Similarity.identity(), 1)
    far = np.linalg.norm(splats.centres, axis=1) > 10
    assert far.any()
    shown = splats.render(views.intrinsics[3], views.world_from_camera[3])
    np.testing.assert_allclose(shown.rgb[2, 2], field.background.numpy(), atol=0.05)
    assert shown.opacity[2, 2] > 0.9


def test_places_beyond_the_region_lie_where_the_field_has_them() -> None:
    field = coloured_field(shell=1.0)  # its voxels are twice as large, and most of the sphere's are contracted
    views = replace(seen(field, away=6.0), background=tuple(field.background.tolist()))
    splats = T.start(field, _targets(views), T.SplatSettings())
    assert np.abs(splats.centres).max() > 1.6 and np.isfinite(splats.values).all()
    assert held_out(splats, replace(views, test=~views.test), Similarity.identity()) > 18


def _targets(views: Views) -> T.Targets:
    return T.Targets(views.subset(np.flatnonzero(~views.test)), Similarity.identity())


def test_jacobian_of_the_expansion() -> None:
    """Against differences of `Space.expand`."""
    import torch

    field = coloured_field(shell=1.0)
    places = torch.tensor([[0.3, -0.2, 0.9], [1.4, 0.2, -0.7], [-0.3, -1.8, 1.2], [0.1, 0.5, 1.9]], dtype=torch.float64)
    found = T._expansion(field, places)
    for axis in range(3):
        step = torch.zeros(3, dtype=torch.float64)
        step[axis] = 1e-6
        wanted = (field.space.expand(places + step) - field.space.expand(places - step)) / 2e-6
        torch.testing.assert_close(found[:, :, axis], wanted, atol=1e-4, rtol=1e-5)


def test_refusals(cut_out: tuple[Field, Views]) -> None:
    field, views = cut_out
    other = replace(field, decoder=make_decoder("per_sample", 16, 16))
    for given, shown, said in ((other, views, "deferred"), (field, replace(views, test=np.ones(len(views), bool)), "training views")):
        with pytest.raises(InputError, match=said):
            T.splats_of_field(given, shown, Similarity.identity(), T.SplatSettings())


def test_voxels_are_those_that_hold_most_light(cut_out: tuple[Field, Views]) -> None:
    field, views = cut_out
    splats = T.start(field, _targets(views), T.SplatSettings(most=500, degree=2))
    assert len(splats) <= 500 and splats.degree == 2
    few: Array = splats.values[:, 11 + 12 :]
    assert not few.any()  # what steps are to find out
