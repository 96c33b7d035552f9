"""OpenEXR files: which channels are read, windows, damaged and impossible ones. Written by OpenEXR's own package."""

from __future__ import annotations

import json
import struct
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fieldfuse.camera import Array
from fieldfuse.capture import open_capture
from fieldfuse.capture.archive import read_bytes
from fieldfuse.capture.exr import read_exr
from fieldfuse.capture.headers import image_header, read_header
from fieldfuse.capture.images import load_depth
from fieldfuse.errors import InputError
from tests.pipelines.made import make_room

OpenEXR = pytest.importorskip("OpenEXR")
HEIGHT, WIDTH = 6, 9


def write_exr(path: Path, channels: dict[str, Array], **header: Any) -> Path:
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **header}, dict(channels)).write(str(path))
    return path


def planes(names: str, kind: type = np.float32) -> dict[str, Array]:
    grid = np.arange(HEIGHT * WIDTH, dtype=np.float32).reshape(HEIGHT, WIDTH)
    return {name: (grid / 8 + 100 * index).astype(kind) for index, name in enumerate(names.split())}


@pytest.mark.parametrize("kind", [np.float32, np.float16, np.uint32])
def test_colours_come_as_stored_whatever_their_type(kind: type, tmp_path: Path) -> None:
    stored = planes("R G B A", kind)
    image = read_exr(write_exr(tmp_path / "a.exr", stored))
    assert image.dtype == np.float32 and np.array_equal(image, np.stack([stored[name] for name in "RGBA"], axis=2).astype(np.float32))


def test_one_channel_is_a_map(tmp_path: Path) -> None:
    stored = planes("Y")
    assert np.array_equal(read_exr(write_exr(tmp_path / "a.exr", stored)), stored["Y"])
    assert np.array_equal(read_exr(write_exr(tmp_path / "a.exr", stored), depth=True), stored["Y"])


def test_of_a_renderers_layers_the_picture_or_the_depth_is_taken(tmp_path: Path) -> None:
    layers = ("Normal.R", "Normal.G", "Normal.B", "Combined.R", "Combined.G", "Combined.B")
    stored = planes(" ".join(f"ViewLayer.{layer}" for layer in layers))
    stored |= {"ViewLayer.Depth.Z": planes("a b")["b"]}
    path = write_exr(tmp_path / "a.exr", stored)
    assert np.array_equal(read_exr(path)[..., 0], stored["ViewLayer.Combined.R"])
    assert np.array_equal(read_exr(path, depth=True), stored["ViewLayer.Depth.Z"])
    assert image_header(path).size == (WIDTH, HEIGHT)


def test_where_nothing_is_depth_is_0(tmp_path: Path) -> None:
    depth = planes("Z")["Z"] + 1
    depth[0, :3] = 1e10, np.inf, np.nan
    assert not read_exr(write_exr(tmp_path / "a.exr", {"Z": depth}), depth=True)[0, :3].any()


def test_depth_saved_as_grey_colours_is_read_and_colours_are_not_depth(tmp_path: Path) -> None:
    depth = planes("Z")["Z"]
    assert np.array_equal(read_exr(write_exr(tmp_path / "a.exr", dict.fromkeys("RGB", depth)), depth=True), depth)
    with pytest.raises(InputError, match="coloured image where depth is expected"):
        read_exr(write_exr(tmp_path / "b.exr", planes("R G B")), depth=True)


