"""Lists of effects: what is listed is there, with a strength or parameters; what is wrong is told in one sentence."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fieldfuse.effects.effect_specs import PRESETS, STRENGTHS, Effects, generator, parse, preset
from fieldfuse.effects.models import MotionBlur
from fieldfuse.errors import InputError


def test_all_ways_to_list() -> None:
    assert parse(None, "x") == parse([], "x") == Effects()
    got = parse(["exposure", "vignetting:strong", {"motion_blur": {"exposure": 0.02}}], "x")
    assert got.exposure == preset("exposure", "medium")
    assert got.vignetting == preset("vignetting", "strong")
    assert got.motion_blur == MotionBlur(0.02, preset("motion_blur", "medium").samples)
    assert set(got.names()) == {"exposure", "vignetting", "motion_blur"}
    mapping = parse({"exposure": "weak", "vignetting": False, "compression": {"strength": "strong", "quality": 30}}, "x")
    assert set(mapping.names()) == {"exposure", "compression"}
    assert mapping.compression is not None and mapping.compression.quality == 30


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_every_effect_has_three_strengths_and_describes_itself(name: str) -> None:
    made = [getattr(parse([f"{name}:{strength}"], "x"), name) for strength in STRENGTHS]
    assert len(set(made)) == 3
    assert parse([f"{name}:weak"], "x").describe()[name]
    assert made[0].__doc__ and len(made[0].__doc__.splitlines()) >= 3  # the formula


@pytest.mark.parametrize(
    ("listing", "sentence"),
    [
        (["vignetteing"], "did you mean 'vignetting'"),
        (["exposure:strongest"], "did you mean 'strong'"),
        (["exposure", "exposure:weak"], "listed twice"),
        ("exposure", "must be a list"),
        ([{"exposure": {"stop": 1}}], "did you mean 'stops'"),
        ([{"exposure": {"stops": "much"}}], "must be a valid number"),
        ([{"exposure": {"stops": float("nan")}}], "stops"),
        ([{"exposure": 3}], "takes a strength or parameters"),
        ([{"motion_blur": {"samples": 2.5}}], "must be a valid integer"),
        ([{"motion_blur": {"samples": 0}}], "at least 1"),
        ([{"vignetting": {"corner": 0}}], "at least 0.01"),
        ([{"background": {"haze": [1, 2]}}], "haze"),
    ],
)
def test_mistakes_are_told(listing: Any, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence) as told:
        parse(listing, "scene.yaml")
    assert str(told.value).startswith("scene.yaml")


def test_random_numbers_of_effects_and_frames_are_apart() -> None:
    draws = {generator(seed, name, frame).random() for seed in (0, 1) for name in ("exposure", "sensor_noise") for frame in (None, 0, 1, 7)}
    assert len(draws) == 16
    assert generator(3, "exposure", 2).random() == generator(3, "exposure", 2).random()
    assert np.isfinite(list(draws)).all()
