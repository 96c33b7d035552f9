"""Recordings of phones with a depth sensor through the command line: a surface that lies where the truth is."""

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
from tests.capture.layouts import write_record3d, zipped
from tests.capture.made import BALL, RADIUS
from tests.pipelines.made import call

pytest.importorskip("imagecodecs", reason="imagecodecs is not installed; make test brings it")

VOXEL = 0.06  # metres


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    write_record3d(tmp_path / "unpacked")
    return zipped(tmp_path / "unpacked", tmp_path / "walk.r3d")


def test_a_recording_becomes_its_surface(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
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
