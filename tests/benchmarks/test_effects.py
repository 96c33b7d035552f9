"""Detection of effects and what it is counted as; fits with what was found, with other modes, and with effects switched by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import effects, effects_by_hand, simulated
from benchmarks.effects import confusion, fits, table
from benchmarks.simulated import Planned
from fieldfuse.config import Settings
from fieldfuse.files import read_json
from fieldfuse.pipelines.console import ConsoleProgress
from tests.pipelines.made import bench
from tests.pipelines.short import steady

Capsys = pytest.CaptureFixture[str]


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {"WIDTH": 80, "HEIGHT": 60, "FRAMES": 9}.items():
        monkeypatch.setattr(simulated, name, value)


def looked(true: dict[str, str], *found: str) -> dict[str, Any]:
    return {"capture": "a", "scene": "room", "true": true, "found": list(found), "numbers": {}, "seconds": 1.0}


def test_weak_ones_are_neither_right_nor_wrong() -> None:
    rows = [
        looked({}),
        looked({}, "poses"),
        looked({"exposure": "weak"}, "exposure"),
        looked({"exposure": "medium", "poses": "strong"}, "exposure"),
        looked({"vignetting": "strong"}, "vignetting"),
    ]
    got = confusion(rows)
    assert got["precision"] == pytest.approx(2 / 3) and got["recall"] == pytest.approx(2 / 3)
    assert got["clean"] == 2 and got["clean_without_alarm"] == 1
    assert got["effects"]["poses"] == {
        "weak": {"captures": 0, "found": 0},
        "medium": {"captures": 0, "found": 0},
        "strong": {"captures": 1, "found": 0},
        "none": {"captures": 4, "found": 1},
    }
    lines = table({"rows": rows}).splitlines()
    assert "| exposure | 1 of 1 | 1 of 1 | 0 of 0 | 0 of 3 |" in lines and "precision 66.7%, recall 66.7%" in lines[-1]
    assert lines[-1].endswith("1 of 2 clean captures without any alarm")


@pytest.mark.usefixtures("small")
def test_captures_are_filmed_once_and_looked_at_each_time(tmp_path: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    lens = Planned("lens", "room", 8, (("distortion", "strong"),))
    monkeypatch.setattr(effects, "plan", lambda seed: [Planned("plain", "room", seed, ()), lens])
    filmed: list[dict[Path, int]] = []
    for _ in range(2):
        answer = bench(capsys, "effects", tmp_path, "--first-seed", "7")
        assert answer.code == 0 and "| distortion |" in answer.out, answer.err
        rows = read_json(tmp_path / "effects.json")["rows"]
        assert [(row["capture"], row["true"]) for row in rows] == [("plain", {}), ("lens", {"distortion": "strong"})]
        assert all(row["numbers"] and set(row["found"]) <= set(row["numbers"]) for row in rows)
        filmed.append({path: path.stat().st_mtime_ns for path in tmp_path.glob("*/planned.json")})
    assert filmed[0] == filmed[1] and len(filmed[0]) == 2


@pytest.mark.usefixtures("small")
def test_fits_are_scored_against_canonical_images_and_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    planned = [Planned("drift", "room", 6, (("exposure", "strong"), ("vignetting", "strong")))]
    with steady(0.005):
        data = fits(planned, tmp_path, 0.7, ["all_off", "known"]).conduct(tmp_path, ConsoleProgress())
    auto, off, known = data["rows"]
    assert known["canonical"] > off["canonical"] + 2
    assert known["effects_seconds"] < 0.2 * auto["effects_seconds"]  # nothing is looked for
    monkeypatch.setattr(effects, "fit_with", None)  # nothing is fitted twice
    again = fits(planned, tmp_path, 0.7, ["all_off", "known"]).conduct(tmp_path, ConsoleProgress())
    assert again["rows"] == data["rows"] == read_json(tmp_path / "fits-0.7s.json")["rows"]
    with pytest.raises(TypeError):
        fits(planned, tmp_path, 0.8, ["all_off", "known"]).conduct(tmp_path, ConsoleProgress())


def test_switched_by_hand(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capsys) -> None:
    fitted: list[dict] = []

    def fit(capture: object, settings: Settings, progress: object, found: object = None) -> dict:
        assert found == ("looked at" if settings.effects.on else None)
        fitted.append({"mode": settings.effects.mode, "on": settings.effects.on, "field": settings.field, "seed": settings.seed})
        return {"psnr": 20.0 + settings.seed, "psnr_corrected": 21.0, "seconds": 3.0}

    looks: list[Path] = []
    monkeypatch.setattr(effects_by_hand, "fit_with", fit)
    monkeypatch.setattr(effects_by_hand, "open_capture", lambda path: path)
    monkeypatch.setattr(effects_by_hand, "held_out", lambda capture, holdout: np.zeros(3, bool))
    monkeypatch.setattr(effects_by_hand, "diagnose", lambda capture, *rest, **more: looks.append(capture) or "looked at")
    command = ["effects_by_hand", tmp_path / "out", tmp_path / "a", tmp_path / "b", "--seconds", "2", "--image-size", "64"]
    answer = bench(capsys, *command, "--seeds", "2")
    assert answer.code == 0, answer.err
    assert looks == [tmp_path / "a", tmp_path / "b"]  # once each
    assert len(fitted) == 2 * 2 * len(effects_by_hand.SWITCHES)
    alone = [one for one in fitted if one["on"]]
    assert all(one["mode"] == "off" and len(one["on"]) == 1 for one in alone) and len(alone) == 4 * len(effects_by_hand.ALONE)
    assert {one["field"].background for one in fitted} == {"auto", "on", "off"}
    assert {one["field"].view for one in fitted} == {"auto", "none"}
    assert "| switched | a | b |\n" in answer.out and "| no view | 20.50 / 21.00 | 20.50 / 21.00 |\n" in answer.out
    before = len(fitted)
    again = bench(capsys, *command, "--seeds", "2", "--switches", "auto,poses")
    assert again.code == 0 and len(fitted) == before and len(read_json(tmp_path / "out" / "by_hand-64-2s.json")["rows"]) == before
    for more, words in (([], "two captures have the same name"), (["--switches", "pose"], "there is no 'pose'")):
        named = [tmp_path / "c" / "a"] if not more else []
        wrong = bench(capsys, "effects_by_hand", tmp_path / "out", tmp_path / "a", *named, *more)
        assert wrong.code == 2 and words in wrong.sentence()
