"""How much a decoder makes of the direction: what is taken away stays away in both engines, and the effects decide by name."""

from __future__ import annotations

from itertools import count
from typing import Any

import pytest
import torch

from fieldfuse.config import FieldSettings
from fieldfuse.effects.decide import choose_field
from fieldfuse.nerfusion.decoder import Deferred, PerSample
from fieldfuse.training.fit import fit_field
from fieldfuse.training.start import HARMONICS, direction_weights, new_decoder, unseen_harmonics
from tests.training.test_fit import scene, sphere_views, wanted


def test_limits_take_the_harmonics_of_the_order() -> None:
    for kind in ("deferred", "per_sample"):
        for view, seen in (("none", 0), ("low", 4), ("full", 16)):
            decoder = new_decoder(FieldSettings(decoder=kind, channels=8, hidden=16, view=view))
            assert unseen_harmonics(decoder).tolist() == [False] * seen + [True] * (16 - seen)
            assert HARMONICS[view] == seen


def colours(decoder: Deferred | PerSample, directions: torch.Tensor) -> torch.Tensor:
    features = torch.linspace(-1, 1, decoder.channels).expand(len(directions), -1)
    got = decoder(features, directions)
    return got[1].detach() if isinstance(got, tuple) else got.detach()


@pytest.mark.parametrize("engine", ["numba", "torch"])
@pytest.mark.parametrize("kind", ["deferred", "per_sample"])
def test_a_fit_does_not_learn_what_it_may_not_see(engine: str, kind: str) -> None:
    views, around = sphere_views(8), torch.nn.functional.normalize(torch.randn(40, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    looks = count()  # a clock that stands still but for being looked at: as many steps on any machine
    for view in ("none", "low", "full"):
        settings = wanted("budget=1", f"engine={engine}", f"field.decoder={kind}", f"field.view={view}", "field.resolution=32")
        fitted = fit_field(views, scene(), settings, ticks=lambda: 0.05 * next(looks))
        decoder = fitted.field.decoder
        assert fitted.steps > 5
        assert int(unseen_harmonics(decoder).sum()) == 16 - HARMONICS[view]
        spread = colours(decoder, around).std(0).max()
        assert (spread < 1e-6) == (view == "none"), spread
        there, opposite = colours(decoder, around), colours(decoder, -around)
        mixed = direction_weights(decoder)[:, 4:].abs().max()
        assert (mixed > 0) == (view == "full") and (view == "none" or not torch.allclose(there, opposite, atol=1e-6))


def entry(effect: str, on: bool, wish: str = "auto") -> dict[str, Any]:
    return {"effect": effect, "on": on, "wish": wish}


def test_effects_choose_what_is_left_to_them_alone() -> None:
    found, missed = FieldSettings(), FieldSettings()
    choose_field(found, [entry("view_dependence", True), entry("background", True)])
    assert (found.view, found.background) == ("full", "on")
    choose_field(missed, [entry("view_dependence", False), entry("background", False)])
    assert missed.view in ("low", "full") and missed.background == "auto"
    off = FieldSettings()
    named = [entry("view_dependence", False, "off"), entry("background", False, "off")]
    choose_field(off, named, ["view_dependence", "background"])
    assert (off.view, off.background) == ("none", "off")
    unasked = FieldSettings()  # effects=off with some that are on: as if nothing had been looked for
    choose_field(unasked, named)
    assert (unasked.view, unasked.background) == ("full", "auto")
    own = FieldSettings(view="low", background="off")
    choose_field(own, [entry("view_dependence", True), entry("background", True)])
    assert (own.view, own.background) == ("low", "off")
