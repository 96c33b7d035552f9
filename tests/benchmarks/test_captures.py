"""Whole runs of a folder of captures, each in a process of its own."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

from benchmarks.captures import Plan, experiment, run_one, runs_of, sources, table, worth
from fieldfuse.errors import InputError, Interrupted
from fieldfuse.files import read_json, write_json
from fieldfuse.pipelines.console import ConsoleProgress
from fieldfuse.poses import child
from tests.pipelines.made import bench, make_room

Capsys = pytest.CaptureFixture[str]
SHORT = ["--budget", "1", "--threads", "1", "--image-size", "64"]
PAIRS = ["--set", "field.resolution=16", "--set", "init=classical"]


@pytest.mark.slow
def test_a_bad_capture_is_a_row_and_finished_runs_are_reused(tmp_path: Path, capsys: Capsys) -> None:
    make_room(tmp_path / "data" / "room", 10)
    (tmp_path / "data" / "broken").mkdir()
    (tmp_path / "data" / "broken" / "transforms.json").write_text("{}")
    (tmp_path / "data" / "README.md").write_text("what lies here")
    out = tmp_path / "out"
    command = ["captures", tmp_path / "data", "--out", out, *SHORT, *PAIRS]
    answer = bench(capsys, *command, "--jobs", "2", "--quiet")
    assert answer.code == 0, answer.err
    found = {one["capture"]: one["runs"] for one in read_json(out / "captures.json")["rows"]}
    (broken,), (room,) = found["broken"], found["room"]
    assert broken["state"] == "refused" and "transforms.json" in broken["error"]
    assert room["state"] == "read" and room["psnr"] > 8 and room["nearest_image"] > 5 and room["registered"] == room["total"] == 10
    assert not (out / "runs" / "room" / "default-0" / "exports" / "field.html").exists()
    text = (out / "captures.md").read_text()
    assert "| room | transforms, given | 10 of 10 |" in text and "| broken |" in text

    made = (out / "runs" / "room" / "default-0" / "stages" / "field.json").read_text()
    again = bench(capsys, *command, "--only", "room")
    assert "| room |" in again.out and "broken" not in again.out
    assert (out / "runs" / "room" / "default-0" / "stages" / "field.json").read_text() == made


def test_bad_flags_are_refused_before_anything_runs(tmp_path: Path, capsys: Capsys) -> None:
    (tmp_path / "data" / "a").mkdir(parents=True)
    for more, words in (
        (["--seeds", "0,x"], "--seeds"),
        (["--only", "b"], "there are a"),
        (["--set", "field.resolutoin=3"], "resolutoin"),
    ):
        answer = bench(capsys, "captures", tmp_path / "data", "--out", tmp_path / "out", *more)
        assert answer.code == 2 and words in answer.sentence() and not (tmp_path / "out").exists()


def test_what_is_a_source(tmp_path: Path) -> None:
    for name in ("b10", "b9", ".git", "out"):
        (tmp_path / name).mkdir()
    for name in ("a.mp4", "notes.txt", "c.sens", "transforms.json"):
        (tmp_path / name).touch()
    assert [path.name for path in sources(tmp_path, tmp_path / "out")] == ["a.mp4", "b9", "b10", "c.sens"]
    assert [path.name for path in sources(tmp_path, tmp_path / "out", "c.sens, b9,c.sens")] == ["c.sens", "b9"]
    with pytest.raises(InputError, match="holds no captures"):
        sources(tmp_path / "b9", tmp_path / "out")
    for nothing in ("a.mp4", "nowhere"):
        with pytest.raises(InputError, match="cannot list"):
            sources(tmp_path / nothing, tmp_path / "out")


def test_names_are_no_options_and_any_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "--help").mkdir()
    (tmp_path / os.fsdecode(b"a\xff |\nb")).mkdir()
    found = sources(Path(), tmp_path / "out")
    assert all(str(path).startswith("/") for path in found)
    monkeypatch.setattr(child, "run_logged", lambda *_: 1)
    experiment(found, plan(tmp_path, seeds=(0,), compare_effects=False), ConsoleProgress()).conduct(tmp_path / "out", ConsoleProgress())
    assert [one["capture"] for one in read_json(tmp_path / "out" / "captures.json")["rows"]] == ["--help", "a\ufffd | b"]
    assert "| a\ufffd / b |" in (tmp_path / "out" / "captures.md").read_text(encoding="utf-8")


def test_only_what_can_differ_is_compared() -> None:
    assert worth("own poses", {"state": "read", "kind": "llff", "poses": "given"})
    assert worth("own poses", {"state": "refused", "kind": "colmap", "poses": None})
    assert worth("own poses", {"state": "refused", "kind": None, "poses": None})
    assert not worth("own poses", {"state": "read", "kind": "llff", "poses": "sfm"})
    assert not worth("own poses", {"state": "refused", "kind": "photos", "poses": None})
    assert not worth("effects off", {"state": "refused", "kind": "llff", "poses": None})


def plan(tmp_path: Path, **more: Any) -> Plan:
    return Plan(**{"out": tmp_path / "out", "options": (), "compare_effects": True, "seeds": (0, 1), "timeout": 100.0, **more})


def test_variants_and_seeds_have_folders_of_their_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[list[str]] = []

    def run(arguments: list[str], log: Path, *_: Any) -> int:
        asked.append(arguments)
        log.write_text("")
        field = {"psnr": 20.0 + len(asked)}
        found = {"evaluation": {"field": field, "nearest_image": None}, "capture": {"kind": "llff", "masks": 0}, "views": {"total": 9}}
        found |= {"poses": {"source": "given", "registered": 9, "total": 9}, "effects": None, "seconds_total": 3.0, "warnings": []}
        write_json(Path(arguments[arguments.index("--out") + 1]) / "report.json", found)
        return 0

    monkeypatch.setattr(child, "run_logged", run)
    (tmp_path / "fern").mkdir()
    rows = runs_of(tmp_path / "fern", plan(tmp_path), ConsoleProgress())
    assert [(row["variant"], row["seed"], row["psnr"]) for row in rows] == [
        (variant, seed, 21.0 + 2 * place + seed)
        for place, variant in enumerate(("default", "effects off", "own poses"))
        for seed in (0, 1)
    ]
    assert len({arguments[arguments.index("--out") + 1] for arguments in asked}) == 6
    assert all("effects=off" in asked[place] for place in (2, 3)) and all("sfm" in asked[place] for place in (4, 5))
    assert len(runs_of(tmp_path / "fern", plan(tmp_path, compare_effects=False), ConsoleProgress())) == 2


@pytest.mark.parametrize(
    ("code", "state", "words"),
    [
        (2, "refused", "no poses"),
        (1, "failed", "exit code 1"),
        (-9, "failed", "SIGKILL"),
        (None, "failed", "100 s"),
        (0, "failed", "report"),
    ],
)
def test_how_a_run_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int | None, state: str, words: str) -> None:
    def run(arguments: list[str], log: Path, *_: Any) -> int:
        log.write_text("capture: 0.1 s\nfieldfuse: no poses\n")
        if code is None:
            raise TimeoutError("it took longer than 100 s and was ended")
        return code

    monkeypatch.setattr(child, "run_logged", run)
    (tmp_path / "fern").mkdir()
    row = run_one(tmp_path / "fern", plan(tmp_path), [], "default-0", ConsoleProgress())
    assert row["kind"] is None and row["state"] == state and words in row["error"] and not row["error"].startswith("fieldfuse: ")


def test_a_child_that_hangs_or_is_not_wanted_any_more_is_ended(tmp_path: Path) -> None:
    sleeping = ["-c", "import time; time.sleep(600)"]
    with pytest.raises(TimeoutError, match=r"longer than 0\.3 s"):
        child.run_logged(sleeping, tmp_path / "log", lambda _: None, 0.3)
    progress = ConsoleProgress()
    progress.request_stop()
    with pytest.raises(Interrupted):
        child.run_logged(sleeping, tmp_path / "log", lambda _: progress.check())
    assert child.run_logged(["-c", "import sys; print('said'); sys.exit(7)"], tmp_path / "log", lambda _: None) == 7
    assert child.log_tail(tmp_path / "log") == "said"
    assert child.end_reason(7) == "failed with exit code 7"


READ = {
    "state": "read", "error": None, "kind": "llff", "poses": "given", "registered": 20, "total": 21, "masks": 0, "psnr": 22.126,
    "nearest_image": 15.04, "seconds": 61.4, "effects": ["motion_blur"], "warnings": [],
}  # fmt: skip
REFUSED = {"state": "refused", "error": "no | poses", "kind": "llff", "poses": None}


def one(variant: str = "default", seed: int = 0, **facts: Any) -> dict[str, Any]:
    return {"variant": variant, "seed": seed, **facts}


def rows(captures: dict[str, list[dict[str, Any]]]) -> list[list[str]]:
    listed = [{"capture": name, "runs": runs} for name, runs in captures.items()]
    text = table({"rows": listed})
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line.startswith("| ")]


def test_variants_have_columns_and_seeds_stand_side_by_side() -> None:
    off = one("effects off", **{**READ, "psnr": 21.0})
    seeds = [one(**READ), one(seed=1, **{**READ, "psnr": 22.0})]
    head, _, fern, gum = rows({"fern": [*seeds, off], "gum": [one(**{**READ, "masks": 20, "warnings": ["dark", "few"], "effects": []})]})
    assert head[3:5] == ["PSNR, default", "PSNR, effects off"]
    assert fern == ["fern", "llff, given", "20 of 21", "22.13, 22.00", "21.00", "15.0", "motion blur", "61", "none"]
    assert gum[3:5] == ["22.13 (within its masks)", "–"] and gum[-3:] == ["nothing", "61", "2: dark"]


def test_a_refusal_is_shown_once() -> None:
    own = [one(**REFUSED), one("own poses", **REFUSED)]
    (_, _, *found) = rows({"a": own, "b": [one(**REFUSED), one("own poses", **READ)], "c": [one(**{**REFUSED, "error": "x" * 999})]})
    assert found[0][3:5] == ["refused: no / poses", "refused"] and found[1][3:5] == ["refused: no / poses", "22.13"]
    assert len(found[2][3]) < 300 and all(len(row) == 9 for row in found)
