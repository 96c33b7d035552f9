"""Bad input through the command line: one sentence that says what, where and what to do; exit code 2; no traceback."""

from __future__ import annotations

import os
import re
import resource
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from fieldfuse.config import load_settings
from fieldfuse.errors import InputError
from fieldfuse.files import write_json
from fieldfuse.pipelines.folder import RunFolder, is_run_folder
from fieldfuse.pipelines.render_path import path_fps, read_cameras
from tests.pipelines.made import CAMERA, Answer, call, circle, make_room, save_picture, shoot, spawn, write_transforms

Capsys = pytest.CaptureFixture[str]


def photos(folder: Path, count: int) -> Path:
    for index, pose in enumerate(circle(12)[:count]):
        save_picture(folder / f"{index:02d}.jpg", shoot(pose)[0])
    return folder


def empty(path: Path) -> Path:
    path.mkdir()
    return path


def one_photo(path: Path) -> Path:
    return photos(path, 1)


def identical_photos(path: Path) -> Path:
    photos(path, 1)
    for index in range(1, 10):
        shutil.copy(path / "00.jpg", path / f"{index:02d}.jpg")
    return path


def black_photos(path: Path) -> Path:
    for index in range(6):
        save_picture(path / f"{index:02d}.jpg", np.zeros((48, 64, 3), np.uint8))
    return path


def truncated_jpeg(path: Path) -> Path:
    photos(path, 6)
    for victim in (path / "03.jpg", path / "04.jpg"):  # a single one is left out
        victim.write_bytes(victim.read_bytes()[:600])
    return path


def not_a_video(path: Path) -> Path:
    path = path.with_suffix(".mp4")
    path.write_bytes(b"these bytes are no film" * 200)
    return path


def no_readable_frame(path: Path) -> Path:
    """The head of a film whose pictures are cut off."""
    whole = path.with_suffix(".avi")
    writer = cv2.VideoWriter(str(whole), cv2.VideoWriter.fourcc(*"MJPG"), 10, (CAMERA.width, CAMERA.height))
    for pose in circle(12):
        writer.write(shoot(pose)[0])
    writer.release()
    data = whole.read_bytes()
    whole.write_bytes(data[: data.index(b"movi") + 8])
    return whole


def no_readable_photo(path: Path) -> Path:
    path.mkdir()
    for index in range(5):
        (path / f"{index}.jpg").write_bytes(b"not a picture")
    return path


def posed(change: Callable[[dict[str, Any]], None], depth: bool = False) -> Callable[[Path], Path]:
    def make(path: Path) -> Path:
        data = make_room(path, 8, depth)
        change(data)
        write_transforms(path, data)
        return path

    return make


def nan_pose(data: dict[str, Any]) -> None:
    for entry in data["frames"][3:6]:  # a single one is left out
        entry["transform_matrix"][0][3] = float("nan")


def singular_pose(data: dict[str, Any]) -> None:
    for entry in data["frames"][3:6]:
        entry["transform_matrix"] = np.zeros((4, 4)).tolist()


def sheared_pose(data: dict[str, Any]) -> None:
    for frame in data["frames"][3:6]:  # more than are left out
        frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ np.diag([1.0, 1.3, 1.0, 1.0])).tolist()


def negative_focal(data: dict[str, Any]) -> None:
    data["fl_x"] = -50.0


def no_focal(data: dict[str, Any]) -> None:
    del data["fl_x"], data["fl_y"]


def outside(data: dict[str, Any]) -> None:
    for entry in data["frames"]:  # a single one counts as missing, and is not read
        entry["file_path"] = "../../../../../../../../etc/passwd"


def more_poses_than_pictures(path: Path) -> Path:
    """LLFF: one row of poses a picture."""
    for index, pose in enumerate(circle(6)):
        save_picture(path / "images" / f"{index:02d}.png", shoot(pose)[0])
    np.save(path / "poses_bounds.npy", np.random.default_rng(0).normal(size=(7, 17)))
    return path


def deep_nesting(path: Path) -> Path:
    make_room(path, 4)
    (path / "transforms.json").write_text("[" * 200_000)
    return path


def huge_json(path: Path) -> Path:
    make_room(path, 4)
    with (path / "transforms.json").open("wb") as file:
        file.truncate(100 * 2**20)
    return path


