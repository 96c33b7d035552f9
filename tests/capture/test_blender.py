"""NeRF-synthetic layout: splits, alpha, up."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from fieldfuse.capture import open_capture
from fieldfuse.capture.blender import read_blender
from fieldfuse.errors import InputError
from tests.capture.layouts import write_blender
from tests.conftest import shared_data


def test_splits_alpha_and_up(tmp_path: Path) -> None:
    write_blender(tmp_path)
    capture = open_capture(tmp_path)
    assert {frame.name: frame.split for frame in capture.frames} == {
        "test_r_0": "test", "test_r_1": "test", "train_r_0": "train", "train_r_1": "train", "train_r_2": "train",
    }  # fmt: skip
    assert capture.alpha
    assert capture.up == (0, 0, 1)
    assert capture.extra == {"listed": 5, "missing": 0}


def test_val_is_the_test_only_when_there_is_none(tmp_path: Path) -> None:
    write_blender(tmp_path)
    test = tmp_path / "transforms_test.json"
    val = json.loads(test.read_text())
    val["frames"] = val["frames"][:1]
    (tmp_path / "transforms_val.json").write_text(json.dumps(val))
    assert sum(frame.split == "test" for frame in read_blender(tmp_path).frames) == 2
    test.unlink()
    assert sum(frame.split == "test" for frame in read_blender(tmp_path).frames) == 1
    (tmp_path / "transforms_val.json").unlink()
    assert {frame.split for frame in read_blender(tmp_path).frames} == {"train"}


def test_images_in_both_splits_are_held_out(tmp_path: Path) -> None:
    write_blender(tmp_path)
    train, test = (json.loads((tmp_path / f"transforms_{split}.json").read_text()) for split in ("train", "test"))
    train["frames"].append(test["frames"][0])
    (tmp_path / "transforms_train.json").write_text(json.dumps(train))
    assert [frame.split for frame in read_blender(tmp_path).frames] == ["test", "test", "train", "train", "train"]
    (tmp_path / "transforms_test.json").write_text(json.dumps(train))
    assert {frame.split for frame in read_blender(tmp_path).frames} == {None}, "no split at all: every eighth is held out"


def test_missing_pictures_are_counted(tmp_path: Path) -> None:
    write_blender(tmp_path)
    read_blender(tmp_path).frames[0].image.unlink()
    capture = read_blender(tmp_path)
    assert capture.extra == {"listed": 5, "missing": 1}
    assert capture.warnings == ("1 of the 5 listed images do not exist; the other 4 are used",)
    for frame in capture.frames:
        frame.image.unlink()
    with pytest.raises(InputError, match="none of the 5 images"):
        read_blender(tmp_path)


def test_lego_has_the_published_focal_length_at_half_size() -> None:
    capture = open_capture(shared_data("lego_400"))
    assert capture.kind == "blender"
    assert [sum(frame.split == split for frame in capture.frames) for split in ("train", "test")] == [100, 25]
    assert capture.frames[0].intrinsics.fx == pytest.approx(1111.111 / 2, rel=1e-5)
    assert capture.alpha
