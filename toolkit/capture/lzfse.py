"""Maps compressed by Apple's LZFSE, as Record3D writes depth (`.depth`: float32) and confidence (`.conf`: uint8).

imagecodecs reads them; it is imported with the first such capture, so that all else works without it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from fieldfuse.camera import Array
from fieldfuse.capture.archive import read_bytes
from fieldfuse.errors import InputError

TYPES: dict[str, np.dtype[Any]] = {".depth": np.dtype("<f4"), ".conf": np.dtype("u1")}
MOST_PIXELS = 4_000_000  # of a map of unknown size: the largest is the front camera's, 720×960


def require(path: Path) -> Any:
    """The package that reads LZFSE, for `path`."""
    try:
        import imagecodecs

        _ = imagecodecs.lzfse_decode  # absent where it was built without
    except (ImportError, AttributeError) as error:
        raise InputError(
            f"the depth of {path} is compressed by LZFSE, which needs the package imagecodecs; install it (pip install imagecodecs), "
            "or give the images alone, unpacked into a folder"
        ) from error
    return imagecodecs


def load_map(path: Path, width: int, height: int) -> Array:
    """The map in a `.depth` or `.conf` file, (height, width), float32 or uint8 by its suffix."""
    kind = TYPES[path.suffix.lower()]
    data = _inflated(path, width * height * kind.itemsize)
    if len(data) != width * height * kind.itemsize:
        raise InputError(f"{path} does not hold the {width}×{height} values of its recording; record or export it again")
    return np.frombuffer(data, kind).reshape(height, width)


def count_pixels(path: Path) -> int:
    """How many values a map of unknown size holds."""
    kind = TYPES[path.suffix.lower()]
    size = len(_inflated(path, MOST_PIXELS * kind.itemsize))
    if size > MOST_PIXELS * kind.itemsize or size % kind.itemsize:
        raise InputError(f"{path} does not hold a map of numbers, or one of more than {MOST_PIXELS // 10**6} megapixels; export it again")
    return size // kind.itemsize


def _inflated(path: Path, most: int) -> bytes:
    """What `path` inflates to, and one byte more than `most` at most: the decoder stops where the memory given to it ends."""
    codecs = require(path)
    data = read_bytes(path)
    try:
        return bytes(codecs.lzfse_decode(data, out=most + 1))
    except Exception as error:  # its own error, which is a RuntimeError, and memory's
        raise InputError(f"{path} is damaged (it is not a whole LZFSE stream); record or export it again") from error