def depth_of(value: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], Path]:
    def make(path: Path) -> Path:
        make_room(path, 8, depth=True)
        for file in (path / "depth").iterdir():
            cv2.imwrite(str(file), value(cv2.imread(str(file), cv2.IMREAD_UNCHANGED)))
        return path

    return make


def float_depth(value: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], Path]:
    """Depth as .npy files, from the true depth in metres."""

    def make(path: Path) -> Path:
        data = make_room(path, 8, depth=True)
        for frame in data["frames"]:
            metres = cv2.imread(str(path / frame["depth_file_path"]), cv2.IMREAD_UNCHANGED).astype(np.float32) / 1000
            frame["depth_file_path"] = frame["depth_file_path"].replace(".png", ".npy")
            np.save(path / frame["depth_file_path"], value(metres))
        write_transforms(path, data)
        return path

    return make


CASES: dict[str, tuple[Callable[[Path], Path], str]] = {
    "missing": (lambda path: path / "nothing", "does not exist"),
    "empty folder": (empty, "empty|holds no|no picture"),
    "not a video": (not_a_video, "video"),
    "no readable frame": (no_readable_frame, "frame|video"),
    "no readable photo": (no_readable_photo, "picture|read"),
    "one photo": (one_photo, "one|1 |at least"),
    "identical photos": (identical_photos, "same"),
    "black photos": (black_photos, "black"),
    "truncated JPEG": (truncated_jpeg, r"03\.jpg"),
    "NaN pose": (posed(nan_pose), "finite|NaN|not valid"),
    "singular pose": (posed(singular_pose), "singular"),
    "sheared pose": (posed(sheared_pose), "rigid"),
    "negative focal": (posed(negative_focal), "positive"),
    "no focal": (posed(no_focal), "focal"),
    "poses and pictures differ": (more_poses_than_pictures, "6.*7|7.*6"),
    "leads outside": (posed(outside), "outside"),
    "deep nesting": (deep_nesting, "nested"),
    "100 MB": (huge_json, "100 MB"),
    "depth all zero": (depth_of(lambda depth: depth * 0), "depth"),
    "depth all NaN": (float_depth(lambda depth: depth * np.nan), "depth"),
    "depth in a unit that nobody uses": (float_depth(lambda depth: 7 * depth), "unit"),
}


@pytest.mark.parametrize("case", list(CASES))
def test_run_says_what_is_wrong_with_the_source(case: str, tmp_path: Path, capsys: Capsys) -> None:
    make, words = CASES[case]
    source = make(tmp_path / "source")
    answer = call(capsys, "run", source, "--out", tmp_path / "out", "--quiet", "--set", "tsdf.enabled=auto")
    assert answer.code == 2, answer
    assert re.search(words, answer.sentence()), answer.err
    assert not (tmp_path / "out").exists(), "nothing half-written"


def run_made(capsys: Capsys, tmp_path: Path, *arguments: object) -> Answer:
    make_room(tmp_path / "room", 4)
    return call(capsys, "run", tmp_path / "room", *arguments)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--set", "bugdet=3"], "'budget'"),
        (["--set", "fit.rate_densty=3"], "'fit.rate_density'"),
        (["--set", "budget"], "key=value"),
        (["--set", "budget=many"], "valid number"),
        (["--budget", "-3"], "greater than 0"),
        (["--preset", "quick"], "fast, balanced, quality"),
        (["--engine", "trch"], "'torch'"),
        (["--poses", "mine"], "auto, given, sfm"),
        (["--holdout", "1"], "at least 2"),
        (["--image-size", "4"], "at least 16"),
        (["--threads", "0"], "greater than 0"),
        (["--threads", "5000"], "cores; give at most"),
        (["--seed", "-1"], "at least 0"),
        (["--seed", "4294967296"], "less than 2147483648"),
        (["--set", "fit.max_rays=0"], "greater than 0"),
        (["--set", "fit.rate_density=.nan"], "finite number"),
        (["--set", "fit.distortion=-0.1"], "at least 0"),
        (["--set", "fit.rate_density=${oc.env:HOME}"], "valid number"),
        (["--set", "field.channels=2"], "at least 3"),
        (["--set", "export.smooth=1000"], "at most 100"),
        (["--total-budget", "inf"], "at most 10 million"),
        (["--config", "nowhere.yaml"], "nowhere.yaml"),
        (["--set", "tsdf.enabled=maybe"], "auto, on, off"),
    ],
)
def test_wrong_settings(arguments: list[str], words: str, tmp_path: Path, capsys: Capsys) -> None:
    answer = run_made(capsys, tmp_path, "--out", tmp_path / "out", "--quiet", *arguments)
    assert answer.code == 2
    assert words in answer.sentence()


