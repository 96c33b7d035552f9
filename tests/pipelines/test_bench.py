"""`fieldfuse bench speed` and `fieldfuse bake` from the command line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from pipelines import bench
from toolkit.errors import InputError


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