def test_channels_that_are_no_image_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no image \(.*it has motion\.x, motion\.y"):
        read_exr(write_exr(tmp_path / "a.exr", planes("motion.x motion.y")))


def test_other_primaries_become_srgbs(tmp_path: Path) -> None:
    """ITU-R BT.2020's white and red, by the matrices of ITU-R BT.2087 and IEC 61966-2-1; sRGB's own stay exactly as they are."""
    colours = {"R": np.float32([[1, 1]]), "G": np.float32([[1, 0]]), "B": np.float32([[1, 0]])}
    bt2020 = (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.3290)
    image = read_exr(write_exr(tmp_path / "a.exr", colours, chromaticities=bt2020))
    assert image[0] == pytest.approx(np.array([[1, 1, 1], [1.6605, -0.1246, -0.0182]]), abs=1e-3)
    srgb = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
    stored = planes("R G B")
    assert np.array_equal(read_exr(write_exr(tmp_path / "b.exr", stored, chromaticities=srgb))[..., 2], stored["B"])
    image = read_exr(write_exr(tmp_path / "c.exr", stored, chromaticities=(0.0,) * 8))
    assert np.array_equal(image[..., 0], stored["R"])


def window(left: int, top: int, right: int, bottom: int) -> tuple[Array, Array]:
    return np.array([left, top], np.int32), np.array([right, bottom], np.int32)


def test_a_part_that_was_rendered_stands_where_it_belongs(tmp_path: Path) -> None:
    """The display window is the image; the data window may be smaller, or larger, and lie anywhere."""
    stored = planes("R G B")
    where = {"dataWindow": window(-2, 3, WIDTH - 3, HEIGHT + 2), "displayWindow": window(0, 0, 11, 9)}
    image = read_exr(path := write_exr(tmp_path / "a.exr", stored, **where))
    assert image.shape == (10, 12, 3) and image_header(path).size == (12, 10)
    assert np.array_equal(image[3:9, :7, 1], stored["G"][:, 2:])
    assert not image[:3].any() and not image[9:].any() and not image[:, 7:].any()


def test_damage_is_one_sentence_and_nothing_on_stdout(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_exr(tmp_path / "a.exr", {"Z": np.random.default_rng(0).integers(0, 9, (64, 64)).astype(np.float32)})
    whole = path.read_bytes()
    for data in (whole[:40], whole[: len(whole) // 2], whole[:600] + bytes(40) + whole[640:]):
        path.write_bytes(data)
        with pytest.raises(InputError, match=r"a\.exr \(OpenEXR\) is damaged or cut short"):
            read_exr(path)
    assert not capsys.readouterr().out


def test_impossible_sizes_are_refused_before_memory_is_taken(tmp_path: Path) -> None:
    path = write_exr(tmp_path / "a.exr", planes("R G B"))
    data = path.read_bytes()
    small, large = struct.pack("<4i", 0, 0, WIDTH - 1, HEIGHT - 1), struct.pack("<4i", 0, 0, 49_999, 49_999)
    path.write_bytes(data.replace(small, large))
    with pytest.raises(InputError, match="more than 1 GB of values"):
        read_header(read_bytes(path), path)
    path.write_bytes(data.replace(small, struct.pack("<4i", 0, 0, -5, 2**31 - 2)))
    with pytest.raises(InputError):
        read_exr(path)


def exr_room(folder: Path) -> Path:
    """A capture of `transforms.json` whose depth is OpenEXR in metres."""
    make_room(folder)
    path = folder / "transforms.json"
    data = json.loads(path.read_text())
    for number, entry in enumerate(data["frames"]):
        depth = np.full((data["h"], data["w"]), 1 + number / 4, np.float32)
        write_exr(folder / f"{number}.exr", {"Z": depth})
        entry["depth_file_path"] = f"{number}.exr"
    path.write_text(json.dumps(data))
    return folder


def test_a_captures_depth_may_be_openexr(tmp_path: Path) -> None:
    capture = open_capture(exr_room(tmp_path / "room"))
    assert [float(load_depth(frame, capture).mean()) for frame in capture.frames[:3]] == [1.0, 1.25, 1.5]


def test_without_the_package_a_sentence_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    room = exr_room(tmp_path / "room")
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    with pytest.raises(InputError, match=r'OpenEXR, which needs .* \(pip install "fieldfuse\[exr\]"\), or write depth as 16-bit PNG'):
        open_capture(room)
