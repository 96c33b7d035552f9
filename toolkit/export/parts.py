"""`field_parts/` beside a page: a baked field that is too large for one file, cut into parts which the page loads as one walks.

`index.json` names them; each is a file of its own, called by a hash of its content, so that new ones can be written beside those of an
older page, which stay until the new page is there. `web/parts.js` reads them.
"""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fieldfuse.camera import Array
from fieldfuse.errors import OutputError
from fieldfuse.export.corners import corner_differences, written_corners
from fieldfuse.files import atomic_path, fingerprint, remove, write_json
from fieldfuse.render.bake import BakedField, counted, occupied_voxels
from fieldfuse.volume.topology import BLOCK

PARTS, INDEX = "field_parts", "index.json"
VERSION = 1  # of the index
PART_BYTES = 2_500_000  # of a part's file, about: a second of a slow connection, a tenth of a second to unpack


def deflated(blob: bytes) -> bytes:
    """Differences hardly repeat: their frequencies are all that helps, and runs in what else there is."""
    how = zlib.compressobj(strategy=zlib.Z_RLE)
    return how.compress(blob) + how.flush()


def joined(arrays: Sequence[tuple[str, Array]]) -> tuple[list[list[Any]], bytes]:
    """[name, type, length] of each array, and all of them one after the other, each filled up to whole words."""
    blob = bytearray()
    for _, array in arrays:
        blob += array.tobytes()
        blob += b"\0" * (-len(blob) % 4)
    return [[name, f"{array.dtype.kind}{array.dtype.itemsize}", array.size] for name, array in arrays], bytes(blob)


def corner_arrays(field: BakedField) -> list[tuple[str, Array]]:
    """Which voxels there are and what their corners hold: all that `web/unpack.js` needs to know of blocks."""
    return [
        ("bits", np.ascontiguousarray(field.arrays.bits).view(np.uint8)),
        ("keys", (field.keys() - field.table_origin).astype(np.uint16)),
        ("values", corner_differences(field, written_corners(field))),
    ]


def write_parts(folder: Path, field: BakedField, coarse: BakedField, ratio: int, count: int) -> tuple[str, list[Path]]:
    """Write about `count` parts and their index into `folder`; other files stay. Answers what the page knows them by, and the files.

    Args:
        coarse: the field on the lattice that is coarser by `ratio`. A part is a run of its blocks, in Morton order, with all blocks of
            `field` that lie in them.

    Raises:
        OutputError: they cannot be written.
    """
    parts: list[dict[str, Any]] = []
    for slots, first, blocks in _runs(field, coarse, ratio, count):
        part = blocks_of(field, slots)
        arrays, blob = joined(corner_arrays(part))
        content, keys = deflated(blob), part.keys()
        name = f"{hashlib.sha256(content).hexdigest()[:16]}.bin"
        with atomic_path(folder / name) as temporary:
            temporary.write_bytes(content)
        side = BLOCK * 2 * field.space.extent / field.resolution
        parts.append(
            {
                "file": name,
                "bytes": len(content),
                "box": [(keys.min(0) * side - field.space.extent).tolist(), ((keys.max(0) + 1) * side - field.space.extent).tolist()],
                "blocks": len(slots),
                "voxels": part.voxels,
                "corners": part.corners,
                "coarse": [first, blocks],
                "origin": list(part.table_origin),
                "table": list(part.arrays.table.shape[::-1]),
                "arrays": arrays,
            }
        )
    own = fingerprint([part["file"] for part in parts], ratio)
    write_json(folder / INDEX, {"version": VERSION, "field": own, "ratio": ratio, "parts": parts})
    return own, [folder / INDEX, *(folder / part["file"] for part in parts)]


def remove_others(folder: Path, files: Sequence[Path]) -> None:
    """Remove what an older page had in `folder`, and that if nothing is left.

    Raises:
        OutputError: a file cannot be removed.
    """
    try:
        for path in set(folder.glob("*.bin")) | {folder / INDEX}:
            if path not in files:
                remove(path)
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()
    except OSError as error:
        raise OutputError(f"cannot write {folder}: {error.strerror or error}; remove it and export the page again") from error


def blocks_of(field: BakedField, slots: Array) -> BakedField:
    """Some blocks of a baked field, ascending, in a table of their own."""
    arrays, keys = field.arrays, field.keys()[slots]
    origin = keys.min(0) - 1
    table = np.full((keys.max(0) - origin + 2)[::-1], -1, np.int32)
    table[tuple((keys - origin).T[::-1])] = np.arange(len(slots))
    bits = np.asarray(arrays.bits)[slots]
    first, rows, base, _ = counted(occupied_voxels(bits))
    chosen = np.zeros(len(arrays.base), bool)
    chosen[slots] = True
    voxels = np.diff(np.append(arrays.first[:, 0], len(arrays.packed)))
    corners = np.diff(np.append(arrays.base, len(arrays.feature)))
    packed, feature = arrays.packed[np.repeat(chosen, voxels)], arrays.feature[np.repeat(chosen, corners)]
    some = arrays._replace(table=table, bits=bits, first=first, rows=rows, base=base, packed=packed, feature=feature)
    x, y, z = origin.tolist()
    return replace(field, table_origin=(x, y, z), arrays=some)


def _runs(field: BakedField, coarse: BakedField, ratio: int, count: int) -> Iterator[tuple[Array, int, int]]:
    """Slots of `field`, and the run of coarse blocks (first, how many) that they lie in, with about equal numbers of corners."""
    place = field.keys() // ratio - coarse.table_origin
    parent = coarse.arrays.table[tuple(place.T[::-1])]
    corners = np.diff(np.append(field.arrays.base, field.corners))
    work = np.bincount(parent, corners, len(coarse.arrays.base))
    part = np.minimum((np.cumsum(work) - 0.5 * work) * count // work.sum(), count - 1)
    for number in np.unique(part):
        inside = np.flatnonzero(part == number)
        yield np.flatnonzero(part[parent] == number), int(inside[0]), len(inside)
