"""LLFF: which folder of images, the size they are at, the order of rows, and arrays of another kind."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fieldfuse.capture import open_capture
from fieldfuse.capture.llff import read_llff
from fieldfuse.errors import InputError
from tests.capture.layouts import CENTRED, half_size, write_llff
from tests.capture.made import Pinhole, eyes, pixel_error, render, save_picture
from tests.conftest import shared_data

FULL = Pinhole(320, 240, 288.0, 288.0, 160.0, 120.0)


def fill(folder: Path, camera: Pinhole, count: int = 5) -> None:
    for index, eye in enumerate(eyes()[:count]):
        save_picture(folder / f"IMG_{index:02d}.png", render(eye, camera)[0])


def test_bounds_are_kept(tmp_path: Path) -> None:
    write_llff(tmp_path)
    assert open_capture(tmp_path).extra == {"near": 1.0, "far": 9.0}


def test_the_full_size_is_preferred_then_the_largest_that_is_complete(tmp_path: Path) -> None:
    write_llff(tmp_path)
    fill(tmp_path / "images_8", half_size(CENTRED))
    assert open_capture(tmp_path).frames[0].intrinsics.width == 80
    fill(tmp_path / "images", FULL, count=3)
    assert open_capture(tmp_path).frames[0].intrinsics.width == 80, "three images for five rows"
    fill(tmp_path / "images", FULL)
    capture = open_capture(tmp_path)
    assert capture.frames[0].intrinsics.width == 320
    assert pixel_error(capture, eyes(), FULL) < 1e-3


def test_rows_belong_to_names_in_alphabetical_order(tmp_path: Path) -> None:
    write_llff(tmp_path)
    for index, number in enumerate((1, 10, 11, 2, 9)):  # alphabetical, not natural
        (tmp_path / f"images_4/IMG_{index:02d}.png").rename(tmp_path / f"images_4/{number}.png")
    capture = open_capture(tmp_path)
    assert [frame.name for frame in capture.frames] == ["1", "2", "9", "10", "11"]
    assert pixel_error(capture, [eyes()[i] for i in (0, 3, 4, 1, 2)], CENTRED) < 1e-3


def test_pictures_and_poses_must_be_as_many(tmp_path: Path) -> None:
    write_llff(tmp_path)
    (tmp_path / "images_4/IMG_03.png").unlink()
    with pytest.raises(InputError, match="5 poses but images_4/ holds 4 images"):
        read_llff(tmp_path)


BAD_VALUES = [
    (14, -300.0, "must be positive"),
    (14, 0.0, "must be positive"),
    (14, np.nan, "not finite"),
    (9, np.inf, "image size"),
    (4, 0.0, "image size"),
    (0, np.nan, "not finite"),
    (0, 9.0, "not rigid"),
]


@pytest.mark.parametrize(("column", "value", "message"), BAD_VALUES)
def test_a_bad_row_is_named(tmp_path: Path, column: int, value: float, message: str) -> None:
    write_llff(tmp_path)
    table = np.load(tmp_path / "poses_bounds.npy")
    table[2, column] = value
    np.save(tmp_path / "poses_bounds.npy", table)
    with pytest.raises(InputError, match=rf"row 2 \(IMG_02\.png\).*{message}"):
        read_llff(tmp_path)


@pytest.mark.parametrize("array", [np.zeros((5, 15)), np.zeros(17), np.zeros((5, 17), dtype="U3"), np.array([{}], dtype=object)])
def test_arrays_of_another_kind(tmp_path: Path, array: np.ndarray) -> None:
    write_llff(tmp_path)
    np.save(tmp_path / "poses_bounds.npy", array, allow_pickle=True)
    with pytest.raises(InputError, match="not an LLFF array"):
        read_llff(tmp_path)


def test_fern() -> None:
    capture = open_capture(shared_data("llff_fern_8"))
    assert (capture.kind, len(capture.frames), capture.frames[0].intrinsics.width) == ("llff", 20, 504)
    assert capture.frames[0].intrinsics.fx == pytest.approx(3260.526 / 8, rel=1e-6)


@pytest.mark.parametrize("place", [".", "photos", "photos/day 1"])
def test_images_in_the_only_folder_that_fits(tmp_path: Path, place: str) -> None:
    write_llff(tmp_path)
    (tmp_path / "masks").mkdir()
    (tmp_path / place).mkdir(parents=True, exist_ok=True)
    for path in sorted((tmp_path / "images_4").iterdir()):
        (tmp_path / "masks" / path.name).write_bytes(path.read_bytes())
        path.rename(tmp_path / place / path.name)
    capture = read_llff(tmp_path)
    assert pixel_error(capture, eyes(), CENTRED) < 1e-3
    assert "which holds one for each pose" in capture.warnings[0]
