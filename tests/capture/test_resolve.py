"""Listed files: found by what remains of their paths, never outside the folder, never by a guess between two."""

from __future__ import annotations

import time
import unicodedata
from pathlib import Path

import pytest

from fieldfuse.capture import resolve
from fieldfuse.capture.resolve import DEPTH, MASK, POINTS, CaptureFiles
from fieldfuse.errors import InputError


def put(root: Path, *names: str) -> None:
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(b"x")


def found(root: Path, *names: str, **options: object) -> list[str | None]:
    files = CaptureFiles(root).find(names, source="a.json", **options).files
    return [None if path is None else path.relative_to(root.resolve()).as_posix() for path in files]


@pytest.mark.parametrize(
    "listed",
    [
        "images/a b.jpg",
        "./images/a b.jpg",
        "images//../images/a b.jpg",
        "images\\a b.jpg",
        ".\\images/a b.jpg",
        "images/a b",
        "images/a%20b.jpg",
        "images/a_b.jpg",
        "IMAGES/A B.JPG",
        "images/a b.JPEG",
        "images/a b.png",
        "images_8/a b.jpg",
        "a b.jpg",
        "../data/images/a b.jpg",
        "/home/me/data/images/a b.jpg",
        "C:\\data\\images\\a b.jpg",
        "\\\\server\\share\\images\\a b.jpg",
        "file:///data/images/a%20b.jpg",
        "pictures/a b.jpg",
        "images/kitchen/a b.jpg",
    ],
)
@pytest.mark.parametrize("base", ["", "images"])
def test_one_image_in_all_spellings(tmp_path: Path, listed: str, base: str) -> None:
    put(tmp_path, "images/a b.jpg", "images/c.jpg", "masks/a b.jpg", "thumbs/a b.jpg", ".cache/images/a b.jpg", "__MACOSX/images/a b.jpg")
    assert found(tmp_path, listed, base=base) == ["images/a b.jpg"]


@pytest.mark.parametrize("form", ["NFC", "NFD"])
def test_composed_and_decomposed_letters(tmp_path: Path, form: str) -> None:
    put(tmp_path, unicodedata.normalize(form, "Küche/Bäder 1.jpg"))
    other = unicodedata.normalize("NFD" if form == "NFC" else "NFC", "Küche/Bäder 1.jpg")
    assert found(tmp_path, other) == [unicodedata.normalize(form, "Küche/Bäder 1.jpg")]


def test_images_beside_the_json_and_in_folders_of_other_names(tmp_path: Path) -> None:
    put(tmp_path, "1.jpg", "2.jpg", "notes.txt")
    result = CaptureFiles(tmp_path).find(["images/1.png", "images/2.png", "images/3.png"], source="a.json")
    assert [path and path.name for path in result.files] == ["1.jpg", "2.jpg", None]
    assert result.remarks == ["2 images were found by their names in ./, where a.json does not list them"]
    put(tmp_path / "b", "images/day/1.jpg", "images/day/2.jpg")
    assert found(tmp_path / "b", "images/1.jpg", "images/2.jpg") == ["images/day/1.jpg", "images/day/2.jpg"]


def test_what_was_split_into_folders_is_joined(tmp_path: Path) -> None:
    put(tmp_path, "day1/1.jpg", "day1/2.jpg", "day2/3.jpg")
    assert found(tmp_path, "all/1.jpg", "all/2.jpg", "all/3.jpg") == ["day1/1.jpg", "day1/2.jpg", "day2/3.jpg"]


def test_the_longest_tail_goes_first(tmp_path: Path) -> None:
    put(tmp_path, "cam1/rgb/1.jpg", "cam2/rgb/1.jpg", "rgb2/1.jpg")
    assert found(tmp_path, "/data/cam1/rgb/1.jpg", "/data/cam2/rgb/1.jpg") == ["cam1/rgb/1.jpg", "cam2/rgb/1.jpg"]


def test_one_folder_has_to_serve_all(tmp_path: Path) -> None:
    put(tmp_path, "cam1/1.jpg", "cam1/2.jpg", "cam2/1.jpg")
    assert found(tmp_path, "x/1.jpg", "x/2.jpg") == ["cam1/1.jpg", "cam1/2.jpg"]
    put(tmp_path, "cam2/3.jpg")
    with pytest.raises(InputError, match=r"'x/1\.jpg', listed in a\.json, may be the one in cam1/ or in cam2/"):
        found(tmp_path, "x/1.jpg", "x/2.jpg", "x/3.jpg")
    with pytest.raises(InputError, match="cam1/ or in cam2/"):
        found(tmp_path, "1.jpg")


def test_of_the_same_images_in_several_sizes_the_largest_are_taken(tmp_path: Path) -> None:
    put(tmp_path, "images_8/1.jpg", "images_2/1.jpg", "images_4/1.jpg", "input/1.jpg")
    assert found(tmp_path, "images/1.jpg") == ["images_2/1.jpg"]
    put(tmp_path, "images/1.jpg")
    assert found(tmp_path, "images_16/1.jpg") == ["images/1.jpg"]


