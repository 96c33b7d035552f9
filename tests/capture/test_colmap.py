"""COLMAP models: against pycolmap's own writer and camera models, folders, and files that lie about their length."""

from __future__ import annotations

import re
import shutil
import struct
from pathlib import Path

import numpy as np
import pytest

from fieldfuse.camera import Intrinsics, project
from fieldfuse.capture import open_capture
from fieldfuse.capture.colmap import MODELS, candidate_capture, candidate_models, intrinsics_of, read_colmap, read_model
from fieldfuse.capture.types import MODEL_NAMES
from fieldfuse.errors import InputError
from tests.capture.layouts import OFF_CENTRE, POINTS, half_size, write_colmap_bin, write_colmap_txt
from tests.capture.made import eyes, pixel_error, render, save_picture

PARAMETERS = {
    "SIMPLE_PINHOLE": [70, 41, 29],
    "PINHOLE": [70, 72, 41, 29],
    "SIMPLE_RADIAL": [70, 41, 29, 0.08],
    "RADIAL": [70, 41, 29, 0.08, -0.03],
    "OPENCV": [70, 72, 41, 29, 0.08, -0.03, 2e-3, -1e-3],
    "OPENCV_FISHEYE": [70, 72, 41, 29, 0.08, -0.03, 0.01, -0.004],
    "FULL_OPENCV": [70, 72, 41, 29, 0.08, -0.03, 2e-3, -1e-3, 0.01, 0.02, -0.01, 0.003],
    "SIMPLE_RADIAL_FISHEYE": [70, 41, 29, 0.08],
    "RADIAL_FISHEYE": [70, 41, 29, 0.08, -0.03],
    "SIMPLE_FISHEYE": [70, 41, 29],
    "FISHEYE": [70, 72, 41, 29],
    "EQUIRECTANGULAR": [80, 60],
}


@pytest.mark.parametrize("model", PARAMETERS)
def test_each_camera_model_projects_like_pycolmap(model: str) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    if model not in pycolmap.CameraModelId.__members__:
        pytest.skip(f"this pycolmap does not know {model}")
    theirs = pycolmap.Camera(model=model, width=80, height=60, params=PARAMETERS[model])
    ours = intrinsics_of(model, 80, 60, [float(value) for value in PARAMETERS[model]], "here")
    points = np.random.default_rng(0).uniform([-0.6, -0.45, 1], [0.6, 0.45, 1], (50, 3))
    points[:, 2] = 1
    seen, _ = project(ours, np.eye(4), points)
    np.testing.assert_allclose(seen, theirs.img_from_cam(points), atol=1e-6)


def test_model_numbers_and_parameter_counts_are_pycolmaps() -> None:
    pycolmap = pytest.importorskip("pycolmap")
    for number, (name, count, _) in enumerate(MODELS):
        if name in pycolmap.CameraModelId.__members__:
            assert int(pycolmap.CameraModelId.__members__[name]) == number
            assert len(pycolmap.Camera(model=name, width=80, height=60, params=[1.0] * count).params) == count


@pytest.mark.parametrize("model", ["FOV", "THIN_PRISM_FISHEYE", "DIVISION", "NO_SUCH"])
def test_models_without_counterpart_say_what_to_do(model: str) -> None:
    with pytest.raises(InputError, match="image_undistorter"):
        intrinsics_of(model, 80, 60, [1.0] * 5, "here")


@pytest.mark.parametrize("suffix", ["bin", "txt"])
def test_what_pycolmap_writes(tmp_path: Path, suffix: str) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    write_colmap_bin(tmp_path)
    model = tmp_path / "sparse/0"
    reconstruction = pycolmap.Reconstruction(str(model))
    shutil.rmtree(model)
    model.mkdir()
    (reconstruction.write_binary if suffix == "bin" else reconstruction.write_text)(str(model))
    assert (model / f"images.{suffix}").is_file()
    capture = open_capture(tmp_path)
    assert pixel_error(capture, eyes(), OFF_CENTRE) < 1e-3
    np.testing.assert_allclose(sorted(capture.points.tolist()), sorted(POINTS.tolist()))


