"""Recordings through the command line: surfaces of Record3D lie where the truth is; frames of a `.sens` file are the run's own."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from fieldfuse.capture import open_capture
from fieldfuse.capture.images import load_depth
from fieldfuse.capture.select import select_frames
from fieldfuse.config import CaptureSettings
from fieldfuse.pipelines.prepare import in_folder
from tests.capture.layouts import write_record3d, write_sens, zipped
from tests.capture.made import BALL, RADIUS
from tests.pipelines.made import call
from tests.pipelines.short import stages

Capsys = pytest.CaptureFixture[str]
VOXEL = 0.06  # metres


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    pytest.importorskip("imagecodecs", reason="imagecodecs is not installed; make test brings it")
    write_record3d(tmp_path / "unpacked")
    return zipped(tmp_path / "unpacked", tmp_path / "walk.r3d")


def test_a_recording_becomes_its_surface(recording: Path, tmp_path: Path, capsys: Capsys) -> None:
    options = ["--image-size", 96, "--threads", 1, "--voxel-size", VOXEL, "--set", "export.formats=[ply]", "--quiet", "--json"]
    answer = call(capsys, "tsdf", recording, "--out", tmp_path / "out", *options)
    assert answer.code == 0, answer.err
    capture = json.loads(answer.out)["capture"]
    assert (capture["kind"], capture["posed"], capture["metric"]) == ("record3d", True, True)
    points = np.asarray(trimesh.load(tmp_path / "out" / "tsdf" / "mesh.ply").vertices)
    points = points[np.linalg.norm(points - BALL, axis=1) < 2]  # farther off a pixel of depth is wide
    off = np.minimum(np.abs(points[:, 2]), np.abs(np.linalg.norm(points - BALL, axis=1) - RADIUS))
    assert len(points) > 1000 and np.median(off) < 0.5 * VOXEL and np.quantile(off, 0.95) < 1.5 * VOXEL


def test_depth_of_a_run_that_was_moved_is_found(recording: Path, tmp_path: Path) -> None:
    chosen = select_frames(open_capture(recording), tmp_path / "run", CaptureSettings())
    (tmp_path / "run").rename(tmp_path / "moved")
    capture = in_folder(chosen, tmp_path / "moved" / "frames")
    for frame in capture.frames:
        assert load_depth(frame, capture).any() and frame.image.parent == frame.depth.parent.parent == tmp_path / "moved" / "frames"


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
    assert stages(again) == {"capture": True, "frames": False, "poses": False}
    assert depths[1].is_file()
    out.rename(tmp_path / "moved")
    last = json.loads(call(capsys, "poses", source, "--out", tmp_path / "moved", *options).out)
    assert all(stages(last).values())


def test_a_damaged_file_ends_with_one_sentence(tmp_path: Path, capsys: Capsys) -> None:
    write_sens(tmp_path / "scan")
    source = tmp_path / "scan" / "scene0000_00.sens"
    source.write_bytes(source.read_bytes()[:9000])
    answer = call(capsys, "tsdf", source, "--out", tmp_path / "out", "--quiet")
    assert answer.code == 2 and len(answer.err.strip().splitlines()) == 1
    assert str(source) in answer.err and "copy it again" in answer.err