def test_unknown_key_in_a_settings_file(tmp_path: Path, capsys: Capsys) -> None:
    (tmp_path / "mine.yaml").write_text("fit:\n  bugdet: 3\n")
    answer = run_made(capsys, tmp_path, "--out", tmp_path / "out", "--config", tmp_path / "mine.yaml")
    assert answer.code == 2
    assert "mine.yaml" in answer.sentence() and "fit.budget" in answer.sentence()


@pytest.mark.parametrize(
    "arguments", [["run"], ["run", "x"], ["run", "x", "--out", "y", "--budget", "soon"], ["dance"], ["run", "x", "--otu", "y"]]
)
def test_wrong_flags(arguments: list[str], capsys: Capsys) -> None:
    answer = call(capsys, *arguments)
    assert answer.code == 2
    assert "Traceback" not in answer.err and answer.err.strip()


def test_out_folder_that_cannot_be_written(tmp_path: Path, capsys: Capsys) -> None:
    (tmp_path / "file").write_text("a file")
    answer = run_made(capsys, tmp_path, "--out", tmp_path / "file" / "out")
    assert answer.code == 2
    assert "cannot write" in answer.sentence()


def test_out_folder_is_the_source(tmp_path: Path, capsys: Capsys) -> None:
    answer = run_made(capsys, tmp_path, "--out", tmp_path / "room")
    assert answer.code == 2
    assert "source itself" in answer.sentence()


def test_a_refusal_leaves_folders_as_they_were(tmp_path: Path, capsys: Capsys) -> None:
    source, mine = one_photo(tmp_path / "source"), tmp_path / "mine"
    mine.mkdir()
    (mine / "notes.txt").write_text("mine")
    for out in (mine, mine / "new", mine / "deep" / "new"):
        assert call(capsys, "run", source, "--out", out, "--quiet").code == 2
        assert [path.name for path in mine.iterdir()] == ["notes.txt"]


def test_a_refusal_leaves_an_earlier_run(tmp_path: Path) -> None:
    with RunFolder(tmp_path / "out") as folder:
        folder.start(tmp_path, load_settings())
    with pytest.raises(InputError), RunFolder(tmp_path / "out"):
        raise InputError("another source")
    assert is_run_folder(tmp_path / "out")
    (tmp_path / "new").mkdir()
    with pytest.raises(InputError), RunFolder(tmp_path / "new") as folder:
        folder.start(tmp_path, load_settings())
        (folder / "frames").mkdir()
        raise InputError("found late")
    assert is_run_folder(tmp_path / "new"), "what was written belongs to it"


def test_out_folder_of_somebody_else(tmp_path: Path, capsys: Capsys) -> None:
    (tmp_path / "mine" / "frames").mkdir(parents=True)
    answer = run_made(capsys, tmp_path, "--out", tmp_path / "mine")
    assert answer.code == 2
    assert "nothing of yours" in answer.sentence()


@pytest.mark.parametrize("name", ["poses", "tsdf", "finetune", "render", "export", "evaluate"])
def test_commands_on_something_that_is_no_run(name: str, tmp_path: Path, capsys: Capsys) -> None:
    make_room(tmp_path / "room", 4)
    answer = call(capsys, name, tmp_path / "room")
    assert answer.code == 2
    assert "--out" in answer.sentence()
    answer = call(capsys, name, tmp_path / "nothing")
    assert answer.code == 2
    assert "does not exist" in answer.sentence()


def test_damaged_run_json(tmp_path: Path, capsys: Capsys) -> None:
    (tmp_path / "run.json").write_text("{}")
    answer = call(capsys, "export", tmp_path)
    assert answer.code == 2
    assert "run.json is damaged" in answer.sentence()


