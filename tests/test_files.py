"""Files: atomic writes, bounded JSON, paths that stay inside, fingerprints."""

from __future__ import annotations

import errno
import json
import os
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldfuse.errors import InputError, OutputError
from fieldfuse.files import atomic_path, fingerprint, inside, read_json, remove, write_json


def test_a_file_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    target = tmp_path / "deep" / "folder" / "a.txt"
    with atomic_path(target) as temporary:
        assert temporary.parent == target.parent and temporary.suffix == ".txt" and temporary != target
        temporary.write_text("new")
        assert not target.exists()
    assert target.read_text() == "new" and list(target.parent.iterdir()) == [target]


def test_a_failed_write_keeps_the_old_file(tmp_path: Path) -> None:
    target = tmp_path / "a.txt"
    target.write_text("old")
    with pytest.raises(ZeroDivisionError), atomic_path(target) as temporary:
        temporary.write_text("half")
        raise ZeroDivisionError
    assert target.read_text() == "old" and list(tmp_path.iterdir()) == [target]


def test_a_full_disk_is_an_output_error(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"a\.txt.*No space left.*free space"), atomic_path(tmp_path / "a.txt") as temporary:
        temporary.write_text("half")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here")
def test_a_device_that_is_really_full(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="No space left"), atomic_path(tmp_path / "a.txt"):
        Path("/dev/full").write_text("x" * 100_000)


def test_a_file_where_a_folder_should_be(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    for target in (tmp_path / "file" / "a.txt", tmp_path / "file" / "deep" / "a.txt"):
        with pytest.raises(OutputError, match="cannot write"):
            write_json(target, {})
    (tmp_path / "folder" / "inner").mkdir(parents=True)
    with pytest.raises(OutputError, match="cannot write"):
        write_json(tmp_path / "folder", {})
    assert (tmp_path / "folder" / "inner").is_dir() and not list(tmp_path.glob(".tmp*"))


def test_a_folder_can_be_written_atomically(tmp_path: Path) -> None:
    with atomic_path(tmp_path / "out") as temporary:
        temporary.mkdir()
        (temporary / "a").write_text("1")
    assert (tmp_path / "out" / "a").read_text() == "1"


def test_remove(tmp_path: Path) -> None:
    (tmp_path / "folder" / "deep").mkdir(parents=True)
    (tmp_path / "kept").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "kept")
    for name in ("folder", "link", "absent"):
        remove(tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == ["kept"]


# ---------------------------------------------------------------------------------------------------- JSON


def test_json_there_and_back(tmp_path: Path) -> None:
    value = {"a": [1, 2.5, None, True], "text": "Größe"}
    write_json(tmp_path / "a.json", value)
    assert read_json(tmp_path / "a.json") == value


def test_not_a_number_is_no_json(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="JSON"):
        write_json(tmp_path / "a.json", [float("nan")])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (b"{", "not valid JSON"),
        (b"", "not valid JSON"),
        (b"\xff\xfe\x00", "not valid JSON"),
        (b"[" * 200_000 + b"]" * 200_000, "nested too deeply"),
        (b"[" * 200_000, "nested too deeply"),
        (b'{"a":' * 200_000, "nested too deeply"),
        (b"[" + b"9" * 10_000 + b"]", "not valid JSON"),
    ],
)
def test_damaged_json_is_refused(tmp_path: Path, content: bytes, text: str) -> None:
    path = tmp_path / "a.json"
    path.write_bytes(content)
    with pytest.raises(InputError, match=rf"a\.json.*{text}"):
        read_json(path)


def test_large_missing_and_foreign_json(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(json.dumps(["x" * 2000]))
    with pytest.raises(InputError, match="MB"):
        read_json(tmp_path / "a.json", max_bytes=1000)
    for path in (tmp_path / "missing.json", tmp_path, tmp_path / "a.json" / "b.json"):
        with pytest.raises(InputError, match="cannot read"):
            read_json(path)


def test_a_sparse_file_of_100_mb_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    with path.open("wb") as file:
        file.truncate(100 * 2**20)
    with pytest.raises(InputError, match="100 MB"):
        read_json(path)


# ---------------------------------------------------------------------------------------------------- paths


@pytest.mark.parametrize("name", ["../../etc/passwd", "/etc/passwd", "a/../../b", "link/passwd", "..", "a\0b"])
def test_paths_that_lead_outside_are_refused(tmp_path: Path, name: str) -> None:
    root = tmp_path / "capture"
    root.mkdir()
    (root / "link").symlink_to("/etc")
    with pytest.raises(InputError, match=r"leads outside|not usable"):
        inside(root, name)


def test_links_that_lead_outside_are_told_as_links(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    (tmp_path / "a.jpg").write_text("a")
    (tmp_path / "in" / "a.jpg").symlink_to(tmp_path / "a.jpg")
    (tmp_path / "in" / "folder").symlink_to(tmp_path)
    for name in ("a.jpg", "folder/a.jpg"):
        with pytest.raises(InputError, match=rf"'{name}' is a link, .* leads outside the capture folder .*: copy there what it links to"):
            inside(tmp_path / "in", name)
    (tmp_path / "in" / "b.jpg").symlink_to(tmp_path / "in" / "c.jpg")
    assert inside(tmp_path / "in", "b.jpg") == tmp_path / "in" / "c.jpg"


def test_links_in_a_circle_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a").symlink_to(tmp_path / "b")
    (tmp_path / "b").symlink_to(tmp_path / "a")
    with pytest.raises(InputError, match="is not usable"):
        inside(tmp_path, "a/x")


@pytest.mark.parametrize("name", ["a.png", "./a.png", "deep/a.png", "deep/../a.png", "", "x" * 200])
def test_paths_inside(tmp_path: Path, name: str) -> None:
    assert inside(tmp_path, name).is_relative_to(tmp_path.resolve())


@given(st.text(max_size=40))
def test_any_name_stays_inside_or_is_refused(name: str) -> None:
    root = Path("/usr/share")
    with suppress(InputError):
        assert inside(root, name).is_relative_to(root)


# ---------------------------------------------------------------------------------------------------- fingerprints


def test_fingerprints_tell_things_apart(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_text("1")
    seen = {
        fingerprint(),
        fingerprint(1),
        fingerprint("1"),
        fingerprint(1, 2),
        fingerprint([1, 2]),
        fingerprint({"a": 1}),
        fingerprint(path),
        fingerprint(str(path)),
    }
    assert len(seen) == 8
    before = fingerprint(path)
    os.utime(path, ns=(1, 1))
    assert fingerprint(path) != before


def test_fingerprints_do_not_depend_on_the_order_of_keys() -> None:
    assert fingerprint({"a": 1, "b": [1.5, None]}) == fingerprint({"b": [1.5, None], "a": 1})


def test_fingerprints_see_all_of_an_array() -> None:
    values = np.zeros(5000)  # its text form leaves the middle out
    other = values.copy()
    other[2500] = 1e-12
    assert fingerprint({"poses": values}) != fingerprint({"poses": other})
    assert fingerprint(values) == fingerprint(values.copy())
    assert fingerprint(values) != fingerprint(values.reshape(50, 100)) != fingerprint(values.astype(np.float32))
    assert fingerprint(np.float64(1.0)) != fingerprint(np.float64(2.0))
