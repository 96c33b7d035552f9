"""Captures in zip files: any layout, hostile names and sizes, and nothing left behind."""

from __future__ import annotations

import json
import stat
import tempfile
import zipfile
from pathlib import Path

import numpy as np
import pytest

from fieldfuse.capture import open_capture
from fieldfuse.capture.checks import check_capture
from fieldfuse.capture.unpack import MARKER, UNPACKED, is_packed, unpack, unpacked
from fieldfuse.errors import InputError, OutputError
from tests.capture.layouts import LAYOUTS, zipped
from tests.pipelines.made import call, make_room
from tests.pipelines.short import stages

Capsys = pytest.CaptureFixture[str]


def zip_of(path: Path, **members: bytes) -> Path:
    """A zip file of these members, `/` in their names written as `__`."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in members.items():
            file.writestr(name.replace("__", "/"), content)
    return path


@pytest.mark.parametrize("layout", ["transforms", "blender", "colmap bin", "7scenes", "tum", "llff", "dtu", "redwood", "polycam", "sens"])
@pytest.mark.parametrize("top", ["", "my scan/"])
def test_every_layout_is_read_from_a_zip_file(layout: str, top: str, tmp_path: Path) -> None:
    kind, write = LAYOUTS[layout]
    write(tmp_path / "folder")
    plain = open_capture(tmp_path / "folder")
    archive = zipped(tmp_path / "folder", tmp_path / "scan.ZIP", top)
    assert is_packed(archive)
    with unpacked(archive, tmp_path / "out") as place:
        capture = open_capture(place)
        assert capture.kind == kind and [frame.name for frame in capture.frames] == [frame.name for frame in plain.frames]
        for frame, other in zip(capture.frames, plain.frames, strict=True):
            assert frame.image.is_relative_to(tmp_path / "out") and frame.image.read_bytes() == other.image.read_bytes()
            assert (frame.world_from_camera is None) == (other.world_from_camera is None)
            if frame.world_from_camera is not None and other.world_from_camera is not None:
                assert np.array_equal(frame.world_from_camera, other.world_from_camera)


def test_what_macos_adds_is_left_out_and_a_folder_in_a_folder_is_found(tmp_path: Path) -> None:
    make_room(tmp_path / "folder" / "a" / "b")
    archive = zipped(tmp_path / "folder", tmp_path / "scan.zip")
    with zipfile.ZipFile(archive, "a") as file:
        for name in ("__MACOSX/a/b/._transforms.json", "a/.DS_Store", "a/b/images/._0001.png"):
            file.writestr(name, b"Mac OS X")
    with unpacked(archive, tmp_path / "out") as place:
        assert place == tmp_path / "out" / "a" / "b"
        assert not [path for path in (tmp_path / "out").rglob("*") if path.name.startswith(("._", "__", ".DS"))]
        assert len(check_capture(open_capture(place)).frames) == 12


def test_names_with_backslashes_are_folders(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as file:
        info = zipfile.ZipInfo("x")
        info.filename = "scan\\images\\1.txt"
        file.writestr(info, b"1")
    unpack(tmp_path / "a.zip", tmp_path / "out")
    assert (tmp_path / "out" / "scan" / "images" / "1.txt").read_bytes() == b"1"


@pytest.mark.parametrize("name", ["../a.txt", "b/../../a.txt", "/tmp/a.txt", "C:/a.txt", "..\\a.txt", "\\\\host\\a.txt"])
def test_names_that_lead_out_are_refused_before_anything_is_written(name: str, tmp_path: Path) -> None:
    archive = zip_of(tmp_path / "a.zip", fine=b"1")
    with zipfile.ZipFile(archive, "a") as file:
        info = zipfile.ZipInfo("x")
        info.filename = name
        file.writestr(info, b"1")
    with pytest.raises(InputError, match=r"a name that leads out of its folder; make the zip file anew"):
        unpack(archive, tmp_path / "out")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.zip"]


def test_links_are_refused(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as file:
        info = zipfile.ZipInfo("images")
        info.external_attr = (stat.S_IFLNK | 0o777) << 16
        file.writestr(info, "/etc")
    with pytest.raises(InputError, match="'images', which is a link"):
        unpack(tmp_path / "a.zip", tmp_path / "out")


def test_what_is_there_twice_is_refused(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as file:
        for name in ("a", "a/b"):
            file.writestr(name, b"1")
    with pytest.raises(InputError, match="twice"):
        unpack(tmp_path / "a.zip", tmp_path / "out")


def test_a_bomb_is_refused(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as file, file.open("a.bin", "w") as member:
        for _ in range(30):
            member.write(bytes(10 * 2**20))
    with pytest.raises(InputError, match="becomes 300 MB when it is unpacked, more than images do"):
        unpack(tmp_path / "a.zip", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_damage_passwords_and_no_zip_file_are_one_sentence(tmp_path: Path) -> None:
    archive = zip_of(tmp_path / "a.zip", images__1=bytes(range(256)) * 9)
    data = archive.read_bytes()
    for content, match in (
        (data[:50] + b"\xff" * 20 + data[70:], r"images/1 in .*a\.zip cannot be unpacked \("),
        (data.replace(b"PK\x01\x02\x14\x03\x14\x00\x00\x00", b"PK\x01\x02\x14\x03\x14\x00\x01\x00"), "locked by a password"),
        (data[: len(data) // 2], "is no zip file, or one that is cut short"),
        (b"PK\x05\x06" + bytes(18), "is empty"),
    ):
        archive.write_bytes(content)
        with pytest.raises(InputError, match=match):
            unpack(archive, tmp_path / "out")
        assert not (tmp_path / "out").exists() and not list(tmp_path.glob(".tmp*"))


def test_a_full_disk_is_said_beforehand(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    archive = zip_of(tmp_path / "a.zip", a=bytes(2**22))
    monkeypatch.setattr("shutil.disk_usage", lambda path: type("Usage", (), {"free": 2**20}))
    with pytest.raises(OutputError, match=r"unpacks to 4 MB, and .* has 1 MB free"):
        unpack(archive, tmp_path / "out")


def test_the_same_zip_file_is_unpacked_once_and_another_replaces_it(tmp_path: Path) -> None:
    archive, out = zip_of(tmp_path / "a.zip", a=b"1", b=b"2"), tmp_path / "out"
    unpack(archive, out)
    made = (out / "a").stat().st_mtime_ns
    unpack(archive, out)
    assert (out / "a").stat().st_mtime_ns == made
    (out / "b").unlink()
    unpack(archive, out)
    assert {path.name for path in out.iterdir()} == {"a", "b", MARKER}
    zip_of(archive, c=b"33")
    unpack(archive, out)
    assert {path.name for path in out.iterdir()} == {"c", MARKER}


def test_nothing_is_left_behind_and_errors_name_the_zip_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    make_room(tmp_path / "folder")
    (tmp_path / "folder" / "transforms.json").write_text("{")
    archive = zipped(tmp_path / "folder", tmp_path / "a.zip")
    with pytest.raises(InputError, match=r"a\.zip/transforms\.json is not valid JSON"), unpacked(archive) as place:
        open_capture(place)
    with pytest.raises(InputError), unpacked(archive, tmp_path / "out") as place:
        open_capture(place)
    assert not (tmp_path / "out").exists() and not list((tmp_path / "temporary").iterdir())


def test_whatever_bytes_change_nothing_is_written_elsewhere(tmp_path: Path) -> None:
    """Changed bytes are refused in a sentence, or unpack to files inside; where the archive is and nothing else."""
    place = tmp_path / "a" / "b" / "c"
    place.mkdir(parents=True)
    archive = zip_of(place / "a.zip", scan__images__1=b"x" * 400, scan__images__2=bytes(range(200)), scan__3=b"1")
    whole, random, refused = archive.read_bytes(), np.random.default_rng(3), 0
    for _ in range(200):
        data = bytearray(whole)
        for at in random.integers(0, len(data), random.integers(1, 9)):
            data[at] = random.choice([*b"\0\xff./\\:", int(random.integers(256))])
        archive.write_bytes(data)
        try:
            unpack(archive, place / "out")
        except InputError as error:
            assert len(str(error).splitlines()) == 1
            refused += 1
        assert {path.name for path in place.iterdir()} <= {"a.zip", "out"}
        assert [path.name for path in (tmp_path, tmp_path / "a", tmp_path / "a" / "b") for path in path.iterdir()] == ["a", "b", "c"]
    assert refused > 100


# ------------------------------------------------------------------------------------------------ the command line


def test_info_reads_a_zip_file_and_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capsys) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    make_room(tmp_path / "folder")
    archive = zipped(tmp_path / "folder", tmp_path / "a.zip", "scan/")
    answer = call(capsys, "info", archive, "--json")
    assert answer.code == 0, answer.err
    facts = json.loads(answer.out)
    assert (facts["source"], facts["kind"], facts["frames"], facts["posed"]) == (str(archive), "transforms", 12, True)
    assert not list((tmp_path / "temporary").iterdir())


def test_a_run_goes_on_without_unpacking_again_also_when_it_was_moved(tmp_path: Path, capsys: Capsys) -> None:
    make_room(tmp_path / "folder")
    archive = zipped(tmp_path / "folder", tmp_path / "a.zip", "scan/")
    options = ("--threads", 1, "--quiet", "--json")
    answer = call(capsys, "poses", archive, "--out", tmp_path / "run", *options)
    assert answer.code == 0, answer.err
    inside = next((tmp_path / "run" / UNPACKED).rglob("*1.png")).relative_to(tmp_path / "run")
    image = tmp_path / "run" / inside
    made = image.stat().st_mtime_ns
    assert all(stages(json.loads(call(capsys, "poses", archive, "--out", tmp_path / "run", *options).out)).values())
    assert image.stat().st_mtime_ns == made
    (tmp_path / "run").rename(tmp_path / "moved")
    again = json.loads(call(capsys, "poses", archive, "--out", tmp_path / "moved", *options).out)
    assert all(stages(again).values())
    named = json.loads((tmp_path / "moved" / "exports" / "cameras" / "transforms.json").read_text())["frames"][0]["file_path"]
    assert (tmp_path / "moved" / named).is_file()
    (tmp_path / "moved" / inside).unlink()
    assert stages(json.loads(call(capsys, "poses", archive, "--out", tmp_path / "moved", *options).out))["capture"] is False
    assert (tmp_path / "moved" / inside).is_file()


def test_a_run_of_a_bad_zip_file_leaves_no_folder(tmp_path: Path, capsys: Capsys) -> None:
    archive = zip_of(tmp_path / "a.zip", readme=b"nothing here")
    answer = call(capsys, "run", archive, "--out", tmp_path / "run")
    assert answer.code == 2 and "a.zip holds no capture of a known kind" in answer.sentence()
    assert not (tmp_path / "run").exists()
