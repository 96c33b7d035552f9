"""ScanNet's `.sens` files: the same capture as what is exported of them, taken apart for a run, and files that are damaged or made up."""

from __future__ import annotations

import struct
import zlib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks.protocols import suite_of
from fieldfuse.camera import Similarity
from fieldfuse.capture import open_capture
from fieldfuse.capture.images import load_depth, load_image
from fieldfuse.capture.prepare import prepare_views
from fieldfuse.capture.scannet import read_scannet
from fieldfuse.capture.select import select_frames
from fieldfuse.capture.sens import scan
from fieldfuse.config import CaptureSettings
from fieldfuse.errors import InputError
from fieldfuse.nerfusion.training.scenes import scannet_folders, scannet_scene
from tests.capture.layouts import OFF_CENTRE, SCANNET_COLOUR, rows, sens_of, whole_centres, write_sens
from tests.capture.made import eyes, pixel_error, render

NAME = "scene0000_00.sens"
HEAD = 12 + len(b"StructureSensor")  # where the cameras begin
BODY = HEAD + 4 * 64 + 2 * 4 + 4 * 4 + 4 + 8  # and the first frame


def export(file: Path, root: Path) -> None:
    """What ScanNet's own reader writes of a file, as it says it does: frames by number, matrices as text."""
    found = scan(file)
    data = file.read_bytes()
    for folder in ("color", "depth", "pose", "intrinsic"):
        (root / folder).mkdir(parents=True)
    for index, (begin, picture, depth) in enumerate(found.places.tolist()):
        (root / f"color/{index}.jpg").write_bytes(data[begin : begin + picture])
        values = np.frombuffer(zlib.decompress(data[begin + picture : begin + picture + depth]), "<u2")
        assert cv2.imwrite(str(root / f"depth/{index}.png"), values.reshape(OFF_CENTRE.height, OFF_CENTRE.width))
        (root / f"pose/{index}.txt").write_text(rows(found.poses[index]))
    for name, camera in (("color", SCANNET_COLOUR), ("depth", OFF_CENTRE)):
        matrix = np.eye(4)
        matrix[:3, :3] = whole_centres(camera)
        (root / f"intrinsic/intrinsic_{name}.txt").write_text(rows(matrix))


def test_a_file_and_what_is_exported_of_it_are_one_capture(tmp_path: Path) -> None:
    write_sens(tmp_path / "scan")
    export(tmp_path / "scan" / NAME, tmp_path / "out")
    packed, loose = open_capture(tmp_path / "scan" / NAME), open_capture(tmp_path / "out")
    assert [frame.name for frame in packed.frames] == [frame.name for frame in loose.frames] == ["0", "1", "3", "4", "5"]
    assert packed.warnings == loose.warnings == ("1 frame left out because tracking was lost there (pose -inf or NaN)",)
    assert packed.extra == {**loose.extra, "fps": pytest.approx(30, abs=0.01)}
    facts = {"root": loose.root, "frames": loose.frames, "extra": loose.extra}
    assert replace(packed, **facts) == loose
    for one, other in zip(packed.frames, loose.frames, strict=True):
        np.testing.assert_allclose(one.world_from_camera, other.world_from_camera, atol=1e-11)
        assert (one.intrinsics, one.depth_intrinsics) == (other.intrinsics, other.depth_intrinsics)
        np.testing.assert_array_equal(load_image(one), load_image(other))
        np.testing.assert_array_equal(load_depth(one, packed), load_depth(other, loose))


def test_a_run_takes_out_what_it_needs_and_loses_nothing(tmp_path: Path) -> None:
    """Frames are chosen as those of a video; the JPEG and the depth of each are the file's own, and the views are the exported folder's."""
    write_sens(tmp_path / "scan")
    export(tmp_path / "scan" / NAME, tmp_path / "out")
    packed = open_capture(tmp_path / "scan")
    assert packed.filmed and packed.posed and packed.has_depth
    chosen = select_frames(packed, tmp_path / "run", CaptureSettings(max_frames=10))
    names = [int(frame.name.removeprefix("frame_")) for frame in chosen.frames]
    assert len(names) >= 3 and not chosen.filmed and set(names) <= {0, 1, 3, 4, 5}
    for index, frame in zip(names, chosen.frames, strict=True):
        assert frame.image.read_bytes() == (tmp_path / f"out/color/{index}.jpg").read_bytes()
        assert frame.depth == tmp_path.resolve() / f"run/frames/depth/frame_{index:06d}.png" and frame.depth.is_file()
    loose = open_capture(tmp_path / "out")
    same = loose.with_frames([frame for frame in loose.frames if int(frame.name) in names])
    settings = CaptureSettings(image_size=48)
    mine, theirs = (prepare_views(capture, Similarity.identity(), settings) for capture in (chosen, same))
    np.testing.assert_allclose(mine.world_from_camera, theirs.world_from_camera, atol=1e-11)
    for of_mine, of_theirs in zip([*mine.images, *mine.depths], [*theirs.images, *theirs.depths], strict=True):
        np.testing.assert_array_equal(of_mine, of_theirs)
    assert (mine.test == theirs.test).all()
    kept = {path: path.stat().st_mtime_ns for path in (tmp_path / "run").rglob("frame_*")}
    again = select_frames(packed, tmp_path / "run", CaptureSettings(max_frames=2))
    assert len(again.frames) == 2 and again.frames[0].depth in kept  # what is wanted stays as it is, the rest goes
    there = {path: path.stat().st_mtime_ns for path in (tmp_path / "run").rglob("frame_*")}
    assert len(there) == 4 and there.items() <= kept.items()


