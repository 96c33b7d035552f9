"""What the report says of a run besides its numbers: that it failed, or what a fit has to say of itself."""

from __future__ import annotations

import math
from itertools import count
from pathlib import Path

import cv2
import pytest

from fieldfuse.config import load_settings
from fieldfuse.files import read_json
from fieldfuse.pipelines.fields import going_on
from tests.pipelines.made import CAMERA, call, make_room, write_transforms
from tests.pipelines.short import FAST, report
from tests.training.test_fit import ticking
from tests.training.test_not_finite import spoiling

OPTIONS = ["--budget", "1", "--threads", "1", "--holdout", "4", "--engine", "torch", "--init", "classical", "--set", "field.resolution=16"]
OPTIONS += ["--set", "tsdf.enabled=off", "--set", "export.formats=[cameras]", "--set", "export.mesh_views=3", "--quiet"]


def test_scores_of_images_that_are_there_twice_are_not_believed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = make_room(tmp_path / "room", 9)
    frames = []
    for frame in data["frames"]:  # the camera stood still for two images, which differ by less than noise
        again = frame["file_path"].replace(".png", "b.png")
        stored = cv2.imread(str(tmp_path / "room" / frame["file_path"]))
        cv2.imwrite(str(tmp_path / "room" / again), cv2.add(stored, (1.0, 1.0, 1.0, 0.0)))
        frames += [frame, {**frame, "file_path": again}]
    write_transforms(tmp_path / "room", {**data, "frames": frames})
    answer = call(capsys, "run", tmp_path / "room", "--out", tmp_path / "out", *FAST)
    assert answer.code == 0, answer.err
    first = report(tmp_path / "out")["warnings"][0]
    assert "held-out images equal a training image (" in first and "000b" in first
    assert f"note: {first}" in answer.out
    assert "held-out images equal a training image" in (tmp_path / "out" / "report.html").read_text()


def test_a_good_run_is_measured_and_says_nothing(done: Path) -> None:
    field = report(done)["evaluation"]["field"]
    assert field["training_psnr"] > field["psnr"] - 3 and all(0.5 < view["seen"] <= 1 for view in field["per_view"])
    assert not [text for text in report(done)["warnings"] if "failed" in text or "is poor" in text or "held-out" in text]
    assert read_json(done / "evaluation.json")["field"]["training_psnr"] == field["training_psnr"]


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
