"""Stray Scanner's recordings as the app has written them over the years: more columns, a hidden first frame, a turned video."""

from __future__ import annotations

import os
import struct
import threading
from pathlib import Path

import numpy as np
import pytest

from fieldfuse.capture import Capture, open_capture
from fieldfuse.capture.images import load_image
from fieldfuse.capture.select import select_frames
from fieldfuse.capture.storage import capture_from_dict, capture_to_dict
from fieldfuse.capture.video import iterate_video, read_video
from fieldfuse.config import CaptureSettings, PosesSettings
from fieldfuse.errors import InputError
from fieldfuse.poses.job import plan
from tests.capture.films import film, hide_first, quarters, turn
from tests.capture.layouts import PHONE, write_stray
from tests.capture.made import eyes, left_out, pixel_error, render

NOW = ", fx, fy, cx, cy, distortion_center_x, distortion_center_y"
OPTIONS = "OPENCV_FFMPEG_CAPTURE_OPTIONS"


def rewritten(root: Path, change) -> Path:
    """`odometry.csv` with every line (number, 0 is the header, and text) changed."""
    path = root / "odometry.csv"
    path.write_text("\n".join(change(number, line) for number, line in enumerate(path.read_text().splitlines())))
    return root


def shown(capture: Capture) -> list[int]:
    """Which of the true images each frame's is, by the difference."""
    true = [render(eye, PHONE)[0].astype(int) for eye in eyes()]
    return [int(np.argmin([np.abs(load_image(frame).astype(int) - picture).mean() for picture in true])) for frame in capture.frames]


# ------------------------------------------------------------------------------------------------ rows


@pytest.mark.parametrize("centre", [", , ", ", 80.5, 60.5", ""])
@pytest.mark.parametrize("header", [True, False])
def test_each_frame_has_its_own_camera_where_its_row_says_so(tmp_path: Path, centre: str, header: bool) -> None:
    write_stray(tmp_path)
    (tmp_path / "camera_matrix.csv").write_text("999, 0, 80\n0, 999, 60\n0, 0, 1")  # of one frame, and not of these
    camera = f", {PHONE.fx + 1}, {PHONE.fy + 2}, {PHONE.cx + 3}, {PHONE.cy + 4}"
    rewritten(tmp_path, lambda number, line: line + (NOW if number == 0 else camera + centre))
    if not header:
        path = tmp_path / "odometry.csv"
        path.write_text("\n".join(path.read_text().splitlines()[1:]))
    capture = open_capture(tmp_path)
    assert capture.posed and capture.has_depth and len(capture.frames) == 5
    for frame in capture.frames:
        found = frame.intrinsics
        assert (found.fx, found.fy, found.cx, found.cy) == (PHONE.fx + 1, PHONE.fy + 2, PHONE.cx + 3, PHONE.cy + 4)
        assert frame.depth_intrinsics.fx == pytest.approx(found.fx / 4)


def test_a_row_without_camera_has_that_of_the_file(tmp_path: Path) -> None:
    write_stray(tmp_path)
    camera = f", {PHONE.fx}, {PHONE.fy}, {PHONE.cx}, {PHONE.cy}, , "
    rewritten(tmp_path, lambda number, line: line + (NOW if number == 0 else ", , , , , , " if number == 2 else camera))
    (tmp_path / "camera_matrix.csv").write_text("999, 0, 80\n0, 999, 60\n0, 0, 1")
    assert [frame.intrinsics.fx for frame in open_capture(tmp_path).frames] == [PHONE.fx, 999, PHONE.fx, PHONE.fx, PHONE.fx]


def test_columns_are_found_by_their_names(tmp_path: Path) -> None:
    write_stray(tmp_path)

    def turned(number: int, line: str) -> str:
        words = [word.strip() for word in line.split(",")]
        return ",".join(["note" if number == 0 else "" if number == 1 else "blurred", *reversed(words)])

    capture = open_capture(rewritten(tmp_path, turned))
    assert pixel_error(capture, eyes(), PHONE) < 1e-3 and all(frame.depth is not None for frame in capture.frames)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda number, line: line + (NOW if number == 0 else ", 1, nan, 3, 4"), r"odometry\.csv, row 1 holds values that are not finite"),
        (lambda number, line: line + (NOW if number == 0 else ", 0, 1, 3, 4"), r"odometry\.csv, row 1: the focal length is 0"),
        (lambda number, line: line if number != 3 else line.rsplit(",", 1)[0], "rows of different length"),
        (lambda number, line: line.replace("qw", "q"), "number"),
    ],
)
def test_rows_that_cannot_be(tmp_path: Path, change, said: str) -> None:
    write_stray(tmp_path)
    rewritten(tmp_path, change)
    if "qw" in (tmp_path / "odometry.csv").read_text():
        with pytest.raises(InputError, match=said):
            open_capture(tmp_path)
    else:  # a header that says nothing known: by position, as ever
        assert pixel_error(open_capture(tmp_path), eyes(), PHONE) < 1e-3