def test_names_that_differ_in_case_only_are_not_guessed(tmp_path: Path) -> None:
    put(tmp_path, "a.jpg", "A.jpg")
    assert found(tmp_path, "a.jpg", "A.jpg") == ["a.jpg", "A.jpg"]
    with pytest.raises(InputError, match=r"A\.jpg or a\.jpg"):
        found(tmp_path, "A.JPG")


def test_a_file_serves_one_name(tmp_path: Path) -> None:
    put(tmp_path, "images/1.jpg", "train/r_0.png", "images/b c.jpg")
    assert found(tmp_path, "images/1.jpg", "images/1.png", "images/1.jpg") == ["images/1.jpg", None, "images/1.jpg"]
    assert found(tmp_path, "train/r_0", "test/r_0") == ["train/r_0.png", None]
    assert found(tmp_path, "images/b_c.jpg", "images/b c.jpg") == [None, "images/b c.jpg"]


def test_a_name_of_two_listed_folders_needs_the_folder(tmp_path: Path) -> None:
    put(tmp_path, "all/1.jpg", "all/2.jpg")
    assert found(tmp_path, "cam1/1.jpg", "cam2/1.jpg", "cam1/2.jpg") == [None, None, "all/2.jpg"]
    put(tmp_path, "x/cam2/1.jpg")
    assert found(tmp_path, "cam1/1.jpg", "cam2/1.jpg") == [None, "x/cam2/1.jpg"]


def test_what_is_gone_is_not_taken_from_elsewhere(tmp_path: Path) -> None:
    """Where others of its folder are in their place: an image of its name in another folder is another one."""
    put(tmp_path, "images/1.jpg", "old/2.jpg", "renders/2.jpg")
    assert found(tmp_path, "images/1.jpg", "images/2.jpg") == ["images/1.jpg", None]
    assert found(tmp_path, "/a/images/1.jpg", "/a/images/2.jpg") == ["images/1.jpg", None]


def test_a_runs_own_folder_is_none_of_the_capture(tmp_path: Path) -> None:
    put(tmp_path, "out/run.json", "out/renders/1.jpg")
    assert found(tmp_path, "images/1.jpg") == [None]


def test_depth_masks_and_points(tmp_path: Path) -> None:
    put(tmp_path, "images/1.png", "masks/1.png", "depths/1.png", "points.ply")
    images = {tmp_path.resolve() / "images/1.png"}
    assert found(tmp_path, "/a/depth/1.png", kind=DEPTH, taken=images) == ["depths/1.png"]
    assert found(tmp_path, "/a/seg/1.png", kind=MASK, taken=images) == ["masks/1.png"]
    assert found(tmp_path, "/a/points.ply", kind=POINTS) == ["points.ply"]
    (tmp_path / "depths/1.png").unlink()
    assert found(tmp_path, "depth/1.png", kind=DEPTH, taken=images) == [None]


@pytest.mark.parametrize("listed", ["../other/1.jpg", "{}/other/1.jpg", "images/../../other/1.jpg"])
def test_nothing_outside_is_found(tmp_path: Path, listed: str) -> None:
    put(tmp_path, "other/1.jpg", "in/images/2.jpg")
    result = CaptureFiles(tmp_path / "in").find([listed.format(tmp_path)], source="a.json")
    assert (result.files, result.outside) == ([None], 1)


@pytest.mark.parametrize("link", ["in/images", "in/images/1.jpg"])
def test_a_link_that_leads_outside(tmp_path: Path, link: str) -> None:
    put(tmp_path, "other/1.jpg", "in/x")
    (tmp_path / link).parent.mkdir(exist_ok=True)
    (tmp_path / link).symlink_to(tmp_path / ("other" if link.endswith("images") else "other/1.jpg"))
    for listed in ("images/1.jpg", "/a/images/1.jpg"):
        try:
            assert found(tmp_path / "in", listed) == [None]
        except InputError as error:
            assert "leads outside the capture folder" in str(error)


def test_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    put(tmp_path, *(f"{i}/image.jpg" for i in range(400)), "/".join("d" * 12) + "/deep.jpg")
    started = time.process_time()
    listed = [f"/a/{i}/image.jpg" for i in range(400)]
    assert found(tmp_path, *listed) == [f"{i}/image.jpg" for i in range(400)]
    assert found(tmp_path, "x/deep.jpg") == [None]
    assert time.process_time() - started < 5
    monkeypatch.setattr(resolve, "MAX_PLACES", 100)
    with pytest.raises(InputError, match="too many files"):
        found(tmp_path, *(f"/b{i}/image.jpg" for i in range(9)))
    monkeypatch.setattr(resolve, "MAX_FILES", 10)
    assert sum(path is not None for path in CaptureFiles(tmp_path).find(listed[:1] * 2 + ["/q/no.jpg"], source="a").files) <= 2
