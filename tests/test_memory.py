"""Work that does not fit into memory is refused with both numbers before it starts."""

from __future__ import annotations

import errno
import mmap
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import psutil
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldfuse import memory
from fieldfuse.errors import InputError
from tests.pages import mapped

ROOT = Path(__file__).resolve().parents[1]


def test_what_fits_passes_and_what_does_not_is_told_with_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "available", lambda: 3 * memory.GIB)
    memory.require(2 * memory.GIB, "this", "do less")
    with pytest.raises(InputError, match=r"this needs about 5\.0 GB of memory and 3\.0 GB is free; do less"):
        memory.require(5 * memory.GIB, "this", "do less")
    with pytest.raises(InputError):  # something is left to others
        memory.require(3 * memory.GIB, "this", "do less")


def test_the_smallest_limit_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "memory.max").write_text("3000000\n")
    (tmp_path / "memory.current").write_text("1000000\n")
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(available=4096 * 1024))
    monkeypatch.setattr(memory, "_CGROUP", tmp_path)
    assert memory.available() == 2_000_000
    (tmp_path / "memory.max").write_text("max\n")
    assert memory.available() == 4096 * 1024
    (tmp_path / "memory.max").write_text("5\n")
    assert memory.available() == 0


def test_files_that_a_container_holds_and_nobody_uses_are_free(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever reads a capture fills a container's memory with files; they are not in the way of anything."""
    (tmp_path / "memory").mkdir()
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(available=9000 * 1024))
    monkeypatch.setattr(memory, "_CGROUP", tmp_path)
    (tmp_path / "memory.max").write_text("3000000\n")
    (tmp_path / "memory.current").write_text("2900000\n")
    (tmp_path / "memory.stat").write_text("anon 700000\ninactive_file 2000000\nactive_file 200000\n")
    assert memory.available() == 2_100_000
    (tmp_path / "memory.stat").write_text("what is this\nanon")
    assert memory.available() == 100_000
    (tmp_path / "memory.max").write_text("max\n")
    assert memory.available() == 9000 * 1024
    for name, text in (("limit_in_bytes", "4000000"), ("usage_in_bytes", "3500000"), ("stat", "cache 9\ntotal_inactive_file 1000000")):
        (tmp_path / "memory" / f"memory.{name}").write_text(text + "\n")
    assert memory.available() == 1_500_000  # the first version of control groups


def test_a_limit_of_the_process_counts() -> None:
    program = (
        "import resource; from fieldfuse import memory; import psutil; before = psutil.Process().memory_info().vms\n"
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
    worst = memory.unwritten((3, 5), np.float32)
    assert worst.shape == (3, 5) and worst.dtype == np.float32 and not worst.any() and worst.flags.writeable


def test_pages_that_do_not_fit_into_memory_are_a_file_without_a_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(memory, "available", lambda: memory.SPARE + 2**23)
    fits, buffer = memory.pages(2**22, spill=True), memory.pages(2**23, spill=True)
    assert mapped(tmp_path) == [2**23] and not list(tmp_path.iterdir())
    values = np.frombuffer(buffer, np.uint8)
    assert not values.any() and values.flags.writeable
    values[5] = 1
    assert len(memory.pages(2**30)) == 2**30  # memory, if it must be
    del values, buffer, fits
    assert not mapped(tmp_path)
    monkeypatch.setattr(os, "posix_fallocate", full_disk)
    assert len(memory.pages(2**23, spill=True)) == 2**23 and not mapped(tmp_path)  # memory, if that has room
    with pytest.raises(InputError, match=r"of memory or disk, and 0\.1 GB of memory and .* GB in .* are free; .* TMPDIR"):
        memory.pages(2**55, spill=True)


def full_disk(*_: int) -> None:
    raise OSError(errno.ENOSPC, "no space left")


def resident() -> int:
    return int(psutil.Process().memory_info().rss)


@given(
    width=st.sampled_from([1, 4, 24, 64, 100, 4096, 9000]),
    offset=st.integers(0, 5000),
    share=st.sampled_from([0.0, 0.0005, 0.01, 0.5, 1.0]),
    seed=st.integers(0, 2**32 - 1),
)
@settings(max_examples=60, deadline=None)
def test_rows_in_use_keep_their_values_and_the_others_are_themselves_or_zero(width: int, offset: int, share: float, seed: int) -> None:
    random = np.random.default_rng(seed)
    count = int(random.integers(0, 400_000 // width + 2))
    everything = np.full(offset + count * width + 9000, 7, np.uint8)
    rows = everything[offset : offset + count * width].reshape(count, width)
    used = random.random(count) < share
    freed = memory.keep_only(rows, used)
    assert (everything[:offset] == 7).all() and (everything[offset + count * width :] == 7).all(), "what lies beside the rows is not theirs"
    assert (rows[used] == 7).all()
    zero = rows == 0
    assert (zero | (rows == 7)).all() and int(zero.sum()) == freed
    # Every page that lies wholly in rows without use is given back, but for the last row's and its neighbour's.
    if memory.madvise is not None and share == 0.0:
        assert freed >= max(0, (count - 1) * width - 3 * mmap.PAGESIZE)


@pytest.mark.skipif(memory.madvise is None, reason="this system takes no pages back early")
def test_rows_that_nobody_uses_take_no_memory_any_more() -> None:
    rows = np.ones((2**22, 16), np.float32)  # 256 MB
    before = resident()
    used = np.zeros(len(rows), bool)
    used[: len(rows) // 4] = True
    assert memory.keep_only(rows, used) > rows.nbytes // 2
    assert before - resident() > rows.nbytes // 2
    assert rows[used].all() and not rows[len(rows) // 2 : -256].any()
    rows[-3:] = 5  # they are written to as ever
    assert (rows[-3:] == 5).all()


def test_what_cannot_be_given_back_in_part_is_refused() -> None:
    for rows, used in ((np.ones((4, 2))[:, :1], np.zeros(4, bool)), (np.ones((4, 2)), np.zeros(3, bool))):
        with pytest.raises(ValueError, match="contiguous"):
            memory.keep_only(rows, used)


def test_threads_share_a_heap_unless_the_environment_says_otherwise(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[int, int]] = []
    monkeypatch.setattr(memory.ctypes, "CDLL", lambda _: SimpleNamespace(mallopt=lambda *what: asked.append(what)))
    monkeypatch.setenv("MALLOC_ARENA_MAX", "4")
    memory.one_heap()
    assert asked == []
    monkeypatch.delenv("MALLOC_ARENA_MAX")
    memory.one_heap()
    assert asked == [(-8, 1)]
    monkeypatch.setattr(memory.ctypes, "CDLL", lambda _: SimpleNamespace())  # another C library
    memory.one_heap()