def test_a_row_that_cannot_be_costs_its_frame(tmp_path: Path) -> None:
    write_stray(tmp_path)
    rewritten(tmp_path, lambda number, line: line if number != 3 else line.rsplit(",", 1)[0] + ", ")
    capture = open_capture(tmp_path)
    left_out(capture, r"frame_000002.*odometry\.csv, row 3 must hold numbers")
    assert [frame.video_index for frame in capture.frames] == [0, 1, 3, 4]


# ------------------------------------------------------------------------------------------------ the video


def test_a_first_frame_that_players_leave_out_counts(tmp_path: Path) -> None:
    write_stray(tmp_path)
    hide_first(tmp_path / "rgb.mp4")
    assert len(list(iterate_video(tmp_path / "rgb.mp4"))) == 4  # what a player shows
    capture = open_capture(tmp_path)
    assert not capture.warnings and shown(capture) == [0, 1, 2, 3, 4]
    assert shown(capture_from_dict(capture_to_dict(capture))) == [0, 1, 2, 3, 4]
    job = plan(capture, tmp_path / "sparse", PosesSettings(), 0, 1)
    assert shown(capture.with_frames(list(job.images))) == [0, 1, 2, 3, 4]
    chosen = select_frames(capture, tmp_path / "run", CaptureSettings(max_frames=10))
    assert shown(chosen) == [int(frame.name.removeprefix("frame_")) for frame in chosen.frames] and not chosen.warnings


@pytest.mark.parametrize("before", [None, "threads;1"])
def test_other_videos_open_as_ever_meanwhile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, before: str | None) -> None:
    path = hide_first(film(tmp_path / "a.mp4", quarters(6)))
    if before is None:
        monkeypatch.delenv(OPTIONS, raising=False)
    else:
        monkeypatch.setenv(OPTIONS, before)
    wrong: list[tuple[bool, int]] = []

    def read(as_stored: bool) -> None:
        for _ in range(20):
            found = sum(1 for _ in iterate_video(path, as_stored=as_stored))
            if found != (6 if as_stored else 5):
                wrong.append((as_stored, found))

    threads = [threading.Thread(target=read, args=(turn % 2 == 0,)) for turn in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong and os.environ.get(OPTIONS) == before


@pytest.mark.parametrize("degrees", [90, 180, 270])
def test_a_video_that_is_to_be_shown_turned_stays_as_its_matrix_is(tmp_path: Path, degrees: int) -> None:
    write_stray(tmp_path)
    turn(tmp_path / "rgb.mp4", degrees)
    for _ in range(2):
        capture = open_capture(tmp_path)
        assert pixel_error(capture, eyes(), PHONE) < 1e-3 and shown(capture) == [0, 1, 2, 3, 4]
        assert (capture.extra["width"], capture.extra["height"]) == (PHONE.width, PHONE.height)
        for name in ("depth", "confidence"):  # once more without, where nothing else tells that the shape is wrong
            if (tmp_path / name).is_dir():
                (tmp_path / name).rename(tmp_path / f"no_{name}")
    alone = read_video(tmp_path / "rgb.mp4")
    assert (alone.extra["width"] == PHONE.height) == (degrees != 180)  # a video by itself is turned, as ever


@pytest.mark.parametrize("rows", [3, 4])
def test_rows_that_do_not_go_with_the_frames_are_told(tmp_path: Path, rows: int) -> None:
    write_stray(tmp_path)
    path = tmp_path / "odometry.csv"
    path.write_text("\n".join(path.read_text().splitlines()[: 1 + rows]))
    assert f"the video has 5 frames and odometry.csv {rows} rows" in open_capture(tmp_path).warnings[0]


def test_frames_that_cannot_be_decoded_are_told(tmp_path: Path) -> None:
    write_stray(tmp_path)
    path = tmp_path / "rgb.mp4"
    data = bytearray(path.read_bytes())
    sizes = struct.unpack_from(">5I", data, data.find(b"stsz") + 16)  # behind version and flags, common size, number of frames
    (start,) = struct.unpack_from(">I", data, data.find(b"stco") + 12)
    data[start + sum(sizes[:4]) : start + sum(sizes)] = bytes(sizes[4])
    path.write_bytes(bytes(data))
    capture = open_capture(tmp_path)
    chosen = select_frames(capture, tmp_path / "run", CaptureSettings(max_frames=10))
    assert any("4 of the 5 frames" in warning for warning in chosen.warnings)
