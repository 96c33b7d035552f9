"""Photos in several folders and twice over, and what lies beside a capture."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from fieldfuse.camera import Array
from fieldfuse.capture import Capture, open_capture
from fieldfuse.capture.checks import check_capture
from fieldfuse.capture.photos import unused
from fieldfuse.errors import InputError
from tests.capture.films import film, quarters
from tests.capture.layouts import write_colmap_bin, write_transforms


def scene(index: int, size: tuple[int, int] = (160, 120)) -> Array:
    """(H, W, 3) of a scenery that the camera pans over."""
    wide = cv2.resize(np.random.default_rng(0).integers(0, 255, (12, 60, 3), dtype=np.uint8), (900, 180), interpolation=cv2.INTER_CUBIC)
    return np.ascontiguousarray(cv2.resize(wide[:, 10 * index : 10 * index + 240], size, interpolation=cv2.INTER_AREA))


def shoot(root: Path, names: list[str], start: int = 0, size: tuple[int, int] = (160, 120), **how: object) -> None:
    for index, name in enumerate(names):
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(scene(start + index, size)).save(path, **{"quality": 95, **how})


def open_with(root: Path, *removed: str) -> Capture:
    for name in removed:
        shutil.rmtree(root / name)
    return open_capture(root)


def names_of(root: Path) -> list[str]:
    return [frame.name for frame in open_capture(root).frames]


def numbered(folder: str, count: int) -> list[str]:
    return [f"{folder}/{index:02d}.jpg" for index in range(count)]


# ------------------------------------------------------------------------------------------------ folders


def test_photos_in_the_folder_and_below_are_one_capture(tmp_path: Path) -> None:
    shoot(tmp_path, [f"IMG_{index}.jpg" for index in range(4)])
    shoot(tmp_path, [f"day2/IMG_{index}.jpg" for index in range(4, 7)], 4)
    (tmp_path / "cameras.xml").write_text("<document/>")
    capture = open_capture(tmp_path)
    assert [frame.name for frame in capture.frames] == [f"IMG_{index}" for index in range(7)]
    text = " | ".join(capture.warnings)
    assert "the photos of 2 folders are taken as one capture: the folder itself (4), day2/ (3)" in text
    assert "cameras.xml" in text and unused(capture) == ["1 file with poses (cameras.xml)"]


def test_photos_in_folders_alone_have_names_of_their_own(tmp_path: Path) -> None:
    shoot(tmp_path, numbered("cam1", 3))
    shoot(tmp_path, numbered("cam2", 3), 5, (120, 90))  # another camera of the same rig
    assert names_of(tmp_path) == ["cam1_00", "cam1_01", "cam1_02", "cam2_00", "cam2_01", "cam2_02"]
    shutil.rmtree(tmp_path / "cam2")
    (tmp_path / "cam1").rename(tmp_path / "imagenes")
    assert names_of(tmp_path) == ["00", "01", "02"]


def test_the_usual_folder_with_folders_in_it(tmp_path: Path) -> None:
    shoot(tmp_path, [*numbered("images/a", 2), *numbered("images/b", 2)])
    assert names_of(tmp_path) == ["a_00", "a_01", "b_00", "b_01"]


def test_what_is_no_photo_or_another_capture_is_not_taken(tmp_path: Path) -> None:
    shoot(tmp_path, numbered("images", 4))
    for other in ("images_2", "thumbnails", "depth", "masks", ".hidden", "out", "scan"):
        shoot(tmp_path, numbered(other, 4))
    (tmp_path / "out/run.json").write_text("{}")
    (tmp_path / "scan/transforms.json").write_text("{}")
    shoot(tmp_path, numbered("phone", 3), 5, (90, 90))
    (tmp_path / "linked").symlink_to(tmp_path / "phone")
    capture = open_capture(tmp_path)
    assert [frame.name for frame in capture.frames] == ["00", "01", "02", "03"]
    assert any("the photos in phone/ (3) look like others and are not used" in warning for warning in capture.warnings)
    assert "3 in phone/" in unused(open_with(tmp_path, "thumbnails", "depth", "masks"))[0]


def test_folders_of_different_captures_are_refused(tmp_path: Path) -> None:
    shoot(tmp_path, numbered("kitchen", 4))
    shoot(tmp_path, numbered("garden", 3), size=(90, 90))
    with pytest.raises(InputError, match=r"several captures; give one of the folders"):
        open_capture(tmp_path)


def test_videos_and_poses_beside_are_said(tmp_path: Path) -> None:
    shoot(tmp_path, [f"{index}.jpg" for index in range(4)])
    for index in range(5):
        film(tmp_path / f"clip{index}.avi", quarters())
    capture = open_capture(tmp_path)
    assert len(capture.frames) == 4
    assert any("5 videos (clip0.avi, clip1.avi, clip2.avi, …)" in warning for warning in capture.warnings)
    posed = tmp_path / "posed"
    write_transforms(posed)
    write_colmap_bin(posed)
    assert unused(open_capture(posed))[-1] == "1 file with poses (sparse/0/ (COLMAP model))"


# ------------------------------------------------------------------------------------------------ copies


def test_photos_that_are_there_twice_count_once(tmp_path: Path) -> None:
    shoot(tmp_path, [f"IMG_{index}.JPG" for index in range(6)])
    for index in range(4):
        Image.open(tmp_path / f"IMG_{index}.JPG").save(tmp_path / f"IMG_{index}.png")
    shoot(tmp_path, ["IMG_4 (1).JPG", "other name.jpg"], 4, (80, 60), quality=60)
    tags = Image.Exif()
    tags[0x0112] = 6
    Image.fromarray(np.ascontiguousarray(np.rot90(scene(0)))).save(tmp_path / "turned.jpg", exif=tags, quality=90)
    assert len(open_capture(tmp_path).frames) == 13
    capture = check_capture(open_capture(tmp_path))
    assert [frame.name for frame in capture.frames] == [f"IMG_{index}" for index in range(6)]
    assert sum(capture.extra["sizes"].values()) == 6
    assert [warning for warning in capture.warnings if "7 images are copies of others (" in warning and "count once" in warning]


def test_neighbours_are_no_copies_and_posed_copies_are_said(tmp_path: Path) -> None:
    shoot(tmp_path / "photos", [f"{index}.png" for index in range(5)])
    faint = tmp_path / "faint"  # a dark room: its views differ by as little as they show
    faint.mkdir()
    for index in range(5):
        Image.fromarray((128 + (scene(index).astype(float) - 128) / 20).round().astype(np.uint8)).save(faint / f"{index}.png")
    for folder in (tmp_path / "photos", faint):
        assert len(check_capture(open_capture(folder)).frames) == 5
    Image.fromarray(scene(3)).resize((320, 240)).save(tmp_path / "photos" / "copied.png")
    shutil.copy(tmp_path / "photos" / "2.png", tmp_path / "photos" / "00.png")
    left = {frame.image.name for frame in check_capture(open_capture(tmp_path / "photos")).frames}
    assert left == {"00.png", "0.png", "1.png", "4.png", "copied.png"}, "the larger one stays, and one of two equal ones"
    shutil.rmtree(tmp_path / "photos")
    shutil.rmtree(faint)
    write_transforms(tmp_path)
    frames = open_capture(tmp_path).frames
    shutil.copy(frames[0].image, frames[1].image)
    capture = check_capture(open_capture(tmp_path))
    assert len(capture.frames) == len(frames)
    assert any("1 image is a copy of others (0001.png of 0000.png); where the one is held out" in warning for warning in capture.warnings)
