"""The main job on a small made-up room: all parts together, kept short by small pictures and a few seconds of fitting."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh

from tests.pipelines.made import HALF, Answer, call, command, environment, make_room, spawn
from toolkit.errors import InputError
from toolkit.files import read_json

Capsys = pytest.CaptureFixture[str]
SMALL = [
    "--budget",
    "5",
    "--threads",
    "1",
    "--init",
    "classical",
    "--set",
    "field.resolution=32",
    "--set",
    "export.mesh_views=6",
    "--set",
    "export.video_frames=4",
]
FAST = [
    "--budget",
    "2",
    "--threads",
    "1",
    "--init",
    "classical",
    "--set",
    "field.resolution=16",
    "--set",
    "export.formats=[points]",
    "--set",
    "export.mesh_views=3",
]
PARTS = {
    "capture": {"kind", "frames", "width", "height"},
    "poses": {"source", "registered", "total", "models"},
    "field": {"voxel_size", "blocks", "voxels", "bytes"},
}
SCORES = {"views", "psnr", "ssim", "lpips", "depth_abs_err", "seconds_per_view"}


def report(folder: Path) -> dict[str, Any]:
    data = read_json(folder / "report.json")
    assert isinstance(data, dict)
    return data


def stages(data: dict[str, Any]) -> dict[str, bool]:
    return {stage["name"]: stage["cached"] for stage in data["stages"]}


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run on the room with depth, made once for all tests of this file that only read it."""
    root = tmp_path_factory.mktemp("room")
    make_room(root / "room", 16, depth=True)
    answer = spawn("run", root / "room", "--out", root / "out", *SMALL)
    assert answer.returncode == 0, answer.stderr
    assert "PSNR" in answer.stdout and "report.html" in answer.stdout
    assert "field: " in answer.stderr and "Traceback" not in answer.stderr
    return root / "out"


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
    assert data["timeline"][-1]["seconds"] <= 5 * 1.05 + 2
    assert data["seconds_total"] > sum(stage["seconds"] for stage in data["stages"]) * 0.9
    assert data["version"] and data["command"].startswith("fieldfuse run ") and "--budget 5" in data["command"]
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


def test_exports_are_there_and_open(done: Path) -> None:
    for name in ("points.ply", "mesh.ply", "mesh.obj", "mesh.glb"):
        loaded = trimesh.load(done / "exports" / name)
        points = loaded.to_geometry().vertices if isinstance(loaded, trimesh.Scene) else loaded.vertices
        assert len(points) > 50, name
        assert np.abs(points).max() < 4, name  # metres of the input, not working units
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
    assert data["seconds_total"] == pytest.approx(before["seconds_total"], abs=8)


def test_render_paths(done: Path, tmp_path: Path, capsys: Capsys) -> None:
    answer = call(capsys, "render", done, "--frames", 3, "--to", tmp_path / "o.mp4", "--image-size", 32, "--quiet")
    assert answer.code == 0, answer.err
    film = cv2.VideoCapture(str(tmp_path / "o.mp4"))
    assert (film.get(cv2.CAP_PROP_FRAME_COUNT), film.get(cv2.CAP_PROP_FRAME_WIDTH)) == (3, 32)
    answer = call(capsys, "render", done, "--views", "test", "--to", tmp_path / "test", "--json", "--quiet")
    assert answer.code == 0 and json.loads(answer.out)["pictures"] == 2
    kept = sorted((done / "renders").glob("field_*[0-9].png"))
    for path, before in zip(sorted((tmp_path / "test").iterdir()), kept, strict=True):
        assert np.abs(cv2.imread(str(path)).astype(int) - cv2.imread(str(before))).max() <= 1
    cameras = done / "exports" / "cameras" / "transforms.json"
    answer = call(capsys, "render", done, "--cameras", cameras, "--to", tmp_path / "given", "--image-size", 24, "--quiet")
    assert answer.code == 0, answer.err
    assert len(list((tmp_path / "given").iterdir())) == 16


