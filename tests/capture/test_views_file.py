"""Views as a file: there and back, damaged and tampered files refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from fieldfuse.camera import OPENCV, Intrinsics, Similarity
from fieldfuse.capture.prepare import prepare_views
from fieldfuse.capture.storage import load_views, save_views
from fieldfuse.capture.types import Views
from fieldfuse.config import CaptureSettings
from fieldfuse.errors import InputError, OutputError
from fieldfuse.tone import Tone
from tests.capture.board import capture_of, posed, save, texture

PLAIN = Intrinsics(480, 360, 400.0, 396.0, 236.5, 183.25)
BARREL = Intrinsics(480, 360, 400.0, 396.0, 236.5, 183.25, OPENCV, (-0.18, 0.04, 0.002, -0.0015))


def some_views(tmp_path: Path) -> Views:
    rgba = np.dstack([texture(36, 48), np.full((36, 48), 255, np.uint8)])
    rgba[:9, :, 3] = 0
    depth = save(tmp_path / "d.png", np.full((36, 48), 1500, np.uint16))
    frames = [
        posed(save(tmp_path / "a.png", rgba), BARREL, 0, depth=depth),
        posed(save(tmp_path / "b.png", rgba[:, :, :3]), PLAIN, 1),
        posed(save(tmp_path / "c.png", texture(60, 80, 5)), PLAIN, 2),
    ]
    return prepare_views(capture_of(tmp_path, frames, alpha=True), Similarity.identity(), CaptureSettings(holdout=2))


def same(a: list, b: list) -> bool:
    return all(
        (x is None) == (y is None) and (x is None or (x.dtype == y.dtype and np.array_equal(x, y))) for x, y in zip(a, b, strict=True)
    )


def test_views_survive_the_file(tmp_path: Path) -> None:
    views = replace(some_views(tmp_path), weight=[1.0, 0.25, 0.5])
    save_views(tmp_path / "run" / "views.safetensors", views)
    back = load_views(tmp_path / "run" / "views.safetensors")
    assert back.names == ["a", "b", "c"] == views.names and back.intrinsics == views.intrinsics and back.background == (1.0, 1.0, 1.0)
    assert back.weight == [1.0, 0.25, 0.5]
    np.testing.assert_array_equal(back.world_from_camera, views.world_from_camera)
    np.testing.assert_array_equal(back.test, [True, False, True])
    for name in ("images", "valid", "alpha", "depths"):
        assert same(getattr(back, name), getattr(views, name)), name
    assert [value is None for value in back.alpha] == [False, True, True]
    assert [path.name for path in (tmp_path / "run").iterdir()] == ["views.safetensors"]


def test_photos_and_what_was_taken_out_of_them_survive(tmp_path: Path) -> None:
    plain = some_views(tmp_path)
    tones = [Tone((1.5, 1.25, 1.0), 0.6), None, Tone((0.5, 0.5, 0.5))]
    views = replace(plain, photos=[plain.images[0], None, None], tones=tones)
    save_views(tmp_path / "v.safetensors", views)
    back = load_views(tmp_path / "v.safetensors")
    assert back.tones == tones and same(back.photos, views.photos) and np.array_equal(back.photo(0), plain.images[0])
    data = (tmp_path / "v.safetensors").read_bytes()
    for bad in (data.replace(b"[1.5, 1.25, 1.0]", b"[1.5, 1.25, -1.]"), data.replace(b"[1.5, 1.25, 1.0]", b"[1.5, 1.25     ]")):
        assert bad != data
        (tmp_path / "v.safetensors").write_bytes(bad)
        with pytest.raises(InputError, match="damaged"):
            load_views(tmp_path / "v.safetensors")


def test_views_without_optional_lists_survive(tmp_path: Path) -> None:
    views = some_views(tmp_path)
    bare = Views(views.names, views.images, views.intrinsics, views.world_from_camera, views.test)
    save_views(tmp_path / "v.safetensors", bare)
    back = load_views(tmp_path / "v.safetensors")
    assert back.depths == [None] * 3 and back.background is None and back.weight == [] and len(back.subset([2])) == 1


def test_damaged_and_tampered_views_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "v.safetensors"
    with pytest.raises(InputError, match="no prepared views"):
        load_views(path)
    save_views(path, replace(some_views(tmp_path), weight=[1.0, 0.25, 0.5]))
    data = path.read_bytes()
    for bad in (
        data[: len(data) // 2],
        b"",
        b"\xff" * 64,
        data.replace(b'\\"width\\": 48', b'\\"width\\": 47'),
        data.replace(b'\\"fx\\": 40.0', b'\\"fx\\": -9.0'),
        data.replace(b"[1.0, 0.25, 0.5]", b"[1.0, 0.25, 1.5]"),
        data.replace(b"[1.0, 0.25, 0.5]", b"[1.0, 0.25     ]"),
    ):
        assert bad != data
        path.write_bytes(bad)
        with pytest.raises(InputError, match=r"v\.safetensors"):
            load_views(path)
    tensors = load_file(save_back(path, data))
    for change in ({"image.1": tensors["image.1"][:-1]}, {"test": tensors["test"][:2]}, {"image.0": tensors["image.0"].astype(np.float32)}):
        save_file({**tensors, **change}, path, metadata=metadata_of(data))
        with pytest.raises(InputError, match="damaged"):
            load_views(path)
    missing = {name: value for name, value in tensors.items() if name != "image.2"}
    save_file(missing, path, metadata=metadata_of(data))
    with pytest.raises(InputError, match="damaged"):
        load_views(path)
    save_file(tensors, path, metadata={**metadata_of(data), "version": "99"})
    with pytest.raises(InputError, match="version"):
        load_views(path)
    save_file({**tensors, "world_from_camera": tensors["world_from_camera"] * np.nan}, path, metadata=metadata_of(data))
    with pytest.raises(InputError, match="damaged"):
        load_views(path)


def save_back(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


def metadata_of(data: bytes) -> dict[str, str]:
    length = int.from_bytes(data[:8], "little")
    found = json.loads(data[8 : 8 + length])["__metadata__"]
    assert isinstance(found, dict)
    return found


def test_an_unwritable_place_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OutputError, match="cannot write"):
        save_views(tmp_path / "file" / "views.safetensors", some_views(tmp_path))
