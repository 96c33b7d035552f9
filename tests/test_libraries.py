"""Pages of libraries' files are given back, and nothing else is: what runs afterwards runs as before."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from fieldfuse import libraries

ROOT = Path(__file__).resolve().parents[1]
LINUX = pytest.mark.skipif(not sys.platform.startswith("linux") or sys.maxsize < 2**32, reason="Linux on 64 bits")
PROGRAM = """
import json, re
import cv2, numba, numpy as np, open3d, torch
from pathlib import Path
from fieldfuse import libraries

def files():
    return int(re.search(r"RssFile:\\s+(\\d+)", Path("/proc/self/status").read_text())[1]) // 1024

def answers():
    a = torch.arange(12.0).reshape(3, 4)
    grey = np.arange(64, dtype=np.uint8).reshape(8, 8)
    compiled = numba.njit(lambda x: x * 2 + 1)
    grid = open3d.core.HashMap(8, open3d.core.int32, (3,), open3d.core.float32, (1,))
    return [float((a @ a.T).sum()), int(cv2.blur(grey, (3, 3)).sum()), compiled(20), int(grid.size()), float(np.linalg.det(np.eye(3)))]

before, first = files(), answers()
count = libraries.let_go()
after = files()
print(json.dumps([before, after, count, first, answers(), libraries.let_go(), answers()]))
"""


@LINUX
def test_most_of_what_loading_read_is_given_back_and_all_works_as_before() -> None:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    before, after, count, first, second, again, third = json.loads(done.stdout)
    assert after < before / 3 and before - after > 50, (before, after)
    assert count > 20 and again >= count
    assert first == second == third


@LINUX
def test_only_parts_that_nothing_may_write_to_are_let_go_of() -> None:
    """As the process's map has it: each range lies in one mapping of the library's own file, without the right to write."""
    mapped: dict[str, list[tuple[int, int, str]]] = {}
    for line in Path("/proc/self/maps").read_text().splitlines():
        addresses, rights, *_, path = line.split(None, 5) if line.count(" ") > 5 and "/" in line else (line.split()[0], "", "")
        low, high = (int(one, 16) for one in addresses.split("-"))
        mapped.setdefault(path, []).append((low, high, rights))
    found = libraries._loaded()
    assert len(found) > 20
    for path, pieces in found.items():
        ranges = libraries._unwritten(path)
        assert ranges, path
        for start, end in ranges:
            inside = [one for one in mapped[str(path)] if one[0] < pieces[0][0] + end and pieces[0][0] + start < one[1]]
            assert len(inside) == 1 and "w" not in inside[0][2], (path, start, end, inside)


def test_what_is_no_library_is_left_alone(tmp_path: Path) -> None:
    for name, content in (("empty.so", b""), ("text.so", b"text " * 40), ("short.so", b"\x7fELF\x02\x01" + bytes(20))):
        (tmp_path / name).write_bytes(content)
        assert libraries._unwritten(tmp_path / name) == ()
    assert libraries._unwritten(tmp_path / "absent.so") == ()


@LINUX
def test_a_library_whose_file_was_replaced_is_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "lib.so"
    path.write_bytes(b"new")
    line = f"7f0000000000-7f0000001000 r--p 00000000 08:01 {{}} {path}\n"
    maps = tmp_path / "maps"
    monkeypatch.setattr(libraries, "_MAPS", maps)
    maps.write_text(line.format(path.stat().st_ino + 1))
    assert libraries._loaded() == {}
    maps.write_text(line.format(path.stat().st_ino))
    assert libraries._loaded() == {path: [(0x7F0000000000, 0x7F0000001000)]}
    maps.unlink()
    assert libraries._loaded() == {} and libraries.let_go() == 0


def test_elsewhere_nothing_happens(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(libraries, "madvise", None)
    assert libraries.let_go() == 0
