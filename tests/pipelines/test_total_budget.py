"""`fieldfuse run --total-budget`: settings are chosen, predicted and real seconds are told, and a second call reuses all of it."""

from __future__ import annotations

import json
import os
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import psutil
import pytest

from fieldfuse.config import DEFAULT_EXPORTS, load_settings
from fieldfuse.evaluation import budget as model
from fieldfuse.files import read_json, write_json
from fieldfuse.pipelines.total_budget import LONGEST_START, TotalBudget
from tests.pipelines.made import call, make_room

Capsys = pytest.CaptureFixture[str]


@pytest.fixture(autouse=True)
def _steps_for_seconds() -> None:
    """Seconds are what this is about: fits keep the machine's clock."""


def test_a_run_that_takes_what_was_asked_for(tmp_path: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(model, "EFFECTS_SHARE", 0.0)  # no time for them
    make_room(tmp_path / "room", 10)
    out = tmp_path / "out"
    command = ["run", tmp_path / "room", "--out", out, "--total-budget", "10", "--holdout", "5", "--threads", "1", "--quiet", "--json"]
    age, start = time.time() - psutil.Process().create_time(), time.monotonic()
    answer = call(capsys, *command, "--set", "export.formats=[ply,video,cameras]")
    whole = time.monotonic() - start + (age if age < LONGEST_START else 0.0)
    assert answer.code == 0, answer.err
    data = json.loads(answer.out)
    told = data["budget"]
    assert told["asked_seconds"] == 10 and told["predicted_seconds"] > 0 and not told["reused"]
    assert told["real_seconds"] + told["self_test_seconds"] >= data["seconds_total"] - 1
    choice, stages = told["choice"], told["stages"]
    assert choice["image_size"] == 160 and data["views"]["width"] == 96  # never enlarged
    busy = max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))
    assert stages["fit"]["real"] == pytest.approx(choice["fit_seconds"], abs=4 * busy) and choice["resolution"] >= 64
    assert {"capture", "scene", "views", "render", "export", "evaluate", "report"} <= set(stages)
    assert data["settings"]["fit"]["budget"] == choice["fit_seconds"]
    assert (out / "exports" / "orbit.mp4").exists() == bool(choice["video_frames"])
    assert told["self_test_seconds"] > 1 and told["real_seconds"] + told["self_test_seconds"] < whole + 0.5  # it comes on top
    assert any("Of the total budget of 10 s" in note and "this machine was measured" in note for note in data["notes"])
    assert "Of the total budget of 10 s" in (out / "report.html").read_text(encoding="utf-8")
    assert (tmp_path / "cache" / "fieldfuse" / "speed.json").is_file() and read_json(out / "report.json")["budget"] == told

    again = json.loads(call(capsys, *command, "--set", "export.formats=[ply,video,cameras]").out)
    assert again["budget"]["reused"] and again["budget"]["choice"] == choice
    # Measured again only where the machine turned out to be far slower, or faster, than it was when it was measured.
    far = abs(told["real_seconds"] - 10) > 2 * model.AGREES * 10
    assert (again["budget"]["self_test_seconds"] > 0) == far
    assert any("this machine was measured" in note for note in again["notes"]) == far
    assert all(stage["cached"] for stage in again["stages"])

    # What was decided for want of time (no effects, no networks) holds for work on the folder, too: the field stays.
    field = (out / "field.safetensors").read_bytes()
    answer = call(capsys, "export", out, "--formats", "points", "--threads", "1", "--quiet", "--json")
    assert answer.code == 0, answer.err
    made = {stage["name"] for stage in json.loads(answer.out)["stages"] if not stage["cached"]}
    assert choice["effects"] is False and made == {"export"} and (out / "field.safetensors").read_bytes() == field


def test_a_plan_is_kept_for_the_same_settings_and_dropped_when_it_is_damaged(tmp_path: Path) -> None:
    plan, job = planned(60.0), SimpleNamespace(folder=tmp_path, source=Path("source"))
    plan.choice = model.Choice(320, None, 20.0, 256, 20, None, 30, True, True, True)
    assert plan._kept(job) is None  # type: ignore[arg-type]
    plan.given = "these settings"
    plan._keep(job)  # type: ignore[arg-type]
    assert plan._kept(job) == plan.choice  # type: ignore[arg-type]
    plan.given = "others"
    assert plan._kept(job) is None  # type: ignore[arg-type]
    plan.given = "these settings"
    whole = read_json(tmp_path / "plan.json")
    for name, value in (("image_size", None), ("image_size", "320"), ("fit_seconds", None), ("page", 1), ("resolution", -1), ("more", 1)):
        write_json(tmp_path / "plan.json", {**whole, "choice": {**whole["choice"], name: value}})
        assert plan._kept(job) is None, name  # type: ignore[arg-type]
    (tmp_path / "plan.json").write_text('{"asked')
    assert plan._kept(job) is None  # type: ignore[arg-type]


UNITS = {"decode": 0.0042, "features": 0.19, "ray": 1.3e-6, "fit": 3.9e-6, "score": 0.81}  # of a machine
FOX = model.Work(50, 540, 960, 7, posed=True, depth=False, outlined=False, texture=True, page=True)


