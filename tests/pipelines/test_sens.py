"""A `.sens` file through the command line: what is taken out of it is the run's own, is taken out again where it went, and may move."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.capture.layouts import write_sens
from tests.pipelines.made import call

Capsys = pytest.CaptureFixture[str]


def test_a_run_keeps_what_it_took_out(tmp_path: Path, capsys: Capsys) -> None:
    write_sens(tmp_path / "scan")
    source, out = tmp_path / "scan" / "scene0000_00.sens", tmp_path / "out"
    told = json.loads(call(capsys, "info", source, "--json").out)
    assert (told["kind"], told["frames"], told["depth"], told["posed"]) == ("scannet", 5, 5, True)
    assert "1 frame left out because tracking was lost" in told["warnings"][0]
    options = ("--quiet", "--json", "--threads", 1)
    answer = call(capsys, "poses", source, "--out", out, *options)
    assert answer.code == 0, answer.err
    data = json.loads(answer.out)
    assert data["capture"]["depth"] == data["capture"]["frames"] == data["poses"]["registered"] >= 3
    for frame in json.loads((out / "exports" / "cameras" / "transforms.json").read_text())["frames"]:
        assert (out / frame["file_path"]).is_file()
    depths = sorted((out / "frames" / "depth").iterdir())
    assert len(depths) == data["capture"]["frames"]
    depths[1].unlink()
    again = json.loads(call(capsys, "poses", source, "--out", out, *options).out)
    assert {stage["name"]: stage["cached"] for stage in again["stages"]} == {"capture": True, "frames": False, "poses": False}
    assert depths[1].is_file()
    out.rename(tmp_path / "moved")
    last = json.loads(call(capsys, "poses", source, "--out", tmp_path / "moved", *options).out)
    assert all(stage["cached"] for stage in last["stages"])


def test_a_damaged_file_ends_with_one_sentence(tmp_path: Path, capsys: Capsys) -> None:
    write_sens(tmp_path / "scan")
    source = tmp_path / "scan" / "scene0000_00.sens"
    source.write_bytes(source.read_bytes()[:9000])
    answer = call(capsys, "tsdf", source, "--out", tmp_path / "out", "--quiet")
    assert answer.code == 2 and len(answer.err.strip().splitlines()) == 1
    assert str(source) in answer.err and "copy it again" in answer.err