@pytest.mark.parametrize("place", ["sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", "distorted/sparse/0", "."])
def test_places_of_the_model(tmp_path: Path, place: str) -> None:
    write_colmap_bin(tmp_path)
    if place != "sparse/0":
        files = [path.rename(tmp_path / path.name) for path in (tmp_path / "sparse/0").iterdir()]
        shutil.rmtree(tmp_path / "sparse")
        (tmp_path / place).mkdir(parents=True, exist_ok=True)
        for path in files:
            path.rename(tmp_path / place / path.name)
    capture = open_capture(tmp_path)
    assert (capture.kind, len(capture.frames)) == ("colmap", 5)
    if place != ".":
        assert len(read_colmap(tmp_path / place).frames) == 5, "the model's own folder, images above it"


def test_pictures_beside_the_model(tmp_path: Path) -> None:
    write_colmap_txt(tmp_path)
    for path in [*(tmp_path / "sparse/0").iterdir(), *(tmp_path / "images").iterdir()]:
        path.rename(tmp_path / path.name)
    assert len(open_capture(tmp_path).frames) == 5


def test_binary_and_text_agree(tmp_path: Path) -> None:
    write_colmap_bin(tmp_path / "a")
    write_colmap_txt(tmp_path / "b")
    one, two = read_model(tmp_path / "a/sparse/0"), read_model(tmp_path / "b/sparse/0")
    assert one.cameras == two.cameras
    assert [image.name for image in one.images] == [image.name for image in two.images]
    np.testing.assert_allclose([i.world_from_camera for i in one.images], [i.world_from_camera for i in two.images], atol=1e-12)
    np.testing.assert_allclose(one.points, two.points)


def test_of_several_models_the_largest_is_taken(tmp_path: Path) -> None:
    write_colmap_txt(tmp_path)
    shutil.copytree(tmp_path / "sparse/0", tmp_path / "sparse/1")
    lines = (tmp_path / "sparse/0/images.txt").read_text().splitlines()
    (tmp_path / "sparse/0/images.txt").write_text("\n".join(lines[:5]) + "\n")
    capture = open_capture(tmp_path)
    assert len(capture.frames) == 5
    assert capture.warnings == (
        "of several models that in sparse/1 is used, which 5 images fit; not used: sparse/0 (2 images, 2 of which fit)",
    )
    (tmp_path / "sparse/0/images.txt").write_text("a b c")
    assert "the model in sparse/0 is not used" in open_capture(tmp_path).warnings[0]


def test_missing_and_unregistered_pictures_are_counted(tmp_path: Path) -> None:
    write_colmap_bin(tmp_path)
    (tmp_path / "images/view 3.png").rename(tmp_path / "images/other.png")
    capture = open_capture(tmp_path)
    names = capture.extra.pop(MODEL_NAMES)
    assert capture.extra == {"listed": 5, "missing": 1, "unregistered": 1}
    assert set(names) == {frame.name for frame in capture.frames}
    assert all(frame.image.as_posix().endswith(names[frame.name]) for frame in capture.frames)
    assert len(capture.warnings) == 2
    for path in (tmp_path / "images").iterdir():
        path.unlink()
    with pytest.raises(InputError, match="none of the 5 images"):
        read_colmap(tmp_path)


def test_smaller_pictures_scale_the_camera(tmp_path: Path) -> None:
    write_colmap_bin(tmp_path)
    for index, eye in enumerate(eyes()):
        save_picture(tmp_path / f"images/view {index}.png", render(eye, half_size(OFF_CENTRE))[0])
    capture = open_capture(tmp_path)
    assert pixel_error(capture, eyes(), half_size(OFF_CENTRE)) < 1e-3
    assert "scaled to fit" in capture.warnings[0]


def rename_images(root: Path, new: str) -> None:
    path = root / "sparse/0/images.txt"
    path.write_text(re.sub(r"view (\d)\.png", lambda found: new.format(found[1]), path.read_text()))


@pytest.mark.parametrize("name", ["view_{}.png", "of_day_1/view_{}.png", "of_day_1\\view_{}.png", "of day 1\\view {}.png"])
def test_names_as_other_programs_write_them(tmp_path: Path, name: str) -> None:
    write_colmap_txt(tmp_path)
    rename_images(tmp_path, name)
    if "day" in name:
        (tmp_path / "images").rename(tmp_path / "pictures")
        (tmp_path / "images").mkdir()
        (tmp_path / "pictures").rename(tmp_path / "images/of day  1")
        if " " in name:
            (tmp_path / "images/of day  1").rename(tmp_path / "images/of day 1")
    capture = open_capture(tmp_path)
    assert pixel_error(capture, eyes(), OFF_CENTRE) < 1e-3
    assert capture.warnings == ()


