"""The largest memory of a stage: this process's, its children's, and which of it is its own."""

from __future__ import annotations

import gc
import mmap
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import psutil
import pytest

from fieldfuse.memory import give_back
from fieldfuse.pipelines.stages import PeakMemory, own_bytes

SIZE = 2**27  # 128 MiB


def until(reached: Callable[[], bool], seconds: float = 200) -> None:
    """Wait for the thread that samples, which a busy machine may hold up; what never comes is for the test to find."""
    end = time.monotonic() + seconds
    while not reached() and time.monotonic() < end:
        time.sleep(0.05)


def test_what_was_taken_and_given_back_is_remembered() -> None:
    gc.collect()
    give_back()  # else the thread may see as much given back as is taken
    before = own_bytes(psutil.Process().memory_info()) / 2**20  # without pages of files, which a system short of memory drops
    with PeakMemory() as memory:
        held = np.ones(SIZE, np.uint8)
        until(lambda: memory.own > before + 100)
        del held
    assert memory.own > before + 100
    assert memory.own <= memory.megabytes


def test_files_are_memory_but_not_its_own(tmp_path: Path) -> None:
    path = tmp_path / "large"
    path.write_bytes(bytes(SIZE))
    own = own_bytes(psutil.Process().memory_info()) / 2**20
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as mapped, PeakMemory() as memory:
        assert not np.frombuffer(bytes(mapped[:: mmap.PAGESIZE]), np.uint8).any()  # each page is looked at
        until(lambda: memory.megabytes > own + 60)
    if not hasattr(psutil.Process().memory_info(), "shared"):
        pytest.skip("this system does not tell pages of files apart")
    assert memory.own < own + 60 < memory.megabytes


def test_children_count() -> None:
    program = f"import time; held = bytearray(b'1') * {SIZE}; print('there', flush=True); time.sleep(400)"
    before = psutil.Process().memory_info().rss / 2**20
    with PeakMemory() as memory, subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        child.stdout.readline()
        until(lambda: memory.megabytes > before + 100)
        child.kill()
    assert memory.megabytes > before + 100