def test_an_unknown_format(tmp_path: Path, capsys: Capsys) -> None:
    answer = call(capsys, "run", photos(tmp_path / "in", 3), "--out", tmp_path / "out", "--set", "export.formats=[ply,textur]")
    assert answer.code == 2
    assert "export.formats: there is no format 'textur' (did you mean 'texture'?); known are points, ply, " in answer.sentence()
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("limit", [4096, 30_000, 200_000])
def test_full_disk(limit: int, tmp_path: Path) -> None:
    """No file may grow beyond the limit, as on a disk that is full: which file it is differs with the limit."""
    make_room(tmp_path / "room", 12, depth=True)
    answer = spawn(
        "run", tmp_path / "room", "--out", tmp_path / "out", "--quiet", "--budget", "2", "--set", "export.formats=[ply]",
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)),
    )  # fmt: skip
    assert answer.returncode == 2, answer.stderr
    assert "cannot write" in Answer(answer.returncode, answer.stdout, answer.stderr).sentence()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{}", "lists no cameras"),
        ('{"frames": [3]}', "lists no cameras"),
        ('{"w": 8, "h": 8, "fl_x": 9, "frames": [{}]}', "transform_matrix"),
        ('{"w": 8, "h": 8, "frames": [{"transform_matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}]}', "focal"),
        ('{"fl_x": 8, "frames": [{"transform_matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}]}', "size"),
        ('{"camera_path": []}', "lists no cameras"),
        ('{"camera_path": [{"fov": 50}]}', "'render_width', 'render_height' and its 'fov'"),
        ('{"render_width": 8, "render_height": 6, "camera_path": [{"fov": 180}]}', "between 0 and 180 degrees"),
        ('{"render_width": 8, "render_height": 1e9, "camera_path": [{"fov": 50}]}', "size"),
        ('{"render_width": 8, "render_height": 6, "camera_path": [{"fov": 50, "camera_to_world": [1, 0]}]}', "16 numbers"),
        ('{"render_width": 8, "render_height": 6, "camera_path": [{"fov": 50, "camera_to_world": [' + "0," * 15 + "1]}]}", "camera 0"),
        ('{"camera_type": "fisheye", "camera_path": [{"fov": 50}]}', "'fisheye' cameras cannot be rendered"),
    ],
)
def test_camera_files_to_render(text: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "path.json").write_text(text)
    with pytest.raises(InputError, match=words):
        read_cameras(tmp_path / "path.json")


def test_good_camera_file(tmp_path: Path) -> None:
    make_room(tmp_path, 3)
    names, lenses, poses = read_cameras(tmp_path / "transforms.json")
    assert names[1] == "images/001.png" and lenses[0] == CAMERA
    np.testing.assert_allclose(poses, circle(3), atol=1e-12)


def test_good_camera_path(tmp_path: Path) -> None:
    """As nerfstudio has it: OpenGL's axes, the vertical angle."""
    pose = np.diag([1.0, -1, -1, 1])
    pose[:3, 3] = 1, 2, 3
    frame = {"camera_to_world": pose.reshape(-1).tolist(), "fov": 90.0, "aspect": 1.5, "file_path": "door"}
    write_json(tmp_path / "path.json", {"render_width": 60, "render_height": 40, "fps": 12, "seconds": 1, "camera_path": [frame]})
    names, lenses, poses = read_cameras(tmp_path / "path.json")
    assert names == ["door"] and path_fps(tmp_path / "path.json") == 12
    assert (lenses[0].width, lenses[0].height, lenses[0].cx, lenses[0].cy) == (60, 40, 30, 20)
    assert lenses[0].fy == pytest.approx(20) and lenses[0].fx == pytest.approx(20)
    expected = np.eye(4)
    expected[:3, 3] = 1, 2, 3
    np.testing.assert_allclose(poses, expected[None], atol=1e-12)


def test_a_run_folder_whose_name_is_not_utf8_is_refused(tmp_path: Path) -> None:
    """The field could not be written into it when all was done."""
    path = tmp_path / os.fsdecode(b"K\xfcche")
    with pytest.raises(InputError, match=r"K\?che is not UTF-8"), RunFolder(path):
        pass
    assert not path.exists()