def test_the_baked_field_is_made_once_and_looks_like_the_field(done: Path, tmp_path: Path, capsys: Capsys) -> None:
    assert call(capsys, "render", done, "--views", "test", "--to", tmp_path / "exact", "--quiet").code == 0
    made = []
    for folder in ("first", "second", "third"):
        if folder == "third":
            os.utime(done / "field.safetensors")  # a field that is newer than its baked copy is baked again
        answer = call(capsys, "render", done, "--views", "test", "--baked", "--to", tmp_path / folder, "--quiet")
        assert answer.code == 0, answer.err
        made.append((done / "exports" / "baked.safetensors").stat().st_mtime_ns)
    assert made[0] == made[1] < made[2]
    for path in sorted((tmp_path / "exact").iterdir()):
        exact, first, second = (cv2.imread(str(tmp_path / folder / path.name)) / 255 for folder in ("exact", "first", "second"))
        assert np.array_equal(first, second)
        assert -10 * np.log10(np.mean((exact - first) ** 2) + 1e-12) > 30


def test_render_refuses_what_it_cannot_do(done: Path, tmp_path: Path, capsys: Capsys) -> None:
    assert "orbit or test" in call(capsys, "render", done, "--views", "train").sentence()
    assert ".mp4" in call(capsys, "render", done, "--to", tmp_path / "x.gif").sentence()


def test_info_on_source_and_run(done: Path, capsys: Capsys) -> None:
    answer = call(capsys, "info", done.parent / "room", "--json")
    data = json.loads(answer.out)
    assert (data["kind"], data["frames"], data["depth"]) == ("transforms", 16, 16)
    assert data["intrinsics"][0]["fx"] == 82.5
    text = call(capsys, "info", done.parent / "room", "--fast").out
    assert "transforms" in text and "fx 82.5" in text
    answer = call(capsys, "info", done, "--json")
    assert [stage["name"] for stage in json.loads(answer.out)["stages"]][:2] == ["capture", "poses"]


def test_a_changed_picture_is_noticed(tmp_path: Path, capsys: Capsys) -> None:
    make_room(tmp_path / "room", 6)
    arguments = ["poses", tmp_path / "room", "--out", tmp_path / "room" / "out", "--quiet", "--json"]
    assert call(capsys, *arguments).code == 0
    assert all(stages(json.loads(call(capsys, *arguments).out)).values())  # its own folder inside the source changes nothing
    picture = tmp_path / "room" / "images" / "002.png"
    cv2.imwrite(str(picture), cv2.imread(str(picture))[::-1])
    assert not any(stages(json.loads(call(capsys, *arguments).out)).values())


def test_doctor_as_json(capsys: Capsys) -> None:
    answer = call(capsys, "doctor", "--json")
    checks = json.loads(answer.out)
    assert {"python", "torch", "pycolmap"} <= {check["name"] for check in checks}
    assert answer.code == int(any(check["status"] == "fail" for check in checks))


def test_poses_alone(tmp_path: Path, capsys: Capsys) -> None:
    make_room(tmp_path / "room", 6)
    answer = call(capsys, "poses", tmp_path / "room", "--out", tmp_path / "out", "--quiet", "--json")
    assert answer.code == 0, answer.err
    assert json.loads(answer.out)["poses"]["registered"] == 6
    assert len(read_json(tmp_path / "out" / "exports" / "cameras" / "transforms.json")["frames"]) == 6
    assert not (tmp_path / "out" / "views.safetensors").exists()


def test_tsdf_alone_then_the_rest_in_the_same_folder(tmp_path: Path, capsys: Capsys) -> None:
    make_room(tmp_path / "room", 10, depth=True)
    out = tmp_path / "out"
    answer = call(capsys, "tsdf", tmp_path / "room", "--out", out, "--quiet", "--json")
    assert answer.code == 0, answer.err
    data = json.loads(answer.out)
    assert data["evaluation"]["tsdf"]["psnr"] > 10 and data["evaluation"]["field"] is None
    answer = call(
        capsys,
        "finetune",
        out,
        "--budget",
        4,
        "--threads",
        1,
        "--set",
        "field.resolution=32",
        "--set",
        "export.formats=[points]",
        "--quiet",
        "--json",
    )
    assert answer.code == 0, answer.err
    both = json.loads(answer.out)
    assert both["evaluation"]["tsdf"] == data["evaluation"]["tsdf"] and both["evaluation"]["field"]["psnr"] > 10
    assert stages(both)["tsdf"] and not stages(both)["field"]
    answer = call(capsys, "export", out, "--formats", "ply", "--quiet", "--json")
    assert answer.code == 0, answer.err
    assert (
        stages(json.loads(answer.out))["field"]
        and (out / "exports" / "mesh.ply").is_file()
        and not (out / "exports" / "points.ply").exists()
    )


