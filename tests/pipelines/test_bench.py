"""`fieldfuse bench speed` and `fieldfuse bake` from the command line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from fieldfuse.errors import InputError
from fieldfuse.pipelines import bench, cli


def test_some_parts_are_measured_and_written(tmp_path: Path) -> None:
    path = tmp_path / "speed.json"
    done = CliRunner().invoke(
        bench.app, ["speed", "--json", str(path), "--parts", "lookup,convolution", "--repetitions", "1", "--threads", "1"]
    )
    assert done.exit_code == 0, done.output
    data = json.loads(path.read_text())
    assert [case["unit"] for case in data["cases"]] == ["point", "voxel"]
    assert all(case["ratio"] > 0 and case["ours"]["processor"] > 0 for case in data["cases"])
    assert data["machine"]["threads"] == 1 and data["machine"]["versions"]["torch"]
    assert "times faster" in done.output and "block convolution" in done.output


def test_an_unknown_part_is_told() -> None:
    with pytest.raises(InputError, match="there is no benchmark 'lunch'"):
        bench.chosen("step,lunch")


def test_key_frames_of_a_made_up_room_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "keys.json"
    given = ["--key-frames", "3", "--width", "96", "--voxel", "0.16", "--repetitions", "2", "--threads", "1", "--device", "cpu"]
    done = CliRunner().invoke(cli.app, ["bench", "keyframes", "--json", str(path), *given])
    assert done.exit_code == 0, done.output
    data = json.loads(path.read_text())
    first, second = data["key_frames"]
    assert first["key_frames"] == 3 and first["known"] > 1000 and data["machine"]["device"] == "cpu"
    assert all(first[name] == second[name] for name in ("known", "blocks", "resolution"))
    assert second["rate"] == pytest.approx(3 / second["seconds"], rel=0.01) and second["late_ms"] > 0
    assert "key frames/s" in done.output