def test_an_underscore_stands_for_a_space_only_where_one_picture_fits(tmp_path: Path) -> None:
    write_colmap_txt(tmp_path)
    rename_images(tmp_path, "view_{}.png")
    shutil.copy(tmp_path / "images/view 1.png", tmp_path / "images/view  1.png")
    (tmp_path / "images/view 2.png").rename(tmp_path / "images/view_2.png")
    shutil.copy(tmp_path / "images/view_2.png", tmp_path / "images/view 2.png")
    capture = open_capture(tmp_path)
    assert [frame.image.name for frame in capture.frames] == ["view 0.png", "view 3.png", "view 4.png", "view_2.png"]
    assert capture.extra["missing"] == 1
    path = tmp_path / "sparse/0/images.txt"
    path.write_text(path.read_text().replace("view_0.png", "view 3.png"))  # named as it is: not another image's
    assert [frame.image.name for frame in open_capture(tmp_path).frames] == ["view 3.png", "view 4.png", "view_2.png"]


def test_a_link_among_names_with_spaces_leads_nowhere_else(tmp_path: Path) -> None:
    write_colmap_txt(tmp_path / "in")
    rename_images(tmp_path / "in", "view_{}.png")
    (tmp_path / "in/images/view 0.png").rename(tmp_path / "other.png")
    (tmp_path / "in/images/view 0.png").symlink_to(tmp_path / "other.png")
    with pytest.raises(InputError, match="outside the capture folder"):
        open_capture(tmp_path / "in")


def test_a_principal_point_far_outside_is_refused(tmp_path: Path) -> None:
    """Just beside it is well: images are cropped."""
    write_colmap_txt(tmp_path)
    path = tmp_path / "sparse/0/cameras.txt"
    path.write_text("7 PINHOLE 80 60 71 73 100 27.5\n")
    assert open_capture(tmp_path).frames[0].intrinsics.cx == 100
    path.write_text("7 PINHOLE 80 60 71 73 169 110\n")
    with pytest.raises(InputError, match=r"cameras\.txt, camera 7: the principal point \(169, 110\) lies outside the 80×60 picture"):
        open_capture(tmp_path)


def test_a_name_that_leads_outside_is_not_read(tmp_path: Path) -> None:
    write_colmap_txt(tmp_path / "in")
    shutil.copy(tmp_path / "in/images/view 0.png", tmp_path / "view 0.png")
    (tmp_path / "in/images/view 0.png").unlink()
    path = tmp_path / "in/sparse/0/images.txt"
    path.write_text(path.read_text().replace("view 0.png", "../../view 0.png"))
    capture = open_capture(tmp_path / "in")
    assert [frame.name for frame in capture.frames] == ["view 1", "view 2", "view 3", "view 4"]
    assert capture.warnings == ("1 of the 5 images of the model do not exist; the other 4 are used",)


def move(root: Path, *moves: tuple[str, str]) -> None:
    for old, new in moves:
        (root / new).parent.mkdir(parents=True, exist_ok=True)
        (root / old).rename(root / new)


@pytest.mark.parametrize(
    ("moves", "said"),
    [
        ([("images", "images_4")], "found in images_4"),
        ([("images", "photos of day 1")], "found in photos of day 1"),
        ([("images", "taken"), ("sparse", "workspace/sparse")], "found in taken"),
        ([("images", "images/kitchen")], "found in images/kitchen"),
        ([("sparse/0", "out/model")], "the COLMAP model was found in out/model"),
        ([("images", "dense/0/images"), ("sparse/0", "dense/0/sparse")], None),
        ([("images", "scene/images"), ("sparse", "scene/sparse")], "the capture was found in scene"),
        ([("sparse/0", "distorted/sparse/1")], None),
        ([("sparse/0", "dense/0")], "the COLMAP model was found in dense/0"),
        ([("sparse/0", "dense/sparse")], None),
        ([("sparse/0", "dense/0"), ("images", "dense/0/images")], "the capture was found in dense/0"),
    ],
)
def test_where_models_and_images_are_found(tmp_path: Path, moves: list[tuple[str, str]], said: str | None) -> None:
    write_colmap_txt(tmp_path)
    if moves == [("images", "images/kitchen")]:
        moves = [("images", "pictures"), ("pictures", "images/kitchen")]
    move(tmp_path, *moves)
    capture = open_capture(tmp_path)
    assert pixel_error(capture, eyes(), OFF_CENTRE) < 1e-3
    assert (said is None and capture.warnings == ()) or any(said in warning for warning in capture.warnings)


