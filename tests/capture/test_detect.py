"""Every layout is detected, and its cameras are the true ones: by exact projection, and by reprojecting what the images show."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from fieldfuse.camera import Intrinsics
from fieldfuse.capture import open_capture
from fieldfuse.capture.calibration import fitted
from fieldfuse.capture.checks import check_capture
from fieldfuse.capture.detect import READERS, detect_kind
from fieldfuse.capture.images import load_image
from fieldfuse.capture.listing import natural_key, unique_names
from fieldfuse.errors import InputError
from tests.capture.films import film
from tests.capture.layouts import (
    EIGHTH_525,
    LAYOUTS,
    OFF_CENTRE,
    true_eyes,
    write_colmap_bin,
    write_llff,
    write_seven_scenes,
    write_transforms,
)
from tests.capture.made import colour_difference, eyes, left_out, pixel_error, render, reprojection, save_picture
from tests.conftest import shared_data

# What a reader would do wrong: turn about each axis (OpenGL for OpenCV, …), take the inverse, or take the axes in LLFF's order.
MISTAKES = {
    "OpenGL axes": np.diag([1.0, -1, -1, 1]),
    "half turn": np.diag([-1.0, -1, 1, 1]),
    "down for right": np.array([[0, 1.0, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_layout_is_found_and_its_cameras_are_the_true_ones(tmp_path: Path, layout: str) -> None:
    kind, write = LAYOUTS[layout]
    camera = write(tmp_path)
    capture = open_capture(tmp_path)
    assert capture.kind == kind == detect_kind(tmp_path)
    assert capture.posed
    assert len({frame.name for frame in capture.frames}) == len(eyes())
    assert pixel_error(capture, true_eyes(layout), camera) < 1e-3


@pytest.mark.parametrize("layout", LAYOUTS)
def test_pictures_agree_when_reprojected_and_not_with_another_convention(tmp_path: Path, layout: str) -> None:
    camera = LAYOUTS[layout][1](tmp_path)
    frames = open_capture(tmp_path).frames[:2]
    depths = [render(eye, camera)[1] for eye in true_eyes(layout)[:2]]
    pictures = [load_image(frame)[..., :3] for frame in frames]

    def difference(poses: list[np.ndarray]) -> tuple[float, float]:
        views = [(frame.intrinsics, pose, depth) for frame, pose, depth in zip(frames, poses, depths, strict=True)]
        points, relative = reprojection(*views)
        if len(points) < 100:
            return np.inf, np.inf
        visible = points[np.abs(relative) < 0.02]
        if len(visible) < 100:
            return np.inf, float(np.median(np.abs(relative)))
        return colour_difference(visible, [(v[0], v[1], p) for v, p in zip(views, pictures, strict=True)]), float(
            np.median(np.abs(relative))
        )

    poses = [frame.world_from_camera for frame in frames]
    colour, depth = difference(poses)
    assert colour < (8 if layout == "stray" else 4)  # a small video loses more than pictures do
    assert depth < 0.01
    for name, mistake in MISTAKES.items():
        assert difference([pose @ mistake for pose in poses])[1] > 0.05, name
    assert difference([np.linalg.inv(pose) for pose in poses])[1] > 0.05


def test_what_is_written_on_purpose_goes_before_what_is_left_behind(tmp_path: Path) -> None:
    write_colmap_bin(tmp_path)
    assert detect_kind(tmp_path) == "colmap"
    write_llff(tmp_path)
    assert detect_kind(tmp_path) == "colmap", "the model has lens and points, and its images are there"
    for picture in (tmp_path / "images").iterdir():
        picture.unlink()
    assert detect_kind(tmp_path) == "llff"
    write_transforms(tmp_path)
    assert detect_kind(tmp_path) == "transforms"


def test_the_only_capture_further_down_is_read(tmp_path: Path) -> None:
    write_transforms(tmp_path / "unpacked/scene")
    capture = open_capture(tmp_path)
    assert capture.kind == "transforms"
    assert pixel_error(capture, eyes(), OFF_CENTRE) < 1e-3
    assert capture.warnings == ("the capture was found in unpacked/scene/",)
    write_colmap_bin(tmp_path / "unpacked/scene")
    assert open_capture(tmp_path).kind == "transforms", "the model beside it is its own"
    write_llff(tmp_path / "other")
    with pytest.raises(InputError, match=r"2 captures \(other/, unpacked/scene/\); give one of them"):
        open_capture(tmp_path)


def test_images_beside_the_folder_of_their_json(tmp_path: Path) -> None:
    write_transforms(tmp_path)
    (tmp_path / "poses").mkdir()
    text = (tmp_path / "transforms.json").read_text().replace('"images/', '"../images/').replace('"depth/', '"../depth/')
    (tmp_path / "transforms.json").unlink()
    (tmp_path / "poses/transforms.json").write_text(text)
    capture = open_capture(tmp_path)
    assert pixel_error(capture, eyes(), OFF_CENTRE) < 1e-3
    assert capture.has_depth
    with pytest.raises(InputError, match="lead outside the capture folder; give the folder that holds both"):
        open_capture(tmp_path / "poses")


def test_two_models_with_images_of_their_own_are_two_captures(tmp_path: Path) -> None:
    write_colmap_bin(tmp_path / "a")
    write_colmap_bin(tmp_path / "b")
    with pytest.raises(InputError, match=r"2 captures \(a/, b/\)"):
        open_capture(tmp_path)


def test_photos_further_down(tmp_path: Path) -> None:
    for index, eye in enumerate(eyes()):
        save_picture(tmp_path / f"photos of day 1/{index}.png", render(eye, EIGHTH_525)[0])
    assert len(open_capture(tmp_path).frames) == 5


def test_each_kind_has_one_reader() -> None:
    kinds = [kind for kind, _, _ in READERS]
    assert len(set(kinds)) == len(kinds) == 23


def test_a_json_file_names_its_capture(tmp_path: Path) -> None:
    write_transforms(tmp_path)
    (tmp_path / "transforms.json").rename(tmp_path / "other.json")
    assert open_capture(tmp_path / "other.json").kind == "transforms"


def test_a_folder_with_one_video_is_that_video(tmp_path: Path) -> None:
    writer = cv2.VideoWriter(str(tmp_path / "clip.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10, (64, 48))
    for level in range(5):
        writer.write(np.full((48, 64, 3), 40 * level, np.uint8))
    writer.release()
    assert open_capture(tmp_path).kind == "video"
    (tmp_path / "second.avi").write_bytes((tmp_path / "clip.avi").read_bytes())
    with pytest.raises(InputError, match="2 videos"):
        open_capture(tmp_path)


def test_one_picture_beside_a_video_is_its_cover(tmp_path: Path) -> None:
    film(tmp_path / "clip.mp4", [render(eye, EIGHTH_525)[0] for eye in eyes()], fps=10)
    save_picture(tmp_path / "cover.jpg", render(eyes()[0], EIGHTH_525)[0])
    capture = check_capture(open_capture(tmp_path))
    assert (capture.kind, len(capture.frames)) == ("video", 5)
    assert capture.warnings == ("the video clip.mp4 is used; the one image beside it, cover.jpg, is left out",)
    (tmp_path / "second.mp4").write_bytes((tmp_path / "clip.mp4").read_bytes())
    with pytest.raises(InputError, match="2 videos"):
        open_capture(tmp_path)
    save_picture(tmp_path / "photo.jpg", render(eyes()[1], EIGHTH_525)[0])
    assert open_capture(tmp_path).kind == "photos"


@pytest.mark.parametrize("name", ["one.jpg", "ONE.PNG", "one.heic", "one.CR2"])
def test_one_picture_is_no_capture(tmp_path: Path, name: str) -> None:
    save_picture(tmp_path / "one.jpg", render(eyes()[0], EIGHTH_525)[0])
    (tmp_path / "one.jpg").rename(tmp_path / name)
    with pytest.raises(InputError, match=rf"{name} is one image, .*; give the folder"):
        open_capture(tmp_path / name)


def test_nothing_there_is_said_in_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        open_capture(tmp_path / "absent")
    with pytest.raises(InputError, match="is empty"):
        open_capture(tmp_path)
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(InputError, match=r"no capture of a known kind .*notes\.txt"):
        open_capture(tmp_path)


@pytest.mark.parametrize("layout", [name for name in LAYOUTS if name != "record3d"])  # of its thousands one is left out
def test_a_file_that_is_no_picture_is_named(tmp_path: Path, layout: str) -> None:
    LAYOUTS[layout][1](tmp_path)
    victim = open_capture(tmp_path).frames[-1].image
    victim.write_bytes(b"not an image")
    try:
        said = " ".join(check_capture(open_capture(tmp_path)).warnings)  # one of many is left out
    except InputError as error:
        said = str(error)
    assert victim.name in said


NO_SIZE = ("blender", "stray", "sens", "realitycapture", "xmp", "bundler")  # these have no size of the images, or hold them


@pytest.mark.parametrize("layout", [name for name in LAYOUTS if name not in NO_SIZE])
def test_a_cropped_picture_does_not_pass_as_a_resized_one(tmp_path: Path, layout: str) -> None:
    LAYOUTS[layout][1](tmp_path)
    for frame in open_capture(tmp_path).frames[:2]:  # two of five: of one, the frame is left out
        save_picture(frame.image, np.zeros((60, 50, 3), np.uint8))
    with pytest.raises(InputError):
        open_capture(tmp_path)


@pytest.mark.parametrize("layout", ["7scenes", "scannet", "llff", "dtu", "redwood", "replica", "polycam", "scanner3d", "opensfm"])
def test_one_cropped_picture_costs_its_frame(tmp_path: Path, layout: str) -> None:
    LAYOUTS[layout][1](tmp_path)
    victim = open_capture(tmp_path).frames[-1]
    save_picture(victim.image, np.zeros((60, 50, 3), np.uint8))
    capture = open_capture(tmp_path)
    left_out(capture, re.escape(victim.name))
    assert victim.name not in {frame.name for frame in capture.frames}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_what_macos_leaves_beside_files_is_not_read(tmp_path: Path, layout: str) -> None:
    LAYOUTS[layout][1](tmp_path)
    for path in [path for path in tmp_path.rglob("*") if path.is_file()]:
        path.with_name(f"._{path.name}").write_bytes(b"\0\5\x16\7")
    capture = open_capture(tmp_path)
    assert (capture.kind, len(capture.frames)) == (LAYOUTS[layout][0], len(eyes()))


@pytest.mark.parametrize("layout", [name for name in LAYOUTS if name not in ("colmap bin", "llff", "dtu", "sens")])  # these have no text
def test_text_with_the_mark_that_windows_writes_first(tmp_path: Path, layout: str) -> None:
    camera = LAYOUTS[layout][1](tmp_path)
    for path in [path for path in tmp_path.rglob("*") if path.suffix in (".json", ".txt", ".csv", ".log")]:
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
    assert pixel_error(open_capture(tmp_path), true_eyes(layout), camera) < 1e-3


def test_sequences_in_folders_are_read_together(tmp_path: Path) -> None:
    write_seven_scenes(tmp_path, "seq-01")
    write_seven_scenes(tmp_path, "seq-02")
    capture = open_capture(tmp_path)
    assert capture.kind == "7scenes"
    assert [frame.name for frame in capture.frames][4:6] == ["seq-01_frame-000004", "seq-02_frame-000000"]


def test_names_are_short_and_unique() -> None:
    assert unique_names([Path("/a/b/1.jpg"), Path("/a/c/2.jpg")]) == ["1", "2"]
    assert unique_names([Path("/a/b/1.jpg"), Path("/a/c/1.jpg")]) == ["b_1", "c_1"]
    assert unique_names([Path("/a/b/1.jpg"), Path("/a/b/1.png")]) == ["1.jpg", "1.png"]
    assert sorted(["10", "9", "a2", "a10", "A1"], key=natural_key) == ["9", "10", "A1", "a2", "a10"]


def test_a_camera_is_scaled_with_its_picture() -> None:
    camera = Intrinsics(4032, 3024, 3000, 3000, 2016, 1512)
    assert fitted(camera, (504, 378), "here").fx == pytest.approx(375)
    assert fitted(camera, (4032, 3024), "here") is camera
    with pytest.raises(InputError, match="another shape"):
        fitted(camera, (3024, 4032), "here")


@pytest.mark.parametrize(
    ("name", "kind", "count"),
    [
        ("bart-toy", "transforms", 15),
        ("cairo-terrace", "transforms", 60),
        ("cat-toy", "transforms", 47),
        ("chess-king", "colmap", 23),
        ("chickens", "transforms", 7),
        ("computer-mouse", "colmap", 56),
        ("kangaroo", "transforms", 29),
        ("living-room-ten", "colmap", 10),
        ("office-pc", "transforms", 16),
        ("ultraman-figure", "transforms", 69),
    ],
)
def test_captures_as_other_people_made_them(name: str, kind: str, count: int) -> None:
    capture = open_capture(shared_data(f"zoo/{name}"))
    assert (capture.kind, len(capture.frames), capture.posed) == (kind, count, True)
