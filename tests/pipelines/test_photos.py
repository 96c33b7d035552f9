"""Captures without poses through the command line: poses found, or the reason why not."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import psutil
import pytest
from PIL import Image

from fieldfuse.capture.types import Capture, Frame
from fieldfuse.pipelines.prepare import in_folder
from tests.pipelines.made import CAMERA, call, circle, command, environment, look_at, make_photos, shoot
from tests.pipelines.short import HUNG, stages

Capsys = pytest.CaptureFixture[str]
PHOTO = CAMERA.scaled(288, 216)
SHORT = ["--budget", "0.5", "--threads", "1", "--image-size", "96", "--init", "classical", "--set", "export.formats=[cameras]", "--quiet"]


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Nine bare photos that poses are found for, only read."""
    return make_photos(tmp_path_factory.mktemp("bare") / "photos", circle(9, 0.2), PHOTO)


def as_json(text: str) -> dict[str, Any]:
    data = json.loads(text)
    assert isinstance(data, dict)
    return data


def test_photos_get_poses_and_the_report_says_what_the_poses_have_seen(photos: Path, tmp_path: Path, capsys: Capsys) -> None:
    answer = call(capsys, "run", photos, "--out", tmp_path / "out", *SHORT, "--json")
    assert answer.code == 0, answer.err
    data = as_json(answer.out)
    assert data["capture"]["kind"] == "photos" and data["poses"]["source"] == "sfm"
    assert data["poses"]["registered"] >= 8 and data["poses"]["total"] == 9
    assert any("held-out ones included" in warning for warning in data["warnings"])
    assert (tmp_path / "out" / "exports" / "cameras" / "colmap").is_dir()
    again = as_json(call(capsys, "poses", tmp_path / "out", "--quiet", "--json").out)
    assert stages(again)["poses"]


def test_video_is_cut_into_frames(tmp_path: Path, capsys: Capsys) -> None:
    path = tmp_path / "film.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 10, (PHOTO.width, PHOTO.height))
    for pose in circle(16, 0.2):
        writer.write(cv2.cvtColor(shoot(pose, PHOTO)[0], cv2.COLOR_RGB2BGR))
    writer.release()
    (tmp_path / "link").symlink_to(tmp_path)
    place = tmp_path / "elsewhere" / ".." / "link" / "out"  # the same folder as below, by a way that people take
    (tmp_path / "elsewhere").mkdir()
    options = ["--set", "capture.max_frames=8", "--threads", 1, "--quiet", "--json"]
    answer = call(capsys, "poses", path, "--out", place, *options)
    assert answer.code == 0, answer.err
    data = as_json(answer.out)
    assert data["capture"]["kind"] == "video" and 5 <= data["capture"]["frames"] <= 8
    assert (data["capture"]["width"], data["capture"]["height"]) == (288, 216)
    frames = sorted((tmp_path / "out" / "frames").glob("*.jpg"))
    assert len(frames) == data["capture"]["frames"]
    frames[2].unlink()
    again = as_json(call(capsys, "poses", path, "--out", tmp_path / "out", *options).out)
    assert stages(again) == {"capture": True, "frames": False, "poses": False}
    assert frames[2].is_file()


def test_the_frames_of_a_run_folder_that_was_moved_are_its_own(tmp_path: Path) -> None:
    """They were looked for where they had been written, and not found, whatever command was given."""
    before, now = tmp_path / "before" / "frames", tmp_path / "now" / "frames"
    now.mkdir(parents=True)
    (now / "a.jpg").touch()
    kept = [tmp_path / "photos" / "a.jpg", tmp_path / "frames" / "b.jpg"]  # photos that needed no writing
    frames = [Frame(str(index), path) for index, path in enumerate([before / "a.jpg", *kept])]
    deep = [replace(frames[0], depth=before / "depth" / "a.png"), replace(frames[0], depth=tmp_path / "depth" / "a.png")]
    got = in_folder(Capture("photos", tmp_path, (*frames, *deep)), now)
    assert [frame.image for frame in got.frames] == [now / "a.jpg", *kept, now / "a.jpg", now / "a.jpg"]
    assert [frame.depth for frame in got.frames[3:]] == [now / "depth" / "a.png", deep[1].depth]


def test_heic_photos_become_jpegs_that_the_cameras_name(photos: Path, tmp_path: Path, capsys: Capsys) -> None:
    pillow_heif = pytest.importorskip("pillow_heif", reason="pillow-heif is not installed; make test brings it")
    pillow_heif.register_heif_opener()
    source = Path(shutil.copytree(photos, tmp_path / "photos"))
    for path in sorted(source.glob("*.*"))[:2]:
        Image.open(path).save(path.with_suffix(".HEIC"), format="HEIF", quality=90)
        path.unlink()
    out = tmp_path / "out"
    answer = call(capsys, "poses", source, "--out", out, "--threads", 1, "--quiet", "--json")
    assert answer.code == 0, answer.err
    data = as_json(answer.out)
    assert data["capture"]["kind"] == "photos" and data["capture"]["extra"]["converted"] == 2 and data["poses"]["registered"] >= 8
    named = json.loads((out / "exports" / "cameras" / "transforms.json").read_text())["frames"][0]["file_path"]
    assert named.endswith(".jpg") and (out / named).is_file()
    (out / named).unlink()
    again = as_json(call(capsys, "poses", source, "--out", out, "--threads", 1, "--quiet", "--json").out)
    assert stages(again) == {"capture": True, "frames": False, "poses": False}
    assert (out / named).is_file()


def test_camera_raw_that_nothing_reads_is_named(tmp_path: Path, capsys: Capsys) -> None:
    for index in range(3):
        (tmp_path / f"IMG_{index}.DNG").write_bytes(b"II*\0")
    answer = call(capsys, "info", tmp_path)
    assert answer.code == 2 and "IMG_0.DNG is damaged, or of a camera that LibRaw" in answer.sentence() and "JPEG" in answer.sentence()


def test_turning_on_the_spot_is_named(tmp_path: Path, capsys: Capsys) -> None:
    eye = np.array([0.3, 0.0, 0.0])
    poses = [look_at(eye, eye + np.array([np.cos(angle), 0.1 * np.sin(5 * angle), np.sin(angle)])) for angle in np.linspace(0, 1.2, 10)]
    source = make_photos(tmp_path / "photos", poses, PHOTO.scaled(480, 360))
    answer = call(capsys, "run", source, "--out", tmp_path / "out", *SHORT)
    assert answer.code == 2
    sentence = answer.sentence()
    assert "turn" in sentence or "rotat" in sentence, sentence


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_the_child_that_finds_poses_does_not_outlive_us(number: int, photos: Path, tmp_path: Path) -> None:
    process = subprocess.Popen(command("poses", photos, "--out", tmp_path / "out"), stderr=subprocess.PIPE, text=True, env=environment())
    end = time.monotonic() + HUNG
    children: list[psutil.Process] = []
    while not children and time.monotonic() < end and process.poll() is None:
        children = psutil.Process(process.pid).children(recursive=True)
        time.sleep(0.02)
    assert children, process.communicate()[1]
    process.send_signal(number)
    _, err = process.communicate(timeout=HUNG)
    assert process.returncode == (-signal.SIGKILL if number == signal.SIGKILL else 130), err
    _, alive = psutil.wait_procs(children, timeout=60)
    assert not alive
    assert not (tmp_path / "out" / "stages" / "poses.json").exists()
