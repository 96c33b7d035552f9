"""`fieldfuse run --total-budget`: settings are chosen, predicted and real seconds are told, and a second call reuses all of it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.pipelines.made import call, make_room
from toolkit.evaluate import budget as model
from toolkit.files import read_json

Capsys = pytest.CaptureFixture[str]


def test_a_run_that_takes_what_was_asked_for(tmp_path: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    make_room(tmp_path / "room", 10)
    out = tmp_path / "out"
    command = ["run", tmp_path / "room", "--out", out, "--total-budget", "14", "--holdout", "5", "--threads", "1", "--quiet", "--json"]
    answer = call(capsys, *command, "--set", "export.formats=[ply,video,cameras]")
    assert answer.code == 0, answer.err
    data = json.loads(answer.out)
    told = data["budget"]
    assert told["asked_seconds"] == 14 and told["predicted_seconds"] > 0 and not told["reused"]
    assert told["real_seconds"] >= data["seconds_total"] - 1
    choice, stages = told["choice"], told["stages"]
    assert choice["image_size"] == 160 and data["views"]["width"] == 96  # never enlarged
    assert stages["fit"]["real"] == pytest.approx(choice["fit_seconds"], abs=2) and choice["resolution"] >= 64
    assert {"capture", "scene", "views", "render", "export", "evaluate", "report"} <= set(stages)
    assert data["settings"]["fit"]["budget"] == choice["fit_seconds"]
    assert (out / "exports" / "orbit.mp4").exists() == bool(choice["video_frames"])
    assert any("Of the 14 s asked for" in note for note in data["notes"])
    assert "Of the 14 s asked for" in (out / "report.html").read_text(encoding="utf-8")
    assert (tmp_path / "cache" / "fieldfuse" / "speed.json").is_file() and read_json(out / "report.json")["budget"] == told

    again = json.loads(call(capsys, *command, "--set", "export.formats=[ply,video,cameras]").out)
    assert again["budget"]["reused"] and again["budget"]["choice"] == choice
    assert all(stage["cached"] for stage in again["stages"])


def test_a_flag_that_would_be_chosen_is_refused(tmp_path: Path, capsys: Capsys) -> None:
    make_room(tmp_path / "room", 4)
    for flag, value in (("--budget", "5"), ("--image-size", "100"), ("--preset", "fast")):
        answer = call(capsys, "run", tmp_path / "room", "--out", tmp_path / "out", "--total-budget", "20", flag, value)
        assert answer.code == 2 and f"chooses what {flag} would set" in answer.sentence()


def test_the_work_of_a_capture_is_read_from_its_headers(tmp_path: Path) -> None:
    from pipelines.total_budget import work_of
    from toolkit.capture import open_capture
    from toolkit.config import load_settings

    make_room(tmp_path / "room", 8, depth=True)
    work = work_of(open_capture(tmp_path / "room"), load_settings("balanced", flags={"holdout": 4}))
    assert (work.frames, work.width, work.height, work.test) == (8, 96, 72, 2)
    assert work.posed and work.depth and work.outlined and not work.video
    amounts = model.amounts(work, model.Choice(48, mesh_views=12, video_frames=0))
    assert amounts["tsdf"] > 0 and amounts["poses"] == 0 and amounts["render"] == 2 * 48 * 36
