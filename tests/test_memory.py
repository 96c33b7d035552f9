"""Work that does not fit into memory is refused with both numbers before it starts."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import psutil
import pytest

from toolkit import memory
from toolkit.errors import InputError

ROOT = Path(__file__).resolve().parents[1]


def test_what_fits_passes_and_what_does_not_is_told_with_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "available", lambda: 3 * memory.GIB)
    memory.require(2 * memory.GIB, "this", "do less")
    with pytest.raises(InputError, match=r"this needs about 5\.0 GB of memory and 3\.0 GB is free; do less"):
        memory.require(5 * memory.GIB, "this", "do less")
    with pytest.raises(InputError):  # something is left to others
        memory.require(3 * memory.GIB, "this", "do less")
    monkeypatch.setattr(memory, "available", lambda: None)
    memory.require(10**18, "where nobody tells, nothing", "is refused")


def test_there_is_some_memory() -> None:
    found = memory.available()
    assert found is None or 0 < found < 2**50


def test_the_smallest_limit_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "meminfo").write_text("MemTotal: 9 kB\nMemAvailable:    4096 kB\n")
    (tmp_path / "memory.max").write_text("3000000\n")
    (tmp_path / "memory.current").write_text("1000000\n")
    monkeypatch.setattr(memory, "_MEMINFO", tmp_path / "meminfo")
    monkeypatch.setattr(memory, "_CGROUP", tmp_path)
    assert memory.available() == 2_000_000
    (tmp_path / "memory.max").write_text("max\n")
    assert memory.available() == 4096 * 1024
    (tmp_path / "memory.max").write_text("5\n")
    assert memory.available() == 0


def test_a_limit_of_the_process_counts() -> None:
    program = (
        "import resource; from toolkit import memory; before = memory._kilobytes(memory._STATUS, 'VmSize')\n"
        "resource.setrlimit(resource.RLIMIT_AS, (before + 2**26, before + 2**26))\n"
        "print(memory.available())"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, env={**os.environ, "PYTHONPATH": str(ROOT)}, check=False
    )
    assert done.returncode == 0, done.stderr
    assert 0 < int(done.stdout) <= 2**26


def test_work_that_makes_do_takes_less(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "available", lambda: memory.SPARE + 4 * memory.GIB)
    assert memory.bounded(memory.GIB) == memory.GIB and memory.bounded(8 * memory.GIB) == 2 * memory.GIB
    assert [memory.workers(wanted, memory.GIB, "one of them", "do less") for wanted in (1, 3, 4, 9)] == [1, 3, 4, 4]
    with pytest.raises(InputError, match=r"one of them needs about 5\.0 GB"):
        memory.workers(2, 5 * memory.GIB, "one of them", "do less")
    monkeypatch.setattr(memory, "available", lambda: 0)
    assert memory.bounded(memory.GIB) == 0
    monkeypatch.setattr(memory, "available", lambda: None)
    assert memory.bounded(8 * memory.GIB) == 8 * memory.GIB and memory.workers(9, memory.GIB, "x", "y") == 9


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_pages_that_nobody_writes_take_no_memory() -> None:
    size = 2**28
    before = psutil.Process().memory_info().rss
    buffer = memory.pages(size)
    values = np.frombuffer(buffer, np.uint8)
    assert len(values) == size
    values[:: 2**20] = 1  # one page of 256
    assert psutil.Process().memory_info().rss - before < size // 8
    assert not values[1 : 2**20].any() and len(memory.pages(0)) == 0
