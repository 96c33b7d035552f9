"""Vertex positions of a PLY file that lies beside a capture: sparse points from structure from motion."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from fieldfuse.camera import Array
from fieldfuse.errors import InputError, first_line

MAX_BYTES = 2**30
MAX_HEADER = 2**16
TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4", "double": "f8",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}


def read_ply_points(path: Path) -> Array:
    """(N, 3) float64 vertex positions; points that are not finite are left out."""
    try:
        if path.stat().st_size > MAX_BYTES:
            raise InputError(f"{path} is larger than {MAX_BYTES / 2**20:.0f} MB; give a sparse point cloud, or none")
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from error
    try:
        points = ply_columns(content, lambda _: list("xyz"))
    except (ValueError, KeyError, IndexError, OverflowError, MemoryError) as error:
        raise InputError(f"{path} is not a readable PLY file ({first_line(error)}); correct it or remove it from the capture") from error
    return points[np.isfinite(points).all(axis=1)]


def ply_columns(content: bytes, wanted: Callable[[list[str]], list[str]], most: int | None = None, kind: type = np.float64) -> Array:
    """(N, C) of `kind`: columns of a PLY file's vertices, which come first in it.

    Args:
        wanted: from the names of all columns those that are read.
        most: vertices.

    Raises:
        ValueError, KeyError, IndexError, OverflowError, MemoryError: it is not such a file.
    """
    end = content.find(b"end_header", 0, MAX_HEADER)
    start = content.find(b"\n", end) + 1
    if not content.startswith(b"ply") or end < 0 or start == 0:
        raise ValueError("no PLY header")
    order, count, element = "", 0, ""
    columns: list[tuple[str, str]] = []
    for line in content[:end].decode("ascii", errors="replace").splitlines()[1:]:
        words = line.split()
        if not words or words[0] in ("comment", "obj_info"):
            continue
        if words[0] == "format":
            order = words[1]
        elif words[0] == "element":
            if not element and words[1] != "vertex":
                raise ValueError("vertices must come first")
            element = words[1]
            count = int(words[2]) if element == "vertex" else count
        elif words[0] == "property" and element == "vertex":
            columns.append((words[2], ORDERS[order] + TYPES[words[1]]))
    names = [name for name, _ in columns]
    indices = [names.index(name) for name in wanted(names)]
    if count < 0:
        raise ValueError("a negative number of vertices")
    if most is not None and count > most:
        raise ValueError(f"{count} vertices; at most {most} can be read")
    if order == "ascii":
        lines = content[start:].decode("ascii", errors="replace").split("\n", count)[:count]
        numbers = [[float(words[i]) for i in indices] for words in map(str.split, lines)]
        points: Array = np.array(numbers, dtype=kind).reshape(-1, len(indices))
    else:
        layout = np.dtype(columns)
        rows = np.frombuffer(content, dtype=layout, count=min(count, (len(content) - start) // layout.itemsize), offset=start)
        points = np.empty((len(rows), len(indices)), kind)
        for column, index in enumerate(indices):
            points[:, column] = rows[names[index]]
    if len(points) != count:
        raise ValueError("fewer vertices than in the header")
    return points
