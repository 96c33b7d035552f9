"""`fieldfuse bench SUITE` on small captures, and its table in a page."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from fieldfuse.files import read_json, write_json
from tests.pipelines.made import call, make_room

Capsys = pytest.CaptureFixture[str]


def test_posed_captures_are_measured_and_their_table_written(tmp_path: Path, capsys: Capsys) -> None:
    make_room(tmp_path / "data" / "room", 10)
    (tmp_path / "data" / "broken").mkdir()
    (tmp_path / "data" / "broken" / "transforms.json").write_text("{}")
    out = tmp_path / "out"
    command = ["bench", "posed", tmp_path / "data", "--out", out, "--threads", "1", "--budget", "1", "--variants", "fitted"]
    command += ["--set", "field.resolution=32", "--set", "init=classical"]
    answer = call(capsys, *command, "--quiet", "--json")
    assert answer.code == 0, answer.err
    rows = {row["scene"]: row for row in json.loads(answer.out)["rows"]}
    fitted = rows["room"]
    assert fitted["psnr"] > 10 and fitted["train"] == 8 and fitted["test"] == 2 and fitted["fit_seconds"] > 0.05 and fitted["voxels"] > 0
    assert rows["broken"]["error"] and rows["broken"].get("psnr") is None
    assert read_json(out / "results.json")["rows"] == list(rows.values())

    again = call(capsys, *command, "--scenes", "room")  # on the terminal, and reused
    assert "| room |" in again.out and "fit" in again.out
    (row,) = read_json(out / "results.json")["rows"]
    assert row["psnr"] == fitted["psnr"] and all(stage["cached"] for stage in row["stages"])

    page = tmp_path / "page.md"
    page.write_text("# Results\n")
    assert call(capsys, "bench", "table", out / "results.json", "--into", page, "--name", "rooms").code == 0
    assert "<!-- measured: rooms -->" in page.read_text() and "| room |" in page.read_text()


def test_a_scene_whose_poses_do_not_fit_is_a_row_too(tmp_path: Path, capsys: Capsys) -> None:
    for scene in ("a", "b"):
        make_room(tmp_path / "data" / scene, 4)
        listed = read_json(tmp_path / "data" / scene / "transforms.json")
        for number, frame in enumerate(listed["frames"]):  # all cameras at one place, which do not look where the pictures were taken
            frame["transform_matrix"] = np.eye(4).tolist()
            frame["transform_matrix"][0][3] = 0.01 * number
        write_json(tmp_path / "data" / scene / "transforms.json", listed)
    answer = call(capsys, "bench", "posed", tmp_path / "data", "--out", tmp_path / "out", "--variants", "fitted", "--quiet", "--json")
    assert answer.code == 0, answer.err
    assert [row["scene"] for row in json.loads(answer.out)["rows"] if "check the poses" in row["error"]] == ["a", "b"]


def test_the_networks_alone(tmp_path: Path, capsys: Capsys) -> None:
    make_room(tmp_path / "room", 10)
    answer = call(
        capsys,
        "bench",
        "posed",
        tmp_path / "room",
        "--out",
        tmp_path / "out",
        "--variants",
        "direct",
        "--threads",
        "1",
        "--set",
        "network.voxels=12",
        "--set",
        "keyframes.most=5",
        "--json",
        "--quiet",
    )
    assert answer.code == 0, answer.err
    (row,) = json.loads(answer.out)["rows"]
    assert row["psnr"] > 5 and row["voxels"] > 0 and row["fit_seconds"] > 0 and [stage["name"] for stage in row["stages"]][-1] == "direct"


def test_what_is_not_there_is_told(tmp_path: Path, capsys: Capsys) -> None:
    (tmp_path / "results.json").write_text("{}")
    (tmp_path / "page.md").write_text("")
    for arguments, words in (
        (["dtu", tmp_path, "--out", tmp_path / "out"], "holds no scene of DTU"),
        (["llff", tmp_path, "--out", tmp_path / "out", "--variants", "direct"], "known are fitted"),
        (["table", tmp_path / "results.json", "--into", tmp_path / "page.md"], "holds no results"),
    ):
        answer = call(capsys, "bench", *arguments)
        assert answer.code == 2 and words in answer.sentence()
