"""Benchmarks on a prepared capture: few views, parts of the networks, engines; and key frames of a made-up room."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
import torch

from benchmarks.ablations import PARTS
from fieldfuse.config import load_settings
from fieldfuse.files import read_json
from tests.pipelines.made import CAMERA, bench, make_room
from tests.pipelines.short import clocked

Capsys = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("few") / "room"
    make_room(folder, 12, True, CAMERA.scaled(48, 36))
    return folder


@pytest.mark.slow
def test_tables_of_few_views_go_on_where_they_stopped(room: Path, tmp_path: Path, capsys: Capsys) -> None:
    out = tmp_path / "table"
    command = ["few_views", room, "--out", out, "--budgets", "0.5", "--set", "field.resolution=32", "--set", "network.voxels=12"]
    first = bench(capsys, *command, "--views", "3", "--starts", "classical")
    assert first.code == 0, first.err
    assert read_json(out / "few_views.json")["settings"]["fit"]["budget"] == load_settings().fit.budget, "rows name their own"
    before = read_json(out / "few_views.json")["rows"]
    assert [row["start"] for row in before] == ["nearest", "classical"]
    answer = bench(capsys, *command, "--views", "3,all")
    assert answer.code == 0, answer.err
    rows = read_json(out / "few_views.json")["rows"]
    assert all(row in rows for row in before) and {(row["views"], row["start"]) for row in rows} == {
        (count, start) for count in (3, 10) for start in ("nearest", "direct", "network", "classical")
    }
    assert all(5 < row["psnr"] < 60 for row in rows)
    text = (out / "few_views.md").read_text()
    lines = [line for line in text.splitlines() if line.startswith("|")]
    assert len(lines) == 4 and lines[2].startswith("| 3 |") and "classical start, 0.5 s" in lines[0] and text in answer.out
    assert "    python -m benchmarks.few_views " in text


def test_parts_of_the_networks_can_be_switched_off(room: Path, tmp_path: Path, capsys: Capsys) -> None:
    settings = ["--set", "network.voxels=12", "--views", "4"]
    answer = bench(capsys, "ablations", room, "--out", tmp_path / "table", *settings, "--quiet")
    assert answer.code == 0 and not answer.out, answer.err
    rows = {row["part"]: row for row in read_json(tmp_path / "table" / "ablations.json")["rows"]}
    assert tuple(rows) == PARTS
    others = [row["psnr"] for name, row in rows.items() if name != "whole"]
    assert all(value != rows["whole"]["psnr"] for value in others) and len(set(others)) == len(PARTS) - 1
    assert "| 4 | no variance |" in (tmp_path / "table" / "ablations.md").read_text()


def test_engines_are_measured_side_by_side(room: Path, tmp_path: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each engine fits within the same seconds, and renders of its field are timed."""
    monkeypatch.setattr("benchmarks.engines.IMAGE", (96, 72))
    monkeypatch.setattr("benchmarks.engines.STEPS", 2)
    with clocked(lambda: time.process_time):  # what else the machine does is not counted
        answer = bench(
            *(capsys, "engines", room, "--out", tmp_path / "engines", "--budgets", "1", "--engines", "auto,torch"),
            *("--threads", 1, "--set", "field.resolution=32", "--set", "effects=off", "--quiet"),
        )
    assert answer.code == 0, answer.err
    data = read_json(tmp_path / "engines" / "engines.json")
    assert [row["chosen"] for row in data["rows"]] == ["numba", "torch"] and data["machine"]["threads"] == 1
    for row in data["rows"]:
        assert row["psnr"] > 10 and row["picture_ms"] > 0 and row["timeline"]
    assert data["rows"][0]["rays"] > data["rows"][1]["rays"]
    lines = (tmp_path / "engines" / "engines.md").read_text(encoding="utf-8").splitlines()
    assert [line.split()[1] for line in lines if line.startswith("|")] == ["engine", "---", "numba", "torch"]


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (["few_views", "--views", "0"], "'0' is neither"),
        (["few_views", "--starts", "magic"], "there is no 'magic'; known are direct, network, classical"),
        (["engines", "--budgets", "-1"], "--budgets"),
        (["engines", "--engines", "auto,steam"], "there is no 'steam'; known are auto, numba, triton, torch"),
        pytest.param(
            ["engines", "--engines", "triton", "--set", "effects=off"],
            "runs on CUDA alone, and the device is 'cpu'",
            marks=pytest.mark.skipif(torch.cuda.is_available(), reason="Triton's engine runs here"),
        ),
    ],
)
def test_wrong_options_are_refused(command: list[str], words: str, room: Path, tmp_path: Path, capsys: Capsys) -> None:
    name, *options = command
    answer = bench(capsys, name, room, "--out", tmp_path / "out", *options)
    assert answer.code == 2 and words in answer.sentence()


def test_key_frames_of_a_made_up_room_are_counted(tmp_path: Path, capsys: Capsys) -> None:
    given = ["--key-frames", "3", "--width", "96", "--voxel", "0.16", "--repetitions", "2", "--threads", "1", "--device", "cpu"]
    done = bench(capsys, "key_frames", "--out", tmp_path, *given)
    assert done.code == 0, done.err
    data = read_json(tmp_path / "key_frames.json")
    first, second = data["rows"][0]["times"]
    assert first["key_frames"] == 3 and first["known"] > 1000 and data["machine"]["device"] == "cpu"
    assert all(first[name] == second[name] for name in ("known", "blocks", "resolution"))
    assert second["rate"] == pytest.approx(3 / second["seconds"], rel=0.01) and second["late_ms"] > 0
    assert "key frames/s" in done.out