def planned(seconds: float, work: model.Work = FOX) -> TotalBudget:
    """A plan for photos like fox's on a machine that takes what one took, from now on."""
    plan = TotalBudget(seconds)
    plan._began = time.monotonic()
    plan.speed, plan.work, plan.choice, plan.all_wanted = model.Speed(dict(UNITS)), work, model.Choice(320), True
    return plan


def fitted(seconds: float, formats: list[str] | None = None, spent: float = 10.0) -> Any:
    """Settings and plan when the fit is decided, `spent` seconds after the start."""
    plan, settings = planned(seconds), load_settings("balanced")
    plan.all_wanted = formats is None
    settings.export.formats = formats or list(DEFAULT_EXPORTS)
    plan._began -= spent
    job = SimpleNamespace(settings=settings, stages=SimpleNamespace(cached={}, records={}))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fieldfuse.pipelines.total_budget.finest", lambda *_: 512)
        plan.choose_fit(job, None)  # type: ignore[arg-type]
    return settings, plan


def test_textures_and_the_page_are_left_out_where_they_would_take_the_fits_share() -> None:
    settings, plan = fitted(300)
    assert settings.export.formats == list(DEFAULT_EXPORTS) and plan.choice.texture and plan.choice.page
    assert plan.choice.fit_seconds > 0.35 * 300
    settings, plan = fitted(50, spent=20)
    assert settings.export.formats == [name for name in DEFAULT_EXPORTS if name != "texture"]
    assert plan.choice.texture is False and plan.choice.page and plan.choice.fit_seconds >= 0.35 * 50
    settings, plan = fitted(50, spent=25)
    assert settings.export.formats == [name for name in DEFAULT_EXPORTS if name not in ("texture", "page")]
    settings, plan = fitted(200, spent=140)  # less than its share, and enough
    assert settings.export.formats == list(DEFAULT_EXPORTS) and 30 <= plan.choice.fit_seconds < 0.35 * 200
    settings, plan = fitted(50, ["texture", "glb"], spent=25)
    assert settings.export.formats == ["texture", "glb"]  # what was named stays


def test_what_is_left_out_is_known_early_only_where_it_must_be() -> None:
    """The TSDF's texture comes before the fit; of an earlier plan all is known."""
    depth = replace(FOX, depth=True)
    assert not planned(20)._left_out_early("texture", None) and not planned(20, depth)._left_out_early("page", None)
    assert planned(20, depth)._left_out_early("texture", None) and not planned(400, depth)._left_out_early("texture", None)
    kept = model.Choice(160, texture=False)
    assert planned(300)._left_out_early("texture", kept) and not planned(20)._left_out_early("page", kept)


@pytest.mark.parametrize(
    ("corrected", "real", "factor"), [(False, 1.0, 1.0), (False, 3.0, 1.0), (False, 8.0, 2.0), (True, 8.0, 2.0), (False, 0.5, 0.5)]
)
def test_what_looking_for_effects_teaches(tmp_path: Path, corrected: bool, real: float, factor: float) -> None:
    """One second is predicted for the first look, at ten pictures, and four for all looks."""
    plan = TotalBudget(60)
    feature = 0.1 / model.COST["effects"][1]
    plan.choice = model.Choice(640)
    plan.speed = model.Speed({"decode": 1.0, "features": feature, "ray": 1.0, "fit": 1.0, "score": 1.0})
    plan.work = model.Work(30, 640, 480, 20, posed=True, depth=False, outlined=True)
    (tmp_path / "effects.json").write_text(json.dumps({"corrections": {"poses": [1] if corrected else []}}))
    plan._learn_effects(SimpleNamespace(folder=tmp_path), real)  # type: ignore[arg-type]
    assert plan.speed.factors.get("effects", 1.0) == pytest.approx(factor**model.LEARNING)


def test_a_flag_that_would_be_chosen_is_refused(tmp_path: Path, capsys: Capsys) -> None:
    make_room(tmp_path / "room", 4)
    for flag, value in (("--budget", "5"), ("--image-size", "100"), ("--preset", "fast")):
        answer = call(capsys, "run", tmp_path / "room", "--out", tmp_path / "out", "--total-budget", "20", flag, value)
        assert answer.code == 2 and f"chooses what {flag} would set" in answer.sentence()


def test_the_work_of_a_capture_is_read_from_its_headers(tmp_path: Path) -> None:
    from fieldfuse.capture import open_capture
    from fieldfuse.pipelines.total_budget import work_of

    make_room(tmp_path / "room", 8, depth=True)
    work = work_of(open_capture(tmp_path / "room"), load_settings("balanced", flags={"holdout": 4}))
    assert (work.frames, work.width, work.height, work.test) == (8, 96, 72, 2)
    assert work.posed and work.depth and work.outlined and not work.video
    amounts = model.amounts(work, model.Choice(48, mesh_views=12, video_frames=0))
    assert amounts["tsdf"] > 0 and amounts["poses"] == 0 and amounts["render"] == 2 * 48 * 36
