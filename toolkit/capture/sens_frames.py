"""Pictures and depth inside a `.sens` file, read one at a time."""

from __future__ import annotations

import zlib
from collections.abc import Collection, Iterator
from pathlib import Path

import cv2
import numpy as np

from fieldfuse.camera import Array
from fieldfuse.capture.headers import read_header
from fieldfuse.capture.sens import RAW, ZLIB_DEPTH, Sens, scan
from fieldfuse.errors import InputError


def iterate_sens(path: Path, indices: Collection[int] | None = None) -> Iterator[tuple[int, Array]]:
    """The pictures of a file (of `indices`; None: all that have one) as (index, (H, W, 3) uint8 RGB), in order.

    Raises:
        InputError: the file cannot be read, or a picture in it is damaged.
    """
    found = scan(path)
    for index in range(len(found)) if indices is None else sorted(indices):
        if indices is not None or found.places[index, 1]:
            yield index, sens_picture(path, index)


def sens_size(found: Sens, index: int) -> tuple[int, int]:
    """Width and height of picture number `index`, which may be smaller than the file says of all.

    Raises:
        InputError: there is none, or it is damaged.
    """
    return _size(found, index, sens_bytes(found, index))


def _size(found: Sens, index: int, data: bytes) -> tuple[int, int]:
    if found.codings[0] == RAW:
        if len(data) != 3 * found.size[0] * found.size[1]:
            raise _damaged(found, index, "picture")
        return found.size
    try:
        header = read_header(data, found.path)  # refuses what is cut short, too
    except InputError as error:
        raise _damaged(found, index, "picture") from error
    return header.width, header.height


def sens_picture(path: Path, index: int) -> Array:
    """Picture number `index`, (H, W, 3) uint8 RGB.

    Raises:
        InputError: there is none, or it is damaged.
    """
    found = scan(path)
    data = sens_bytes(found, index)
    width, height = _size(found, index, data)
    if found.codings[0] == RAW:
        return np.frombuffer(data, np.uint8).reshape(height, width, 3)
    try:
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        picture = None
    if picture is None:
        raise _damaged(found, index, "picture")
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB))


def sens_depth(path: Path, index: int) -> Array:
    """The depth of frame `index` as it is stored, (H, W) uint16; 0 = missing.

    Raises:
        InputError: there is none, or it is damaged.
    """
    found = scan(path)
    data = sens_bytes(found, index, depth=True)
    width, height = found.depth_size
    if found.codings[1] == ZLIB_DEPTH:
        try:
            data = zlib.decompressobj().decompress(data, 2 * width * height + 1)  # no more, whatever it would become
        except zlib.error as error:
            raise _damaged(found, index, "depth") from error
    if len(data) != 2 * width * height:
        raise _damaged(found, index, "depth")
    return np.frombuffer(data, "<u2").reshape(height, width).astype(np.uint16)


def sens_bytes(found: Sens, index: int, depth: bool = False) -> bytes:
    """The picture or the depth of frame `index` as it is packed.

    Raises:
        InputError: there is none, or the file cannot be read.
    """
    if not 0 <= index < len(found) or not found.places[index, 1 + depth]:
        what = "depth" if depth else "picture"
        raise InputError(f"{found.path} holds no {what} of a frame {index}; give the file that the run began with")
    begin, picture, deep = (int(value) for value in found.places[index])
    try:
        with found.path.open("rb") as file:
            file.seek(begin + depth * picture)
            return file.read(deep if depth else picture)
    except OSError as error:
        raise InputError(f"cannot read {found.path}: {error.strerror or error}") from error


def _damaged(found: Sens, index: int, what: str) -> InputError:
    return InputError(f"the {what} of frame {index} in {found.path} is damaged; copy the file again from where it was published")
