"""`fieldfuse run --total-budget`: settings are chosen, predicted and real seconds are told, and a second call reuses all of it."""

from __future__ import annotations

import json
import time
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest

from pipelines.total_budget import LONGEST_START, TotalBudget
from tests.pipelines.made import call, make_room
from toolkit.config import EXPORTS, load_settings
from toolkit.evaluate import budget as model
from toolkit.files import read_json

Capsys = pytest.CaptureFixture[str]


def test_a_run_that_takes_what_was_asked_for(tmp_path: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    make_room(tmp_path / "room", 10)
    out = tmp_path / "out"
    command = ["run", tmp_path / "room", "--out", out, "--total-budget", "14", "--holdout", "5", "--threads", "1", "--quiet", "--json"]
    age, start = time.time() - psutil.Process().create_time(), time.monotonic()
    answer = call(capsys, *command, "--set", "export.formats=[ply,video,cameras]")
    whole = time.monotonic() - start + (age if age < LONGEST_START else 0.0)
    assert answer.code == 0, answer.err
    data = json.loads(answer.out)
    told = data["budget"]
    assert told["asked_seconds"] == 14 and told["predicted_seconds"] > 0 and not told["reused"]
    assert told["real_seconds"] + told["self_test_seconds"] >= data["seconds_total"] - 1
    choice, stages = told["choice"], told["stages"]
    assert choice["image_size"] == 160 and data["views"]["width"] == 96  # never enlarged
    assert stages["fit"]["real"] == pytest.approx(choice["fit_seconds"], abs=2) and choice["resolution"] >= 64
    assert {"capture", "scene", "views", "render", "export", "evaluate", "report"} <= set(stages)
    assert data["settings"]["fit"]["budget"] == choice["fit_seconds"]
    assert (out / "exports" / "orbit.mp4").exists() == bool(choice["video_frames"])
    assert told["self_test_seconds"] > 1 and told["real_seconds"] + told["self_test_seconds"] < whole + 0.5  # it comes on top
    assert any("Of the 14 s asked for" in note and "this machine was measured" in note for note in data["notes"])
    assert "Of the 14 s asked for" in (out / "report.html").read_text(encoding="utf-8")
    assert (tmp_path / "cache" / "fieldfuse" / "speed.json").is_file() and read_json(out / "report.json")["budget"] == told

    again = json.loads(call(capsys, *command, "--set", "export.formats=[ply,video,cameras]").out)
    assert again["budget"]["reused"] and again["budget"]["choice"] == choice and again["budget"]["self_test_seconds"] == 0
    assert not any("this machine was measured" in note for note in again["notes"])
    assert all(stage["cached"] for stage in again["stages"])


def extras(seconds: float, formats: list[str], kept: model.Choice | None = None) -> tuple[list[str], model.Work]:
    """What is left of `formats` for fox's photos on a machine that takes what one took, and the work then."""
    units = {"decode": 0.0044, "features": 0.183, "ray": 1.5e-6, "fit": 3.9e-6, "score": 0.81}
    plan = TotalBudget(seconds)
    plan._began = time.monotonic()
    plan.speed = model.Speed(units)
    plan.work = model.Work(50, 540, 960, 7, posed=True, depth=False, outlined=False, texture=True, page=True)
    settings = load_settings("balanced")
    settings.export.formats = formats
    plan._decide_extras(settings, kept)
    return settings.export.formats, plan.work


def test_textures_and_the_page_are_left_out_where_they_would_take_the_fits_share() -> None:
    assert extras(300, list(EXPORTS))[0] == list(EXPORTS)
    formats, work = extras(50, list(EXPORTS))
    assert formats == [name for name in EXPORTS if name != "texture"] and work.page and not work.texture
    formats, work = extras(20, list(EXPORTS))
    assert formats == [name for name in EXPORTS if name not in ("texture", "page")] and not work.page and not work.texture
    assert extras(20, ["texture", "glb"])[0] == ["texture", "glb"]  # what was asked for by name stays
    assert extras(300, list(EXPORTS), model.Choice(160, texture=False))[0] == [name for name in EXPORTS if name != "texture"]
    assert extras(20, list(EXPORTS), model.Choice(160))[0] == list(EXPORTS)  # an earlier plan, of before


@pytest.mark.parametrize(
    ("corrected", "real", "factor"), [(False, 1.0, 1.0), (False, 3.0, 1.0), (False, 8.0, 2.0), (True, 8.0, 2.0), (False, 0.5, 0.5)]
)
def test_what_looking_for_effects_teaches(tmp_path: Path, corrected: bool, real: float, factor: float) -> None:
    """One second is predicted for the first look, at ten pictures, and four for all looks."""
    plan = TotalBudget(60)
    plan.speed = model.Speed({"decode": 1.0, "features": 0.1, "ray": 1.0, "fit": 1.0, "score": 1.0})
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
    from pipelines.total_budget import work_of
    from toolkit.capture import open_capture

    make_room(tmp_path / "room", 8, depth=True)
    work = work_of(open_capture(tmp_path / "room"), load_settings("balanced", flags={"holdout": 4}))
    assert (work.frames, work.width, work.height, work.test) == (8, 96, 72, 2)
    assert work.posed and work.depth and work.outlined and not work.video
    amounts = model.amounts(work, model.Choice(48, mesh_views=12, video_frames=0))
    assert amounts["tsdf"] > 0 and amounts["poses"] == 0 and amounts["render"] == 2 * 48 * 36