@pytest.mark.parametrize("codings", [(0, 0), (1, 1), (2, 0)])
def test_other_ways_to_pack(tmp_path: Path, codings: tuple[int, int]) -> None:
    picture, depth = render(eyes()[0], SCANNET_COLOUR)[0], (1000 * render(eyes()[0], OFF_CENTRE)[1]).round().astype("<u2")
    suffix = {1: ".png", 2: ".jpg"}.get(codings[0])
    data = picture.tobytes() if suffix is None else cv2.imencode(suffix, picture[..., ::-1])[1].tobytes()
    packed = depth.tobytes() if codings[1] == 0 else zlib.compress(depth.tobytes())
    (tmp_path / "a.sens").write_bytes(sens_of([(data, packed, eyes()[0].pose())], codings=codings))
    capture = open_capture(tmp_path / "a.sens")
    assert np.abs(load_image(capture.frames[0]).astype(int) - picture).mean() <= (6 if suffix == ".jpg" else 0)
    np.testing.assert_array_equal(load_depth(capture.frames[0], capture), depth.astype(np.float32) / np.float32(1000))


def made(path: Path) -> bytearray:
    write_sens(path.parent)
    return bytearray(path.read_bytes())


def packed(data: bytearray, at: int, kind: str, *values: float) -> bytes:
    struct.pack_into(kind, data, at, *values)
    return bytes(data)


