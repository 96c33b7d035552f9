"""Colours that are averages of pictures: looked up again in them, and behind everything; where pictures are black, white or contradict."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from fieldfuse.camera import Array
from fieldfuse.capture.types import Views
from fieldfuse.evaluation.sphere import around, lens, sphere_field
from fieldfuse.render.color_backprojection import COLOURS, MOST, recoloured
from fieldfuse.render.composite import RAW_MAX
from fieldfuse.render.sky import sky_colours
from fieldfuse.training.background_sh import sky_behind
from tests.stability.hard.errors import absolute, not_finite
from tests.stability.hard.within import Within

GROUP = "colours of pictures"
SIDE, DISTANCE = 24, 2.4  # pixels of a picture, and how far its camera is from the middle


def pictures(colours: list[int], poses: Array | None = None, side: int = SIDE) -> Views:
    """Pictures of one grey value each, from around the middle."""
    poses = around(len(colours)) if poses is None else poses
    images = [np.full((side, side, 3), colour, np.uint8) for colour in colours]
    return Views([f"{i}" for i in range(len(colours))], images, [lens(side, side)] * len(colours), poses, np.zeros(len(colours), bool))


def test_looked_up_again(within: Within) -> None:
    """Looked up again in black, white and contradicting pictures; at the clamp, saturated and empty.

    A weighted mean of what rays ask for moves no logit further than a ray may, however steep the way to a colour is.
    """
    sphere = sphere_field(24)
    fields = {
        "as it is": sphere,
        "densities at the clamp": replace(sphere, density_rows=torch.full_like(sphere.density_rows, 2 * RAW_MAX)),
        "all but empty": replace(sphere, density_rows=torch.full_like(sphere.density_rows, -30.0)),
        "features of 1e4": replace(sphere, feature_rows=1e4 * sphere.feature_rows),
        "no voxels": replace(sphere, occupied=torch.zeros_like(sphere.occupied)),
    }
    for name, field in fields.items():
        for shown, views in (("black", pictures([0] * 6)), ("white", pictures([255] * 6)), ("both", pictures([0, 255] * 3))):
            features = recoloured(field, views, DISTANCE).field.feature_rows
            moved = (features.double() - field.feature_rows.double())[:, :COLOURS].abs()
            rounding = 1e-6 * field.feature_rows.abs().max()
            within(f"{name}, {shown}: values that are not finite", not_finite(features), 0.0)
            within(f"{name}, {shown}: logits moved too far", float((moved - MOST - rounding).clamp_min(0).max()), 1e-5)
            others = absolute(features[:, COLOURS:], field.feature_rows[:, COLOURS:])
            within(f"{name}, {shown}: other features changed", others, 0.0)
    for name in ("all but empty", "no voxels"):
        features = recoloured(fields[name], pictures([255] * 6), DISTANCE).field.feature_rows
        within(f"{name}: changed", absolute(features, fields[name].feature_rows), 0.0)


def test_behind_everything(within: Within) -> None:
    """Behind everything: one colour, one direction, a single pixel, pictures that contradict.

    Nine harmonics of directions that do not tell them apart: only the ridge holds them.
    """
    everywhere = torch.nn.functional.normalize(torch.randn(2000, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    same = np.repeat(around(1), 6, axis=0)
    for grey in (0, 1, 128, 255):
        for name, views in (
            ("all around", pictures([grey] * 6)),
            ("one direction", pictures([grey] * 6, same)),
            ("one pixel", pictures([grey] * 3, same[:3], 1)),
            ("one picture", pictures([grey])),
        ):
            sky = sky_behind(views)
            assert sky is not None
            within(f"{grey}, {name}", absolute(sky_colours(sky, everywhere), torch.full((2000, 3), grey / 255)), 1e-5)
    for name, views in (
        ("black and white from one place", pictures([0, 255] * 3, same)),
        ("black and white around", pictures([0, 255] * 4)),
        ("one white among black", pictures([0] * 7 + [255])),
        ("one pixel each, black and white", pictures([0, 255, 255], same[:3], 1)),
    ):
        sky = sky_behind(views)
        assert sky is not None
        colours = sky_colours(sky, everywhere)
        mean = float(np.mean([picture.mean() for picture in views.images]) / 255)
        within(f"{name}: values that are not finite", not_finite(sky, colours), 0.0)
        # Pictures that contradict each other say nothing of directions, so it is their mean colour.
        within(f"{name}: away from the mean colour", float((colours - mean).abs().max()), 0.02)
