"""Which pages of an array the system has in memory (Linux)."""

from __future__ import annotations

from mmap import PAGESIZE
from pathlib import Path

import numpy as np


def in_memory(rows: np.ndarray) -> float:
    """Share of the pages of `rows` that the system has in memory; to read what was never written counts as well."""
    first, last = rows.ctypes.data // PAGESIZE, -(-(rows.ctypes.data + rows.nbytes) // PAGESIZE)
    with Path("/proc/self/pagemap").open("rb", buffering=0) as file:
        file.seek(8 * first)
        entries = np.frombuffer(file.read(8 * (last - first)), np.uint64)
    return float((entries >> np.uint64(63)).mean())


def mapped(folder: Path) -> list[int]:
    """Sizes of this process's windows into files of a folder."""
    lines = [line.split() for line in Path("/proc/self/maps").read_text().splitlines() if str(folder) in line]
    ends = [[int(end, 16) for end in line[0].split("-")] for line in lines]
    return [last - first for first, last in ends]