def test_the_model_is_taken_whose_sizes_fit(tmp_path: Path) -> None:
    """As undistorting leaves it: one model is of photos that are not there, whose names are the same."""
    write_colmap_txt(tmp_path)
    move(tmp_path, ("images", "dense/0/images"))
    shutil.copytree(tmp_path / "sparse/0", tmp_path / "dense/0/sparse")
    (tmp_path / "sparse/0/cameras.txt").write_text("7 PINHOLE 400 300 500 500 200 150\n")  # of the same shape
    captures = [candidate_capture(tmp_path, candidate) for candidate in candidate_models(tmp_path)]
    assert pixel_error(captures[0], eyes(), OFF_CENTRE) < 1e-3
    assert "dense/0/sparse is used" in captures[0].warnings[0]
    assert "not used: sparse/0 (5 images, 5 of which fit)" in captures[0].warnings[0]
    assert captures[1].frames[0].intrinsics.fx == pytest.approx(100)


def test_images_of_one_name_in_two_folders_are_not_guessed(tmp_path: Path) -> None:
    write_colmap_txt(tmp_path)
    shutil.copytree(tmp_path / "images", tmp_path / "cam2")
    move(tmp_path, ("images", "cam1"))
    with pytest.raises(InputError, match=r"in cam1/ or in cam2/"):
        open_capture(tmp_path)
    (tmp_path / "cam2/view 4.png").unlink()
    assert open_capture(tmp_path).frames[0].image.parent.name == "cam1", "it alone has all"


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_every_truncation_and_every_huge_count_is_refused(tmp_path: Path, name: str) -> None:
    write_colmap_bin(tmp_path)
    path = tmp_path / "sparse/0" / name
    whole = path.read_bytes()
    for length in range(0, len(whole), 3):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError, match=re.escape(name)):
            read_model(path.parent)
    for count in (len(whole), 2**40, 2**64 - 1):
        path.write_bytes(struct.pack("<Q", count) + whole[8:])
        with pytest.raises(InputError, match="ends before its own counts"):
            read_model(path.parent)


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        ("images.txt", " 7 view 0.png", " 8 view 0.png", "uses camera 8"),
        ("images.txt", " 7 view 0.png", " seven view 0.png", "line 2 cannot be read"),
        ("images.txt", "view 1.png", "view 0.png", "listed twice"),
        ("cameras.txt", "PINHOLE", "PINHOLES", "image_undistorter"),
        ("cameras.txt", "71.0", "-71.0", "must be positive"),
        ("cameras.txt", "71.0", "nan", "not finite"),
        ("cameras.txt", " 71.0", "", "has 4 parameters, not 3"),
        ("cameras.txt", "80 60", "0 60", "image size"),
        ("points3D.txt", "1.2", "high", "line 1 cannot be read"),
    ],
)
def test_broken_text_is_refused(tmp_path: Path, name: str, old: str, new: str, message: str) -> None:
    write_colmap_txt(tmp_path)
    path = tmp_path / "sparse/0" / name
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(InputError, match=message):
        open_capture(tmp_path)


@pytest.mark.parametrize("numbers", ["0 0 0 0 1 2 3", "1 0 0 0 1e200 2 3", "nan 0 0 0 1 2 3", "1 0 0 0 inf 2 3"])
def test_poses_that_are_none(tmp_path: Path, numbers: str) -> None:
    write_colmap_txt(tmp_path)
    path = tmp_path / "sparse/0/images.txt"
    lines = path.read_text().splitlines()
    lines[1] = f"1 {numbers} 7 view 0.png"
    path.write_text("\n".join(lines))
    with pytest.raises(InputError, match=r"view 0\.png"):
        open_capture(tmp_path)


def test_a_model_without_images(tmp_path: Path) -> None:
    write_colmap_txt(tmp_path)
    (tmp_path / "sparse/0/images.txt").write_text("# nothing\n")
    with pytest.raises(InputError, match="no registered images"):
        open_capture(tmp_path)


def test_quaternions_of_any_length_are_rotations(tmp_path: Path) -> None:
    write_colmap_txt(tmp_path)
    (tmp_path / "sparse/0/images.txt").write_text("1 2 0 0 0 0 0 -5 7 view 0.png\n")
    frame = open_capture(tmp_path).frames[0]
    np.testing.assert_allclose(frame.world_from_camera, [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 5], [0, 0, 0, 1]])
    assert frame.intrinsics == Intrinsics(80, 60, 71.0, 73.0, 42.25, 27.5)
