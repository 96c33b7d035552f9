"""The main job on a small made-up room: all parts together, kept short by small pictures and a few seconds of fitting."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from fieldfuse.files import read_json
from tests.pipelines.made import HALF, call
from tests.pipelines.short import SMALL, report, stages

Capsys = pytest.CaptureFixture[str]
PARTS = {
    "capture": {"kind", "frames", "width", "height"},
    "poses": {"source", "registered", "total", "models"},
    "field": {"voxel_size", "blocks", "voxels", "bytes"},
}
SCORES = {"views", "psnr", "ssim", "lpips", "depth_abs_err", "seconds_per_view"}


def test_report_has_the_keys_that_others_rely_on(done: Path) -> None:
    data = report(done)
    for part, keys in PARTS.items():
        assert keys <= set(data[part]), part
        assert all(data[part][key] is not None for key in keys), part
    for method in ("field", "tsdf"):
        assert set(data["evaluation"][method]) >= SCORES
        for key in SCORES - {"lpips"}:
            assert data["evaluation"][method][key] is not None, (method, key)
        assert data["evaluation"][method]["views"] == 2
    assert all({"name", "seconds", "peak_memory_mb", "cached"} <= set(stage) for stage in data["stages"])
    assert set(stages(data)) >= {"capture", "poses", "scene", "keyframes", "views", "tsdf", "field", "render", "export", "evaluate"}
    assert data["timeline"] and all({"seconds", "psnr"} <= set(point) for point in data["timeline"])
    assert data["timeline"][-1]["seconds"] <= 3 * 1.05 + 2
    assert abs(data["timeline"][-1]["psnr"] - data["evaluation"]["field"]["psnr"]) < 0.5  # the curve ends where the table stands
    assert data["seconds_total"] > sum(stage["seconds"] for stage in data["stages"]) * 0.9
    assert data["version"] and data["command"].startswith("fieldfuse run ") and "--budget 3" in data["command"]
    assert data["capture"]["frames"] == 16 and (data["capture"]["width"], data["capture"]["height"]) == (96, 72)
    assert data["poses"] == data["poses"] | {"source": "given", "registered": 16, "total": 16}


def test_the_results_are_worth_something(done: Path) -> None:
    data = report(done)["evaluation"]
    assert data["field"]["psnr"] > data["nearest_image"]["psnr"] + 2
    assert data["tsdf"]["psnr"] > data["nearest_image"]["psnr"]


def test_surface_lies_on_the_walls_in_the_input_frame(done: Path) -> None:
    mesh = trimesh.load(done / "tsdf" / "mesh.ply")
    off = np.abs(np.abs(mesh.vertices) - HALF).min(axis=1)
    assert len(mesh.faces) > 100
    assert np.median(off) < 0.02


def test_the_tsdf_surface_has_a_texture_too(done: Path) -> None:
    vertices = trimesh.load(done / "tsdf" / "textured.glb").to_geometry().vertices
    assert np.median(np.abs(np.abs(vertices) - HALF).min(axis=1)) < 0.02
    assert "tsdf/textured.glb" in [entry["path"] for entry in report(done)["exports"]]


def test_exports_are_there_and_open(done: Path) -> None:
    for name in ("points.ply", "mesh.ply", "mesh.obj", "mesh.glb", "textured.glb"):
        loaded = trimesh.load(done / "exports" / name)
        points = loaded.to_geometry().vertices if isinstance(loaded, trimesh.Scene) else loaded.vertices
        assert len(points) > 50, name
        assert np.abs(points).max() < 4, name  # metres of the input, not working units
    assert "16 pictures" in (done / "exports" / "field.html").read_text(encoding="utf-8")
    cameras = read_json(done / "exports" / "cameras" / "transforms.json")
    assert len(cameras["frames"]) == 16
    assert (done / "exports" / "cameras" / "colmap" / "cameras.txt").is_file()
    film = cv2.VideoCapture(str(done / "exports" / "orbit.mp4"))
    assert int(film.get(cv2.CAP_PROP_FRAME_COUNT)) == 4
    assert "<html" in (done / "report.html").read_text().lower()
    assert (done / "mesh.ply").is_file() and len(list((done / "renders").glob("field_*.png"))) == 4


def test_the_same_command_again_reuses_everything(done: Path, capsys: Capsys) -> None:
    before = report(done)
    answer = call(capsys, "run", done.parent / "room", "--out", done, *SMALL, "--quiet", "--json")
    assert answer.code == 0, answer.err
    data = json.loads(answer.out)
    assert all(stages(data).values()), stages(data)
    assert data["evaluation"] == before["evaluation"]
    assert data["seconds_total"] == pytest.approx(before["seconds_total"], rel=0.5, abs=8)


def test_info_on_source_and_run(done: Path, capsys: Capsys) -> None:
    answer = call(capsys, "info", done.parent / "room", "--json")
    data = json.loads(answer.out)
    assert (data["kind"], data["frames"], data["depth"]) == ("transforms", 16, 16)
    assert data["intrinsics"][0]["fx"] == 82.5
    text = call(capsys, "info", done.parent / "room", "--fast").out
    assert "transforms" in text and "fx 82.5" in text
    answer = call(capsys, "info", done, "--json")
    told = json.loads(answer.out)
    assert [stage["name"] for stage in told["stages"]][:2] == ["capture", "poses"]
    assert told["scores"]["field"]["psnr"] == report(done)["evaluation"]["field"]["psnr"] and told["report"] == str(done / "report.html")
    text = call(capsys, "info", done).out
    assert "field: views 2, PSNR" in text and "capture" in text and text.count("stages") == 1
