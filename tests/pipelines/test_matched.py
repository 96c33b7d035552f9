"""Surfaces of captures without depth: pictures are matched with each other first."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from fieldfuse.camera import Intrinsics, opengl_from_world
from fieldfuse.files import read_json
from fieldfuse.pipelines.summary import describe_left_out, describe_matching
from fieldfuse.stereo import transients
from fieldfuse.stereo.transients import LeftOut, load_left_out
from tests.pipelines.made import call, save_picture, write_transforms
from tests.pipelines.short import stages
from tests.poses.textured import arc, render

Capsys = pytest.CaptureFixture[str]
CAMERA = Intrinsics(128, 96, 120.0, 120.0, 64.0, 48.0)
SHORT = ["--set", "init=classical", "--set", "fit.budget=1", "--set", "field.resolution=32"]


def make_corner(folder: Path, count: int = 9, depth: bool = False) -> None:
    """The textured corner as transforms.json with pictures, with its depth in millimetres if wanted."""
    frames: list[dict[str, Any]] = []
    for index, pose in enumerate(arc(count, 44.0)):
        picture, metres = render(pose, CAMERA)
        frame: dict[str, Any] = {"file_path": f"images/{index:03d}.png", "transform_matrix": opengl_from_world(pose).tolist()}
        save_picture(folder / frame["file_path"], picture)
        if depth:
            frame["depth_file_path"] = f"depth/{index:03d}.png"
            (folder / "depth").mkdir(exist_ok=True)
            cv2.imwrite(str(folder / frame["depth_file_path"]), (metres * 1000 + 0.5).astype(np.uint16))
        frames.append(frame)
    about = {"w": CAMERA.width, "h": CAMERA.height, "fl_x": CAMERA.fx, "fl_y": CAMERA.fy, "cx": CAMERA.cx, "cy": CAMERA.cy}
    write_transforms(folder, {**about, "frames": frames})


def test_a_surface_from_pictures_alone(tmp_path: Path, capsys: Capsys) -> None:
    make_corner(tmp_path / "corner")
    out = tmp_path / "out"
    answer = call(capsys, "tsdf", tmp_path / "corner", "--out", out, "--holdout", "4", "--quiet", "--json")
    assert answer.code == 0, answer.err
    data = json.loads(answer.out)
    score = data["evaluation"]["tsdf"]
    assert score["depth_from"] == "matching"
    assert score["psnr_masked"] > 18 and score["coverage"] > 0.6
    assert (out / "tsdf" / "mesh.ply").stat().st_size > 10_000
    before = stages(data)
    assert before["stereo"] is False

    again = json.loads(call(capsys, "tsdf", out, "--quiet", "--json").out)
    assert stages(again) == dict.fromkeys(before, True)
    # Another command keeps the surface in its report.
    kept = json.loads(call(capsys, "evaluate", out, "--quiet", "--json", *SHORT).out)
    assert kept["evaluation"]["tsdf"]["psnr"] == score["psnr"]
    assert kept["evaluation"]["field"]["psnr"] > 8


def test_without_being_asked_pictures_are_matched_for_the_fit_alone(
    tmp_path: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("the pictures were matched again")

    make_corner(tmp_path / "corner", 6)
    out = tmp_path / "out"
    options = ["--holdout", "3", "--quiet", *SHORT]
    options += ["--set", "export.formats=[]"]
    for _ in range(2):  # what was made before is told again
        assert call(capsys, "run", tmp_path / "corner", "--out", out, *options).code == 0
        data = read_json(out / "report.json")
        assert not (out / "stereo").exists() and data["evaluation"]["tsdf"] is None
        assert data["field"]["matched"]["views"] == 4 and 0 < data["field"]["matched"]["share"] < 1
        assert any("Matching 4 training images" in note for note in data["notes"])
    # A fit that goes on does not match them again: what was found before is told.
    before = data["field"]["matched"]
    monkeypatch.setattr("fieldfuse.stereo.fast_mvs.guided", refuse)
    answer = call(capsys, "finetune", out, "--budget", "0.5", "--threads", "1", "--quiet")
    assert answer.code == 0, answer.err
    after = read_json(out / "report.json")
    assert after["field"]["matched"] == before and len(after["timeline"]) > len(data["timeline"])
    monkeypatch.undo()
    assert call(capsys, "run", tmp_path / "corner", "--out", out, *options, "--set", "fit.depth_from=sensor").code == 0
    data = read_json(out / "report.json")
    assert "matched" not in data["field"] and not any("atching" in note for note in data["notes"])
    assert not (out / "fit_matched.json").exists()


def test_what_moves_is_left_out_and_told(tmp_path: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transients, "FEWEST", 6)
    make_corner(tmp_path / "corner", 9)
    for index in (2, 6):
        path = tmp_path / "corner" / f"images/{index:03d}.png"
        picture = cv2.imread(str(path))
        assert picture is not None
        picture[20:80, 10 * index + 10 : 10 * index + 45] = (30, 200, 60)
        cv2.imwrite(str(path), picture)
    out = tmp_path / "out"
    options = ["--holdout", "4", "--quiet", *SHORT]
    options += ["--set", "export.formats=[texture]", "--set", "export.mesh_views=4", "--set", "export.texture_size=512"]
    for _ in range(2):  # what was made before is told again
        assert call(capsys, "run", tmp_path / "corner", "--out", out, *options).code == 0
        data = read_json(out / "report.json")
        told = data["field"]["left_out"]
        assert told["looked_at"] == 6 and told["pictures"] == 2 and 0.02 < told["share"] < 0.12
        assert any("in 2 of 6 images" in note for note in data["notes"])
        page = (out / "report.html").read_text(encoding="utf-8")
        assert "Left out of the fit" in page and page.count("what is left out tinted") == 2
        assert load_left_out(out / "left_out.safetensors").to_dict() == told
    texture = (out / "exports" / "textured.glb").read_bytes()
    answer = call(capsys, "finetune", out, "--budget", "0.3", "--set", "export.formats=[]", "--quiet")  # going on, it leaves the same out
    assert answer.code == 0, answer.err
    assert read_json(out / "report.json")["field"]["left_out"] == told and load_left_out(out / "left_out.safetensors").to_dict() == told
    assert call(capsys, "run", tmp_path / "corner", "--out", out, *options, "--set", "fit.moving=off").code == 0
    assert "left_out" not in read_json(out / "report.json")["field"] and not (out / "left_out.safetensors").exists()
    assert "Left out of the fit" not in (out / "report.html").read_text(encoding="utf-8")
    assert (out / "exports" / "textured.glb").read_bytes() != texture


def test_the_report_tells_that_nothing_moves() -> None:
    nothing = describe_left_out(LeftOut.of(["a"] * 7, [np.zeros((3, 4), bool)] * 7))
    assert "Nothing that moves was found in the 7 training images" in nothing
    some = describe_left_out(LeftOut.of(["a", "b"], [np.eye(4, dtype=bool), np.zeros((4, 4), bool)], 0.5))
    assert "12.5% of" in some and "in 1 of 2 images" in some and "0.5 s" in some


def test_the_report_tells_of_bare_surfaces() -> None:
    """Folders of earlier versions know nothing of them."""
    found = {"views": 4, "pixels": 128, "share": 0.6, "seconds": 1.0}
    words = describe_matching({**found, "bare": 0.25})
    assert "60% of their pixels" in words and "25% without texture" in words
    assert "texture" not in describe_matching(found) and describe_matching(found) == describe_matching({**found, "bare": 0.0})
