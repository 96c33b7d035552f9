"""ScanNet: exported folders and loose samples, lost frames, cameras."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fieldfuse.capture import open_capture
from fieldfuse.capture.images import load_depth
from fieldfuse.errors import InputError
from tests.capture.layouts import OFF_CENTRE, SCANNET_COLOUR, rows, whole_centres, write_scannet, write_seven_scenes
from tests.capture.made import Pinhole, eyes, pixel_error, render, save_picture
from tests.conftest import shared_data


def test_two_cameras_units_and_up(tmp_path: Path) -> None:
    write_scannet(tmp_path)
    capture = open_capture(tmp_path)
    assert [frame.name for frame in capture.frames] == ["0", "5", "10", "15", "20"]
    assert capture.metric
    assert capture.up == (0, 0, 1)
    depth = capture.frames[0].depth_intrinsics
    assert (depth.fx, depth.fy, depth.cx, depth.cy) == pytest.approx((OFF_CENTRE.fx, OFF_CENTRE.fy, OFF_CENTRE.cx, OFF_CENTRE.cy))
    np.testing.assert_allclose(load_depth(capture.frames[0], capture), render(eyes()[0], OFF_CENTRE)[1], atol=6e-4)
    assert capture.warnings == ()


def test_lost_frames_are_dropped_and_counted(tmp_path: Path) -> None:
    write_scannet(tmp_path)
    (tmp_path / "pose/10.txt").write_text(rows(np.full((4, 4), -np.inf)))
    capture = open_capture(tmp_path)
    assert [frame.name for frame in capture.frames] == ["0", "5", "15", "20"]
    assert capture.extra == {"listed": 5, "lost": 1}
    assert capture.warnings == ("1 frame left out because tracking was lost there (pose -inf or NaN)",)
    for path in (tmp_path / "pose").iterdir():
        path.write_text(rows(np.full((4, 4), -np.inf)))
    with pytest.raises(InputError, match="all 5 poses"):
        open_capture(tmp_path)


@pytest.mark.parametrize("mark", ["nan", "-1.#IND", "-nan(ind)"])
def test_nan_marks_lost_frames_as_well(mark: str, tmp_path: Path) -> None:
    write_scannet(tmp_path)
    (tmp_path / "pose/10.txt").write_text("\n".join([" ".join([mark] * 4)] * 4))
    capture = open_capture(tmp_path)
    assert capture.warnings == ("1 frame left out because tracking was lost there (pose -inf or NaN)",)
    assert "10" not in {frame.name for frame in capture.frames}


def test_the_subset_of_25000_frames_names_its_cameras_otherwise(tmp_path: Path) -> None:
    write_scannet(tmp_path)
    for which in ("color", "depth"):
        (tmp_path / f"intrinsic/intrinsic_{which}.txt").rename(tmp_path / f"intrinsics_{which}.txt")
    (tmp_path / "intrinsic").rmdir()
    capture = open_capture(tmp_path)
    assert capture.warnings == () and pixel_error(capture, eyes(), SCANNET_COLOUR) < 1e-3
    assert capture.frames[0].depth_intrinsics.cx == pytest.approx(OFF_CENTRE.cx)


def test_pictures_exported_smaller_than_the_sensors(tmp_path: Path) -> None:
    write_scannet(tmp_path)
    sensor = Pinhole(1296, 968, 1165.0, 1166.0, 650.0, 486.0)
    small = Pinhole(324, 242, 291.25, 291.5, 162.5, 121.5)
    k = np.eye(4)
    k[:3, :3] = whole_centres(sensor)
    (tmp_path / "intrinsic/intrinsic_color.txt").write_text(rows(k))
    for index, eye in enumerate(eyes()):
        save_picture(tmp_path / f"color/{index * 5}.jpg", render(eye, small)[0])
    capture = open_capture(tmp_path)
    assert pixel_error(capture, eyes(), small) < 1e-3
    assert "is for 1296×968 images" in capture.warnings[0]


@pytest.mark.parametrize(("cx", "cy", "message"), [(90, 400, "outside the 96×72 picture"), (0.49, 0.5, "shares of the picture")])
def test_a_principal_point_that_cannot_be(tmp_path: Path, cx: float, cy: float, message: str) -> None:
    write_scannet(tmp_path)
    (tmp_path / "intrinsic/intrinsic_color.txt").write_text(f"86 0 {cx}\n0 87 {cy}\n0 0 1\n")
    with pytest.raises(InputError, match=rf"intrinsic_color\.txt.*{message}"):
        open_capture(tmp_path)


def test_a_sample_is_told_from_seven_scenes_by_its_sizes(tmp_path: Path) -> None:
    write_seven_scenes(tmp_path)
    assert open_capture(tmp_path).kind == "7scenes"
    half = Pinhole(648, 484, 582.86, 582.87, 324.0, 242.0)
    for index, eye in enumerate(eyes()):
        save_picture(tmp_path / f"frame-{index:06d}.color.png", render(eye, half)[0])
    capture = open_capture(tmp_path)
    assert capture.kind == "scannet"
    assert pixel_error(capture, eyes(), half) < 0.01
    assert len(capture.warnings) == 2


def test_the_usual_cameras_do_not_fit_any_picture(tmp_path: Path) -> None:
    write_scannet(tmp_path)
    (tmp_path / "intrinsic/intrinsic_color.txt").unlink()
    for index, eye in enumerate(eyes()):
        save_picture(tmp_path / f"color/{index * 5}.jpg", render(eye, Pinhole(90, 90, 80, 80, 45, 45))[0])
    with pytest.raises(InputError, match="another shape"):
        open_capture(tmp_path)


def test_the_shared_sample() -> None:
    capture = open_capture(shared_data("scannet_sample_11"))
    assert (capture.kind, len(capture.frames)) == ("scannet", 11)
