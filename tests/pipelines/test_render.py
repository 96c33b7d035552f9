"""`fieldfuse render` on a finished run: paths, given cameras, the baked field, and what it refuses."""

from __future__ import annotations

import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.pipelines.made import call
from toolkit.files import read_json, write_json

Capsys = pytest.CaptureFixture[str]


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


def test_pictures_of_two_commands_are_not_mixed(done: Path, tmp_path: Path, capsys: Capsys) -> None:
    cameras = read_json(done / "exports" / "cameras" / "transforms.json")
    place = done / "renders" / "cameras"
    for first, count in ((0, 5), (6, 2)):
        write_json(tmp_path / "path.json", {**cameras, "frames": cameras["frames"][first : first + count]})
        answer = call(capsys, "render", done, "--cameras", tmp_path / "path.json", "--image-size", 24, "--quiet", "--json")
        assert answer.code == 0 and json.loads(answer.out)["others"] == 0, answer.err
        names = [Path(frame["file_path"]).stem for frame in cameras["frames"][first : first + count]]
        assert sorted(path.name for path in place.iterdir()) == [f"{index:04d}_{name}.png" for index, name in enumerate(names)]
    assert not list(place.parent.glob(".tmp*"))
    # A folder of one's own keeps what it holds, and that is told.
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "0009_before.png").write_bytes(b"another picture")
    answer = call(capsys, "render", done, "--cameras", tmp_path / "path.json", "--to", mine, "--image-size", 24)
    assert answer.code == 0 and f"note: {mine} holds 1 other pictures" in answer.out and (mine / "0009_before.png").is_file()
    (tmp_path / "file").write_text("in the way")
    answer = call(capsys, "render", done, "--cameras", tmp_path / "path.json", "--to", tmp_path / "file" / "x", "--image-size", 24)
    assert answer.code == 2 and "cannot write" in answer.sentence() and "--out" not in answer.err


def test_the_folder_of_a_run_is_no_capture(done: Path, tmp_path: Path, capsys: Capsys) -> None:
    for name in ("run", "render", "export", "poses"):
        answer = call(capsys, name, done, "--out", tmp_path / "x")
        room = done.parent / "room"
        assert answer.code == 2 and f"{done} is the folder of a run (of {room}); leave --out away to work on it" in answer.sentence()
    assert list(tmp_path.iterdir()) == []


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
