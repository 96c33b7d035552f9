"""TUM RGB-D: association in time, cameras by name, lists that do not hold what they should."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fieldfuse.camera import OPENCV
from fieldfuse.capture import open_capture
from fieldfuse.capture.images import load_depth
from fieldfuse.capture.tum import read_tum
from fieldfuse.errors import InputError
from tests.capture.layouts import EIGHTH_525, write_tum
from tests.capture.made import eyes, pixel_error, render


def test_units_names_and_up(tmp_path: Path) -> None:
    write_tum(tmp_path)
    capture = open_capture(tmp_path)
    assert capture.kind == "tum"
    assert capture.metric
    assert capture.ordered
    assert capture.up == (0, 0, 1)
    assert capture.frames[0].name == "1000.000000"
    np.testing.assert_allclose(load_depth(capture.frames[0], capture), render(eyes()[0], EIGHTH_525)[1], atol=2e-4)
    assert "default of 525" in capture.warnings[0]


@pytest.mark.parametrize(
    ("folder", "focal"),
    [("rgbd_dataset_freiburg1_desk", 517.3), ("fr2_xyz", 520.9), ("rgbd_dataset_freiburg3_long_office_household", 535.4), ("desk", 525.0)],
)
def test_the_folder_tells_the_camera(tmp_path: Path, folder: str, focal: float) -> None:
    write_tum(tmp_path / folder)
    capture = open_capture(tmp_path / folder)
    assert capture.frames[0].intrinsics.fx == pytest.approx(focal / 8)
    assert (capture.frames[0].intrinsics.lens == OPENCV) == (focal in (517.3, 520.9))
    assert bool(capture.warnings) == (focal == 525.0)


def test_pictures_far_from_any_pose_or_without_file_are_counted(tmp_path: Path) -> None:
    write_tum(tmp_path)
    with (tmp_path / "rgb.txt").open("a") as stream:
        stream.write("2000.0 rgb/1000.000000.png\n1000.9 rgb/absent.png\n")
    capture = open_capture(tmp_path)
    assert len(capture.frames) == 5
    assert capture.extra == {"listed": 7, "missing": 1, "unposed": 1}
    assert pixel_error(capture, eyes(), EIGHTH_525) < 1e-3


def test_20_ms_is_the_limit(tmp_path: Path) -> None:
    write_tum(tmp_path)
    truth = tmp_path / "groundtruth.txt"
    kept = [line for line in truth.read_text().splitlines() if "9 9 9" not in line]
    truth.write_text("\n".join(kept).replace("1000.396", "1000.421"))
    assert len(open_capture(tmp_path).frames) == 4
    truth.write_text("\n".join(kept).replace("1000.396", "1000.419"))
    assert len(open_capture(tmp_path).frames) == 5


def test_without_depth(tmp_path: Path) -> None:
    write_tum(tmp_path)
    (tmp_path / "depth.txt").unlink()
    assert not open_capture(tmp_path).has_depth


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("rgb.txt", "", "lists nothing"),
        ("rgb.txt", "soon rgb/a.png\n", "line 1"),
        ("rgb.txt", "1000.0\n", "line 1"),
        ("rgb.txt", "1000.0 ../../etc/passwd\n", "outside the capture folder"),
        ("rgb.txt", "5.0 rgb/1000.000000.png\n", "none of the 1 image"),
        ("groundtruth.txt", "1000.0 0 0 0 0 0 0 0\n", "not a rotation"),
        ("groundtruth.txt", "1000.0 0 0 0 nan 0 0 1\n", "not a rotation"),
        ("groundtruth.txt", "1000.0 inf 0 0 0 0 0 1\n", "not finite"),
        ("groundtruth.txt", "1000.0 0 0 0 0 0 one 1\n", "not a number"),
        ("groundtruth.txt", "1000.0 0 0 0\n", "line 1"),
    ],
)
def test_broken_lists_are_refused(tmp_path: Path, name: str, text: str, message: str) -> None:
    write_tum(tmp_path)
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=message):
        read_tum(tmp_path)


def test_depth_listed_outside_the_folder_is_not_read(tmp_path: Path) -> None:
    write_tum(tmp_path)
    (tmp_path / "depth.txt").write_text("1000.0 /etc/passwd\n")
    capture = read_tum(tmp_path)
    assert not capture.has_depth
    assert "1 listed depth image not found" in capture.warnings
