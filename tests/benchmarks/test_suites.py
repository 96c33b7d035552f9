"""Protocols: which pictures train and test, which scenes are found, and tables with reported numbers set apart."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest

from benchmarks.experiment import section
from benchmarks.protocols import suite_of
from benchmarks.suites import table
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.errors import InputError
from fieldfuse.files import read_json
from tests.capture.layouts import LAYOUTS
from tests.pipelines.made import bench, make_room

Capsys = pytest.CaptureFixture[str]


def capture_of(count: int, split: bool = False) -> Capture:
    frames = [
        Frame(f"{index:03d}", Path(f"{index:03d}.png"), split=("test" if index % 5 == 4 else "train") if split else None)
        for index in range(count)
    ]
    return Capture("transforms", Path("scene"), tuple(frames))


def names(capture: Capture, split: str) -> list[int]:
    return [int(frame.name) for frame in capture.frames if frame.split == split]


def test_dtu_takes_the_views_of_the_paper() -> None:
    three, sixteen = (suite_of("dtu").variant(key).pick(capture_of(49)) for key in ("3-fitted", "16-fitted"))
    assert names(three, "test") == names(sixteen, "test") == [23, 24, 32, 44]
    assert names(three, "train") == [21, 25, 33] and len(names(sixteen, "train")) == 16
    assert set(names(three, "train")) < set(names(sixteen, "train")) and len(sixteen.frames) == 20
    with pytest.raises(InputError, match="has 40 images, and the protocol needs number 44"):
        suite_of("dtu").variant("3-fitted").pick(capture_of(40))


def test_every_eighth_image_is_held_out() -> None:
    for suite in ("llff", "scannet", "posed"):
        picked = suite_of(suite).variant("fitted").pick(capture_of(20))
        assert names(picked, "test") == [0, 8, 16] and len(picked.frames) == 20


def test_a_split_that_is_there_is_kept() -> None:
    for suite in ("nerf-synthetic", "posed"):
        picked = suite_of(suite).variant("fitted").pick(capture_of(10, split=True))
        assert names(picked, "test") == [4, 9]
    with pytest.raises(InputError, match="brings no test split"):
        suite_of("nerf-synthetic").variant("fitted").pick(capture_of(10))


def test_scenes_are_found_by_name(tmp_path: Path) -> None:
    for name in ("ship", "lego", "other"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "transforms_train.json").write_text("{}")
    (tmp_path / "chair").mkdir()  # holds nothing
    suite = suite_of("nerf-synthetic")
    assert [name for name, _ in suite.find(tmp_path)] == ["lego", "ship"]
    assert [name for name, _ in suite_of("posed").find(tmp_path)] == ["lego", "other", "ship"]
    assert suite.find(tmp_path / "other") == [("other", tmp_path / "other")]  # one scene, given directly
    assert [name for name, _ in suite.find(tmp_path, ["ship"])] == ["ship"]
    with pytest.raises(InputError, match="holds no scene 'mic'; there are lego, ship"):
        suite.find(tmp_path, ["mic"])
    for empty in (tmp_path / "chair", tmp_path / "nowhere"):
        with pytest.raises(InputError, match="NeRF-synthetic"):
            suite.find(empty)
    with pytest.raises(InputError, match="known are direct, fitted"):
        suite.variant("baked")
    with pytest.raises(InputError, match="there is no benchmark 'imagenet'; known are nerf-synthetic, dtu, scannet, llff, posed"):
        suite_of("imagenet")


def test_scenes_of_every_posed_layout_are_found(tmp_path: Path) -> None:
    posed = [name for name in LAYOUTS if name != "photos"]
    for name in posed:
        LAYOUTS[name][1](tmp_path / name)
    (tmp_path / "photos").mkdir()
    shutil.copy(next((tmp_path / "tum" / "rgb").iterdir()), tmp_path / "photos" / "a.png")
    assert {name for name, _ in suite_of("posed").find(tmp_path)} == set(posed)
    assert suite_of("posed").find(tmp_path / "tum") == [("tum", tmp_path / "tum")]


def test_scannets_rooms_bring_their_split(tmp_path: Path) -> None:
    frames = [Frame(f"{index:03d}", tmp_path / "images" / f"{index:03d}.jpg") for index in range(12)]
    capture, pick = Capture("colmap", tmp_path, tuple(frames)), suite_of("scannet").variant("fitted").pick
    (tmp_path / "train.txt").write_text("010.jpg\n001.jpg\n007.jpg\n")
    assert names(pick(capture), "test") == [0, 8]  # one list alone is none
    (tmp_path / "test.txt").write_text("004.jpg\n002.png\n\n")
    assert names(pick(capture), "train") == [1, 7, 10] and names(pick(capture), "test") == [2, 4]
    assert len(pick(capture).frames) == 5
    (tmp_path / "test.txt").write_text("004.jpg\n012.jpg\n")
    with pytest.raises(InputError, match=r"test\.txt names 012\.jpg, which is not among the images with a pose"):
        pick(capture)


def results(**more: Any) -> dict[str, Any]:
    row = {"variant": "16-fitted", "psnr": 25.0, "ssim": 0.8, "lpips": None, "train": 16, "test": 4, "width": 640, "height": 512}
    row |= {"fit_seconds": 60.0, "seconds": 75.0, "voxels": 123456, "error": None}
    rows = [
        {**row, "scene": "scan24"},
        {**row, "scene": "scan37", "psnr": 27.0},
        {"scene": "scan40", "variant": "16-fitted", "error": "no | pictures"},
    ]
    machine = {"cores": 2, "threads": 1, "load": 3.0}
    return {"suite": "dtu", "title": "DTU", "command": "python -m benchmarks.suites dtu DATA", "rows": rows, "machine": machine, **more}


def test_reported_numbers_are_marked_as_such() -> None:
    text = section(results(), table)
    assert text.startswith("### DTU\n")
    assert "| scan37 | 27.00 | 0.800 | – | 16 / 4 | 640×512 |" in text and "| mean of 2 | 26.00 |" in text
    (line,) = [line for line in text.splitlines() if "31.79" in line]
    assert "reported, not measured" in line and "*31.79*" in line
    assert "26.19" not in text  # of a variant that was not run
    assert "not made: no / pictures" in text and "Not as in the paper" in text and "load 3.0" in text
    assert len({line.count("|") for line in text.splitlines() if line.startswith("|")}) == 1


def test_posed_captures_are_measured_and_their_table_written(tmp_path: Path, capsys: Capsys) -> None:
    make_room(tmp_path / "data" / "room", 10)
    (tmp_path / "data" / "broken").mkdir()
    (tmp_path / "data" / "broken" / "transforms.json").write_text("{}")
    out = tmp_path / "out"
    command = ["suites", "posed", tmp_path / "data", "--out", out, "--threads", "1", "--budget", "1", "--variants", "fitted"]
    command += ["--set", "field.resolution=32", "--set", "init=classical"]
    answer = bench(capsys, *command, "--quiet")
    assert answer.code == 0, answer.err
    rows = {row["scene"]: row for row in read_json(out / "results.json")["rows"]}
    fitted = rows["room"]
    assert fitted["psnr"] > 10 and fitted["train"] == 8 and fitted["test"] == 2 and fitted["fit_seconds"] > 0.05 and fitted["voxels"] > 0
    assert rows["broken"]["error"] and rows["broken"].get("psnr") is None

    again = bench(capsys, *command, "--scenes", "room")  # on the terminal, and reused
    assert "| room |" in again.out and "fit" in again.out
    (row,) = read_json(out / "results.json")["rows"]
    assert row["psnr"] == fitted["psnr"] and all(stage["cached"] for stage in row["stages"])

    assert (out / "results.md").read_text() == again.out


def test_the_networks_alone(tmp_path: Path, capsys: Capsys) -> None:
    make_room(tmp_path / "room", 10)
    few = ["--variants", "direct", "--threads", "1", "--set", "network.voxels=12", "--set", "keyframes.most=5"]
    answer = bench(capsys, "suites", "posed", tmp_path / "room", "--out", tmp_path / "out", *few, "--quiet")
    assert answer.code == 0, answer.err
    (row,) = read_json(tmp_path / "out" / "results.json")["rows"]
    assert row["psnr"] > 5 and row["voxels"] > 0 and row["fit_seconds"] > 0 and [stage["name"] for stage in row["stages"]][-1] == "direct"


def test_what_is_not_there_is_refused(tmp_path: Path, capsys: Capsys) -> None:
    for arguments, words in (
        (["dtu", tmp_path], "holds no scene of DTU"),
        (["llff", tmp_path, "--variants", "direct"], "known are fitted"),
        (["imagenet", tmp_path], "there is no benchmark"),
    ):
        answer = bench(capsys, "suites", *arguments, "--out", tmp_path / "out")
        assert answer.code == 2 and words in answer.sentence()
