"""Replica's renderings for iMAP and NICE-SLAM: where the camera is given, which line belongs to which image, unusable files."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest

from fieldfuse.capture import open_capture
from fieldfuse.capture.images import load_depth
from fieldfuse.errors import InputError
from fieldfuse.pipelines.source import source_state
from tests.capture.layouts import OFF_CENTRE, write_replica
from tests.capture.made import eyes, pixel_error, render, save_depth, save_picture


def test_flags_and_depth(tmp_path: Path) -> None:
    write_replica(tmp_path)
    capture = open_capture(tmp_path)
    assert (capture.metric, capture.ordered, capture.up, capture.depth_scale) == (True, True, (0, 0, 1), 6553.5)
    assert [frame.name for frame in capture.frames] == [f"frame{index:06d}" for index in range(5)]
    for frame, eye in zip(capture.frames, eyes(), strict=True):
        true = render(eye, OFF_CENTRE)[1]
        np.testing.assert_allclose(load_depth(frame, capture), np.where(true < 9.99, true, 0), atol=1e-4)


def test_the_camera_lies_above_the_scenes(tmp_path: Path) -> None:
    scene = tmp_path / "office0"
    write_replica(scene)
    (scene / "cam_params.json").rename(tmp_path / "cam_params.json")
    assert pixel_error(open_capture(scene), eyes(), OFF_CENTRE) < 1e-3
    before = source_state(scene, tmp_path / "run")
    assert source_state(scene, tmp_path / "run") == before
    os.utime(tmp_path / "cam_params.json", (1, 1))  # corrected: what was read of it before counts no longer
    assert source_state(scene, tmp_path / "run") != before


def test_without_a_camera_only_pictures_of_the_published_size_are_read(tmp_path: Path) -> None:
    write_replica(tmp_path)
    (tmp_path / "cam_params.json").unlink()
    with pytest.raises(InputError, match=r"has no cam_params\.json, and its images \(80×60\).* put one there: .*\"fx\""):
        open_capture(tmp_path)
    for index in range(5):
        save_picture(tmp_path / f"results/frame{index:06d}.jpg", np.full((680, 1200, 3), 99, np.uint8))
        save_depth(tmp_path / f"results/depth{index:06d}.png", np.ones((680, 1200)), 6553.5)
    capture = open_capture(tmp_path)
    camera = capture.frames[0].intrinsics
    assert (camera.fx, camera.fy, camera.cx, camera.cy, capture.depth_scale) == (600, 600, 600, 340, 6553.5)
    assert capture.warnings == ("no cam_params.json was found; the camera that the published renderings of Replica share is used",)


def test_pictures_that_were_taken_away_take_no_other_pose(tmp_path: Path) -> None:
    write_replica(tmp_path)
    for index in (0, 2):
        (tmp_path / f"results/frame{index:06d}.jpg").unlink()
    (tmp_path / "results/depth000003.png").unlink()
    capture = open_capture(tmp_path)
    assert pixel_error(capture, [eyes()[index] for index in (1, 3, 4)], OFF_CENTRE) < 1e-3
    assert [frame.depth and frame.depth.stem for frame in capture.frames] == ["depth000001", None, "depth000004"]
    lines = (tmp_path / "traj.txt").read_text().splitlines()
    (tmp_path / "traj.txt").write_text("\n".join(lines[index] for index in (1, 3, 4)))  # and of the poses as well
    assert pixel_error(open_capture(tmp_path), [eyes()[index] for index in (1, 3, 4)], OFF_CENTRE) < 1e-3
    (tmp_path / "traj.txt").write_text("\n".join(lines[:2]))
    with pytest.raises(InputError, match="3 images but 2 poses"):
        open_capture(tmp_path)
    (tmp_path / "traj.txt").write_text("\n".join(lines[:4]))  # of four lines none is that of frame 4
    with pytest.raises(InputError, match="3 images but 4 poses"):
        open_capture(tmp_path)


@pytest.mark.parametrize(
    ("text", "said"),
    [("", "whole poses"), ("1 0 0 0\n", "whole poses"), ("x", "numbers only"), ("nan " * 80, r"traj\.txt, pose 1: the pose holds")],
)
def test_broken_poses(tmp_path: Path, text: str, said: str) -> None:
    write_replica(tmp_path)
    (tmp_path / "traj.txt").write_text(text)
    with pytest.raises(InputError, match=said):
        open_capture(tmp_path)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"fx": None}, "has no 'fx'"),
        ({"fx": "a"}, "'fx' must be a finite number"),
        ({"fx": -1}, "must be positive"),
        ({"cx": 599.5}, "outside the 80×60 picture"),
        ({"scale": 0}, "a 'scale' of 0"),
        ({"h": 90}, "another shape"),
        ({"w": 0}, "image size 0×60"),
    ],
)
def test_broken_cameras(tmp_path: Path, change: dict, said: str) -> None:
    write_replica(tmp_path)
    path = tmp_path / "cam_params.json"
    camera = json.loads(path.read_text())["camera"] | change
    path.write_text(json.dumps({"camera": {key: value for key, value in camera.items() if value is not None}}))
    with pytest.raises(InputError, match=said):
        open_capture(tmp_path)
    path.write_text("{}")
    with pytest.raises(InputError, match="'camera' must be an object with w, h, fx"):
        open_capture(tmp_path)
