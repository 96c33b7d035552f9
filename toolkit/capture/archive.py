"""Files of captures, some of them read inside a zip file: `walk.r3d/rgbd/0.jpg` is the member `rgbd/0.jpg` of `walk.r3d`.

Members are looked up and never written by their names, so what a zip says its members are called cannot lead anywhere. Record3D's maps of
depth (`.depth`: float32) and confidence (`.conf`: uint8) are compressed by Apple's LZFSE. imagecodecs reads them; it is imported with the
first such capture, so that all else works without it.
"""

from __future__ import annotations

import zipfile
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from fieldfuse.camera import Array
from fieldfuse.errors import InputError, first_line

SUFFIXES = (".r3d", ".zip")
MOST_BYTES = 64 * 2**20  # of one member: an image of a phone has five
MAPS: dict[str, np.dtype[Any]] = {".depth": np.dtype("<f4"), ".conf": np.dtype("u1")}
MAP_PIXELS = 4_000_000  # of a map of unknown size: the largest is the front camera's, 720×960


def archive_of(path: Path) -> Path | None:
    """The zip file that `path` names a member of, None where it names none."""
    return next((folder for folder in path.parents if folder.suffix.lower() in SUFFIXES and folder.is_file()), None)


def members(archive: Path) -> list[str]:
    """Names of everything in a zip file."""
    return open_archive(archive).namelist()


def read_bytes(path: Path) -> bytes:
    """The whole file, which may be a zip file's member.

    Raises:
        InputError: missing, unreadable or empty.
    """
    try:
        data = Path(path).read_bytes()
    except NotADirectoryError:
        data = read_member(Path(path))
    except OSError as error:
        raise InputError(f"cannot read the image {path}: {error.strerror or error}") from error
    if not data:
        raise InputError(f"the image {path} is empty (0 bytes); copy it again or remove it")
    return data


def read_member(path: Path, most: int = MOST_BYTES) -> bytes:
    """All bytes of a member; `path` is that of the archive with the member's name behind it."""
    archive = archive_of(path)
    if archive is None:
        raise InputError(f"cannot read {path}: it does not lie in a zip file; check the name")
    opened, name = open_archive(archive), path.relative_to(archive).as_posix()
    try:
        size = opened.getinfo(name).file_size  # bounds what is inflated
        if size > most:
            raise InputError(f"{path} has {size / 2**20:.0f} MB when it is unpacked, more than the {most / 2**20:.0f} MB that are read")
        return opened.read(name)
    except KeyError as error:
        raise InputError(f"{archive} holds no {name}; export it again") from error
    except InputError:
        raise
    except Exception as error:  # zipfile, zlib and the system raise many families on damaged files
        raise InputError(f"{path} cannot be read ({first_line(error)}); copy or export {archive.name} again") from error


def open_archive(archive: Path) -> zipfile.ZipFile:
    """An open zip file.

    Raises:
        InputError: it cannot be read, or is none.
    """
    try:
        stat = archive.stat()
        return _cached(archive, stat.st_size, stat.st_mtime_ns)
    except OSError as error:
        raise InputError(f"cannot read {archive}: {error.strerror or error}") from error
    except Exception as error:  # the directory of a damaged zip raises many families
        raise InputError(f"{archive} is no zip file, or one that is cut short; copy it again from where it was recorded") from error


@lru_cache(maxsize=2)
def _cached(archive: Path, size: int, modified: int) -> zipfile.ZipFile:
    """An open zip file: reading its directory takes tens of milliseconds where it has thousands of members."""
    return zipfile.ZipFile(archive)


def require_lzfse(path: Path) -> Any:
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
    kind = MAPS[path.suffix.lower()]
    data = _inflated(path, width * height * kind.itemsize)
    if len(data) != width * height * kind.itemsize:
        raise InputError(f"{path} does not hold the {width}×{height} values of its recording; record or export it again")
    return np.frombuffer(data, kind).reshape(height, width)


def count_pixels(path: Path) -> int:
    """How many values a map of unknown size holds."""
    kind = MAPS[path.suffix.lower()]
    size = len(_inflated(path, MAP_PIXELS * kind.itemsize))
    if size > MAP_PIXELS * kind.itemsize or size % kind.itemsize:
        raise InputError(f"{path} does not hold a map of numbers, or one of more than {MAP_PIXELS // 10**6} megapixels; export it again")
    return size // kind.itemsize


def _inflated(path: Path, most: int) -> bytes:
    """What `path` inflates to, and one byte more than `most` at most: the decoder stops where the memory given to it ends."""
    codecs = require_lzfse(path)
    data = read_bytes(path)
    try:
        return bytes(codecs.lzfse_decode(data, out=most + 1))
    except Exception as error:  # its own error, which is a RuntimeError, and memory's
        raise InputError(f"{path} is damaged (it is not a whole LZFSE stream); record or export it again") from error