HOSTILE = {
    "empty": (lambda data: b"", "is cut short"),
    "text": (lambda data: b"#!/bin/sh\necho this is no scan\n", "begins as none does"),
    "version 3": (lambda data: packed(data, 0, "<I", 3), "is one of version 3;"),
    "a name of 2^60 letters": (lambda data: packed(data, 4, "<Q", 2**60), "is no .sens file"),
    "ends in the header": (lambda data: bytes(data[: HEAD + 70]), "ends within its header"),
    "images of no known coding": (lambda data: packed(data, HEAD + 256, "<i", -1), "images in coding -1"),
    "depth of a maker's coding": (lambda data: packed(data, HEAD + 260, "<i", 2), "depth in coding 2, .*export color/"),
    "a billion pixels": (lambda data: packed(data, HEAD + 264, "<2I", 2**16, 2**14), "65536×16384 pixels"),
    "images of another shape": (lambda data: packed(data, HEAD + 264, "<2I", 96, 60), "frame 0: the image is 96×72 but .* 96×60"),
    "no width": (lambda data: packed(data, HEAD + 272, "<I", 0), "0×60 pixels"),
    "no unit of depth": (lambda data: packed(data, HEAD + 280, "<f", 0), "0 for each metre"),
    "2^60 frames": (lambda data: packed(data, HEAD + 284, "<Q", 2**60), f"announces {2**60} frames"),
    "two frames more": (lambda data: packed(data, HEAD + 284, "<Q", 8), "ends within frame 7 of 8"),
    "an image of 2^63 bytes": (lambda data: packed(data, BODY + 80, "<Q", 2**63), "ends within frame 0 of 6"),
    "ends in an image": (lambda data: bytes(data[: BODY + 500]), "ends within frame 0|bytes can hold"),
    "no focal length": (lambda data: packed(data, HEAD, "<f", 0), "the colour camera"),
    "no frame": (lambda data: packed(data, HEAD + 284, "<Q", 0), "holds no image"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_what_is_no_whole_file_is_refused_in_a_sentence(tmp_path: Path, case: str) -> None:
    change, said = HOSTILE[case]
    (tmp_path / NAME).write_bytes(change(made(tmp_path / NAME)))
    with pytest.raises(InputError, match=said) as caught:
        open_capture(tmp_path)
    assert str(tmp_path / NAME) in str(caught.value) and len(str(caught.value).splitlines()) == 1


def test_a_pose_that_is_not_a_number_costs_its_frame(tmp_path: Path) -> None:
    whole = made(tmp_path / NAME)
    frames = len(open_capture(tmp_path / NAME).frames)
    (tmp_path / NAME).write_bytes(packed(whole, BODY + 12, "<f", float("nan")))
    capture = open_capture(tmp_path / NAME)
    assert len(capture.frames) == frames - 1 and any("tracking was lost" in warning for warning in capture.warnings)


@pytest.mark.parametrize("bytes_of", ["image", "depth"])
def test_what_is_damaged_inside_is_told_by_its_frame(tmp_path: Path, bytes_of: str) -> None:
    data = made(tmp_path / NAME)
    begin, picture, _ = scan(tmp_path / NAME).places[1].tolist()
    at = begin + (picture if bytes_of == "depth" else 0)
    data[at : at + 30] = bytes(30)
    (tmp_path / NAME).write_bytes(data)
    capture = open_capture(tmp_path)
    with pytest.raises(InputError, match=f"the {bytes_of} of frame 1 in .*{NAME} is damaged"):
        load_image(capture.frames[1]) if bytes_of == "image" else load_depth(capture.frames[1], capture)
    (tmp_path / NAME).unlink()
    with pytest.raises(InputError, match="cannot read"):
        load_image(capture.frames[0])


def test_depth_that_would_become_more_than_its_size(tmp_path: Path) -> None:
    pose = eyes()[0].pose()
    picture = cv2.imencode(".jpg", render(eyes()[0], SCANNET_COLOUR)[0])[1].tobytes()
    (tmp_path / "a.sens").write_bytes(sens_of([(picture, zlib.compress(bytes(20_000_000), 1), pose)]))
    capture = open_capture(tmp_path)
    with pytest.raises(InputError, match="the depth of frame 0"):
        load_depth(capture.frames[0], capture)


def test_pictures_smaller_than_the_file_says(tmp_path: Path) -> None:
    (tmp_path / NAME).write_bytes(packed(made(tmp_path / NAME), HEAD + 264, "<2I", 192, 144))
    data = bytearray((tmp_path / NAME).read_bytes())
    for at in (0, 8, 20, 24):  # fx, cx; fy, cy of the colour camera: by rows
        value = struct.unpack_from("<f", data, HEAD + at)[0]
        struct.pack_into("<f", data, HEAD + at, 2 * value + (0.5 if at in (8, 24) else 0))
    (tmp_path / NAME).write_bytes(data)
    assert pixel_error(open_capture(tmp_path), eyes(), SCANNET_COLOUR) < 1e-3


def test_frames_without_picture_or_depth(tmp_path: Path) -> None:
    picture = cv2.imencode(".jpg", render(eyes()[0], SCANNET_COLOUR)[0])[1].tobytes()
    frames = [(picture, b"", eyes()[0].pose()), (b"", b"", eyes()[1].pose()), (picture, b"", eyes()[2].pose())]
    (tmp_path / "a.sens").write_bytes(sens_of(frames))
    capture = open_capture(tmp_path)
    assert [frame.name for frame in capture.frames] == ["0", "2"] and not capture.has_depth
    assert capture.warnings == ("1 frame of a.sens left out because no image belongs to it",)


def test_a_depth_camera_beside_the_pictures_is_told(tmp_path: Path) -> None:
    (tmp_path / NAME).write_bytes(packed(made(tmp_path / NAME), HEAD + 3 * 64 + 12, "<f", 0.03))
    assert "which is not used" in open_capture(tmp_path).warnings[1]


def test_frames_that_lie_there_as_files_go_before_the_file(tmp_path: Path) -> None:
    write_sens(tmp_path)
    export(tmp_path / NAME, tmp_path)
    assert not open_capture(tmp_path).filmed
    write_sens(tmp_path / "two")
    (tmp_path / "two" / NAME).rename(tmp_path / "two" / "b.sens")
    write_sens(tmp_path / "two")
    with pytest.raises(InputError, match=r"holds 2 \.sens files; give one of them"):
        open_capture(tmp_path / "two")


def test_training_and_the_benchmark_take_it(tmp_path: Path) -> None:
    write_sens(tmp_path / "scans" / "scene0000_01")
    (folder,) = scannet_folders(tmp_path)
    export(folder / NAME, tmp_path / "exported")
    scene, other = scannet_scene(folder, 48), scannet_scene(tmp_path / "exported", 48)
    mine, theirs = scene.pictures([0, 2]), other.pictures([0, 2])
    assert scene.name == "scene0000_01" and bool((mine.images == theirs.images).all()) and bool((mine.depths == theirs.depths).all())
    suite = suite_of("scannet")
    ((name, found),) = suite.find(tmp_path / "scans")
    assert (name, found) == ("scene0000_01", folder)
    pick = suite.variant("fitted").pick
    assert split(pick(read_scannet(folder)).frames) == split(pick(read_scannet(tmp_path / "exported")).frames)
    (folder / "train.txt").write_text("0.jpg\n4.jpg\n")
    (folder / "test.txt").write_text("3.jpg\n")
    assert split(pick(read_scannet(folder)).frames) == [("0", "train"), ("3", "test"), ("4", "train")]


def split(frames: tuple) -> list[tuple[str, str | None]]:
    return [(frame.name, frame.split) for frame in frames]


def test_only_headers_are_read_and_only_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_sens(tmp_path)
    data = (tmp_path / NAME).read_bytes()
    frame = (data[BODY : BODY + 80] + struct.pack("<2Q", 1, 0)) + b"\0"
    (tmp_path / NAME).write_bytes(sens_of([], count=20_000)[:BODY] + frame * 20_000)
    assert len(scan(tmp_path / NAME)) == 20_000
    monkeypatch.setattr("fieldfuse.capture.sens._read", None)
    assert len(scan(tmp_path / NAME)) == 20_000

