"""What a fit has to say of itself reaches the report, and stays there when the stage is reused."""

from __future__ import annotations

import math
from itertools import count
from pathlib import Path

import pytest

from fieldfuse.config import load_settings
from fieldfuse.files import read_json
from fieldfuse.pipelines.steps_results import going_on
from tests.pipelines.made import CAMERA, call, make_room
from tests.training.test_fit import ticking
from tests.training.test_not_finite import spoiling

OPTIONS = (
    "--budget",
    "1",
    "--threads",
    "1",
    "--holdout",
    "4",
    "--set",
    "field.resolution=16",
    "--engine",
    "torch",
    "--quiet",
    "--set",
    "tsdf.enabled=off",
    "--set",
    "field.init=classical",
    "--set",
    "export.formats=[cameras]",
    "--set",
    "export.mesh_views=3",
)


def test_a_step_that_was_not_finite_is_told_in_the_report(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    source, out = tmp_path / "room", tmp_path / "out"
    make_room(source, 8, True, CAMERA.scaled(48, 36))
    ticking(monkeypatch, 0.02)
    with monkeypatch.context() as patch:
        spoiling(patch, "torch", math.nan, (number == 3 for number in count()))
        assert call(capsys, "run", source, "--out", out, *OPTIONS).code == 0
    for _ in range(2):
        notes = [text for text in read_json(out / "report.json")["warnings"] if "not finite" in text]
        assert len(notes) == 1 and "step 4 of the fit" in notes[0] and "0.5 of the step sizes" in notes[0]
        assert call(capsys, "run", source, "--out", out, *OPTIONS).code == 0
    assert call(capsys, "run", source, "--out", out, *OPTIONS, "--set", "seed=5").code == 0
    assert not [text for text in read_json(out / "report.json")["warnings"] if "not finite" in text]
    assert not (out / "fit_notes.json").exists()


def test_a_fit_that_goes_on_matches_nothing_again_and_begins_gently_when_it_is_short() -> None:
    for budget, share in ((3.0, 0.3), (15.0, 0.5), (30.0, 1.0), (None, 1.0)):
        fit = load_settings("balanced").fit
        fit.budget = budget
        got = going_on(fit)
        assert got.rate_density == pytest.approx(share * fit.rate_density) and got.rate_feature == pytest.approx(share * fit.rate_feature)
        assert (got.depth_from, got.moving, got.budget, got.depth) == ("sensor", "off", budget, fit.depth)
    fit.depth_from = "any"
    assert going_on(fit).depth_from == "any"
    fit.depth_from = "off"
    assert going_on(fit).depth_from == "off"