def test_a_changed_budget_redoes_the_field_and_what_follows(tmp_path: Path, capsys: Capsys) -> None:
    make_room(tmp_path / "room", 10)
    assert call(capsys, "run", tmp_path / "room", "--out", tmp_path / "out", *FAST, "--quiet").code == 0
    answer = call(capsys, "run", tmp_path / "room", "--out", tmp_path / "out", *FAST, "--budget", 0.1, "--quiet", "--json")
    assert answer.code == 0, answer.err
    cached = stages(json.loads(answer.out))
    assert {name for name, reused in cached.items() if not reused} == {"field", "render", "export", "evaluate"}


def test_a_field_without_surface_is_exported_as_far_as_it_goes(tmp_path: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    def nothing_opaque(*_: object, **__: object) -> None:
        raise InputError("no rendered view shows a surface")

    monkeypatch.setattr("toolkit.export.surface.field_volume", nothing_opaque)
    make_room(tmp_path / "room", 10)
    out = tmp_path / "out"
    answer = call(capsys, "run", tmp_path / "room", "--out", out, *FAST, "--set", "export.formats=[ply,cameras]", "--quiet", "--json")
    assert answer.code == 0, answer.err
    assert any("meshes were left out" in warning for warning in json.loads(answer.out)["warnings"])
    assert (out / "exports" / "cameras" / "transforms.json").is_file() and not (out / "exports" / "mesh.ply").exists()


def test_without_held_out_pictures_there_are_no_scores(tmp_path: Path, capsys: Capsys) -> None:
    make_room(tmp_path / "room", 10)
    answer = call(capsys, "run", tmp_path / "room", "--out", tmp_path / "out", *FAST, "--holdout", 0, "--quiet", "--json")
    assert answer.code == 0, answer.err
    data = json.loads(answer.out)
    assert data["evaluation"]["field"]["psnr"] is None and data["timeline"] == []
    assert any("no picture was held out" in warning for warning in data["warnings"])
    assert "no held-out views" in call(capsys, "render", tmp_path / "out", "--views", "test", "--quiet").sentence()


def test_a_tampered_field_is_refused(tmp_path: Path, capsys: Capsys) -> None:
    make_room(tmp_path / "room", 10)
    out = tmp_path / "out"
    assert call(capsys, "run", tmp_path / "room", "--out", out, *FAST, "--quiet").code == 0
    path = out / "field.safetensors"
    whole = path.read_bytes()
    for spoilt in (whole[:8] + b"{" * 40 + whole[48:], (2**62).to_bytes(8, "little") + whole[8:], bytes(len(whole))):
        path.write_bytes(spoilt)
        for arguments in (["render", out], ["evaluate", out], ["export", out]):
            answer = call(capsys, *arguments, "--quiet")
            assert answer.code == 2, answer
            assert "field.safetensors" in answer.sentence()


def start(*arguments: object) -> subprocess.Popen[str]:
    return subprocess.Popen(command(*arguments), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment())


def wait_for(path: Path, process: subprocess.Popen[str], seconds: float = 60) -> None:
    end = time.monotonic() + seconds
    while not path.exists():
        assert process.poll() is None, process.communicate()[1]
        assert time.monotonic() < end, f"{path} never came"
        time.sleep(0.02)


def test_killed_at_several_moments_the_run_goes_on(done: Path, tmp_path: Path) -> None:
    """Killed right after the capture, while the field is fitted, and after it; then left alone."""
    arguments = ["run", done.parent / "room", "--out", tmp_path / "out", *SMALL]
    for stage, delay in (("capture", 0.0), ("views", 1.0), ("field", 0.05)):
        process = start(*arguments)
        wait_for(tmp_path / "out" / "stages" / f"{stage}.json", process)
        time.sleep(delay)
        process.kill()
        process.communicate()
    answer = spawn(*arguments)
    assert answer.returncode == 0, answer.stderr
    data = report(tmp_path / "out")
    cached = stages(data)
    assert cached["capture"] and cached["views"] and cached["field"]
    # The surface repeats; how far a field gets in a few seconds depends on what else the machine does.
    for method, noise in (("tsdf", 0.1), ("field", 3.0)):
        assert data["evaluation"][method]["psnr"] == pytest.approx(report(done)["evaluation"][method]["psnr"], abs=noise)
    assert not list((tmp_path / "out").rglob(".tmp-*"))


def test_ctrl_c_while_fitting_keeps_the_field_and_reports(tmp_path: Path) -> None:
    make_room(tmp_path / "room", 10)
    process = start("run", tmp_path / "room", "--out", tmp_path / "out", *FAST, "--budget", "60")
    wait_for(tmp_path / "out" / "stages" / "views.json", process)
    time.sleep(3)
    began = time.monotonic()
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    assert time.monotonic() - began < 30
    data = report(tmp_path / "out")
    assert any("stopped early" in warning for warning in data["warnings"])
    assert data["evaluation"]["field"]["views"] == 2
    assert "Traceback" not in err
    assert not (tmp_path / "out" / "exports").exists()  # nobody waits for a video after Ctrl-C
    answer = spawn("run", tmp_path / "room", "--out", tmp_path / "out", *FAST)
    assert answer.returncode == 0, answer.stderr
    again = report(tmp_path / "out")
    assert not any("stopped early" in warning for warning in again["warnings"]) and not stages(again)["field"] and stages(again)["views"]


def test_ctrl_c_before_the_field_says_how_to_go_on(tmp_path: Path) -> None:
    make_room(tmp_path / "room", 60, depth=True)
    process = start("run", tmp_path / "room", "--out", tmp_path / "out", *FAST)
    wait_for(tmp_path / "out" / "run.json", process)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert "same command again" in Answer(130, out, err).sentence()


def test_ctrl_c_twice_ends_at_once(tmp_path: Path) -> None:
    make_room(tmp_path / "room", 10)
    process = start("run", tmp_path / "room", "--out", tmp_path / "out", *FAST, "--budget", "60")
    wait_for(tmp_path / "out" / "stages" / "views.json", process)
    time.sleep(1)
    for _ in range(2):
        process.send_signal(signal.SIGINT)
        time.sleep(0.05)
    _, err = process.communicate(timeout=20)
    assert process.returncode == 130
    # A fit ends within a step, so its stage may be whole by the time of the second signal; nothing after it is.
    assert "Traceback" not in err and not (tmp_path / "out" / "report.json").exists()


def test_two_runs_in_one_folder(tmp_path: Path, capsys: Capsys) -> None:
    make_room(tmp_path / "room", 10)
    arguments = ["run", tmp_path / "room", "--out", tmp_path / "out", *FAST, "--budget", "30"]
    process = start(*arguments)
    wait_for(tmp_path / "out" / "stages" / "capture.json", process)
    answer = call(capsys, *arguments)
    process.kill()
    process.communicate()
    assert answer.code == 2
    assert "another fieldfuse command" in answer.sentence()


def test_help_is_quick() -> None:
    answer = spawn("--help")
    start_time = time.monotonic()
    answer = spawn("run", "--help")
    assert answer.returncode == 0 and "--budget" in answer.stdout
    assert time.monotonic() - start_time < 2 * max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))


def test_heavy_libraries_are_not_loaded_for_help() -> None:
    heavy = {"torch", "open3d", "cv2", "numpy", "pycolmap", "trimesh"}
    program = f"import sys, pipelines.cli; print(sorted({heavy} & set(sys.modules)))"
    answer = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=environment())
    assert answer.stdout.strip() == "[]", answer.stdout + answer.stderr


def test_unexpected_errors_leave_a_log_and_no_traceback(tmp_path: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    make_room(tmp_path / "room", 6)

    def fail(*_: object) -> None:
        raise RuntimeError("a bolt is loose")

    monkeypatch.setattr("toolkit.poses.given.given_poses", fail)
    answer = call(capsys, "run", tmp_path / "room", "--out", tmp_path / "out", "--quiet")
    assert answer.code == 1
    assert "error.log" in answer.sentence() and "RuntimeError" in answer.sentence()
    assert "a bolt is loose" in (tmp_path / "out" / "error.log").read_text()
