"""Gives back the pages of loaded libraries that are not in use: loading reads far more of a library's file than is looked at later.

Such pages are the file's own, so nothing is lost: what is needed again is mapped from the system's page cache. After loading torch, OpenCV,
numba and Open3D they are 0.15 GB of what counts as this process's memory, and 0.03 GB once what a fit uses is mapped again.
"""

from __future__ import annotations

import mmap
import struct
import sys
from contextlib import suppress
from functools import cache
from pathlib import Path

from fieldfuse.memory import madvise

_HEADER = struct.Struct("<16sHHIQQQIHHHHHH")  # of an ELF file of 64 bits
_SEGMENT = struct.Struct("<IIQQQQQQ")  # type, flags, offset, address, physical address, bytes in the file, bytes in memory, alignment
_DYNAMIC = struct.Struct("<qQ")
_LOAD, _WRITABLE = 1, 2
_OF_DYNAMIC, _TEXT_RELOCATIONS, _FLAGS, _TEXT_FLAG = 2, 22, 30, 4
_MAPS = Path("/proc/self/maps")
Ranges = tuple[tuple[int, int], ...]


def let_go() -> int:
    """Unmap what this process has mapped of its libraries' code and constants; it is mapped again where it is looked at (a millisecond or
    a few in all).

    Only parts that nothing may write to are let go of, as the libraries' own tables of contents have them, so data and what the loader
    has filled in stay. Where the system is not Linux on 64 bits nothing happens.

    Returns:
        libraries of which something was let go.
    """
    if madvise is None or sys.byteorder != "little":
        return 0
    count = 0
    for path, mapped in _loaded().items():
        ranges = [(mapped[0][0] + start, mapped[0][0] + end) for start, end in _unwritten(path)]
        ranges = [(start, end) for start, end in ranges if any(low <= start and end <= high for low, high in mapped)]
        for start, end in ranges:
            madvise(start, end - start, mmap.MADV_DONTNEED)
        count += bool(ranges)
    return count


def _loaded() -> dict[Path, list[tuple[int, int]]]:
    """Where each library's file is mapped and may not be written to, from its beginning on, if it is still the file that was loaded."""
    found: dict[Path, list[tuple[int, int]]] = {}
    with suppress(OSError):
        for line in _MAPS.read_text(encoding="utf-8", errors="surrogateescape").splitlines():
            addresses, rights, offset, _, node, *rest = line.split(None, 5)
            if not rest or ".so" not in rest[0] or "w" in rights:
                continue
            path = Path(rest[0])
            low, high = (int(address, 16) for address in addresses.split("-"))
            if path in found:
                found[path].append((low, high))
            elif int(offset, 16) == 0:
                with suppress(OSError):
                    if path.stat().st_ino == int(node):
                        found[path] = [(low, high)]
    return found


@cache
def _unwritten(path: Path) -> Ranges:
    """(start, end) in whole pages, from where the library begins, of the parts that are loaded and never written to."""
    with suppress(OSError, struct.error), path.open("rb") as file:
        identity, *_, table, _, _, _, width, count, _, _, _ = _HEADER.unpack(file.read(_HEADER.size))
        if identity[:6] != b"\x7fELF\x02\x01" or width != _SEGMENT.size:
            return ()
        file.seek(table)
        segments = [_SEGMENT.unpack(file.read(width)) for _ in range(count)]
        for kind, _, offset, _, _, size, *_ in segments:
            if kind == _OF_DYNAMIC:
                file.seek(offset)
                entries = _DYNAMIC.iter_unpack(file.read(size // _DYNAMIC.size * _DYNAMIC.size))
                if any(tag == _TEXT_RELOCATIONS or (tag == _FLAGS and value & _TEXT_FLAG) for tag, value in entries):
                    return ()  # the loader wrote into what the table calls constant
        page = mmap.PAGESIZE
        loads = [(flags, address, address + size) for kind, flags, _, address, _, _, size, _ in segments if kind == _LOAD]
        first = loads[0][1] // page * page if loads else 0
        written = [(start // page * page, -(-end // page) * page) for flags, start, end in loads if flags & _WRITABLE]
        pages = [(start // page * page, -(-end // page) * page) for flags, start, end in loads if not flags & _WRITABLE]
        apart = [one for one in pages if all(one[1] <= start or end <= one[0] for start, end in written)]
        return tuple((start - first, end - first) for start, end in apart)
    return ()
