"""`.sens` files, in which ScanNet is published: one file a scan, with all its pictures, depth and poses. Version 4, little-endian.

A header (sensor's name, the two cameras, how pictures and depth are packed, their sizes), then frame by frame a 4×4 float32
world_from_camera by rows, two times in microseconds, the sizes of picture and depth, and their bytes; readings of the phone's other
sensors may follow. A file has gigabytes: `scan` reads what stands between the pictures, and these are read when they are used
(`sens_frames`).
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import BinaryIO

import numpy as np

from fieldfuse.camera import Array
from fieldfuse.capture.headers import MAX_PIXELS
from fieldfuse.errors import InputError

SUFFIX = ".sens"
VERSION, OTHER_VERSIONS = 4, 100
RAW, PNG, JPEG = 0, 1, 2  # how pictures are packed
RAW_DEPTH, ZLIB_DEPTH = 0, 1  # and depth, 16 bits a pixel; 2 is a coding of one maker's library
MAX_NAME = 4096  # bytes of the sensor's name
MOST_FRAMES = 50_000  # half an hour at 30 a second
_CAMERAS = struct.Struct("<64f2i4IfQ")  # four 4×4 matrices, two codings, two sizes, stored depth to the metre, number of frames
_FRAME = struct.Struct("<16f4Q")  # pose, time of picture and depth, bytes of picture and depth
_KEPT = 16  # scans kept in mind: training draws from many files in turn


@dataclass(frozen=True)
class Sens:
    """What the headers in a file say; N frames."""

    path: Path
    matrices: Array  # (4, 4, 4) float64: intrinsic and extrinsic of the picture's camera, then of the depth's
    codings: tuple[int, int]  # of pictures and of depth
    size: tuple[int, int]  # of pictures, width and height
    depth_size: tuple[int, int]
    depth_scale: float  # stored values to the metre
    poses: Array  # (N, 4, 4) float64
    times: Array  # (N,) uint64 microseconds, of the pictures
    places: Array  # (N, 3) int64: where the picture's bytes begin, how many they are, and how many of depth follow

    def __len__(self) -> int:
        return len(self.places)


def is_sens(path: Path) -> bool:
    """Whether a file is of this kind, by its name."""
    return path.suffix.lower() == SUFFIX


def scan(path: Path) -> Sens:
    """The headers of a file.

    Raises:
        InputError: missing, not such a file, of another version, packed in a way that is not read, or cut short.
    """
    try:
        state = Path(path).stat()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from error
    return _scan(Path(path), state.st_size, state.st_mtime_ns)


@lru_cache(maxsize=_KEPT)
def _scan(path: Path, size: int, _: int) -> Sens:
    try:
        with path.open("rb", buffering=0) as file:  # a frame's headers are few bytes, far apart
            return _read(file, path, size)
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from error


def _read(file: BinaryIO, path: Path, size: int) -> Sens:
    head = file.read(12)
    version = int.from_bytes(head[:4], "little")
    if len(head) < 12 or version != VERSION:
        what = "is cut short" if len(head) < 12 else f"is one of version {version}" if version < OTHER_VERSIONS else "begins as none does"
        raise InputError(f"{path} is to be a .sens file of version {VERSION} and {what}; copy it again from where it was published")
    length = int.from_bytes(head[4:], "little")
    file.seek(12 + min(length, MAX_NAME))  # past the sensor's name
    rest = file.read(_CAMERAS.size)
    if length > MAX_NAME or len(rest) < _CAMERAS.size:
        raise InputError(f"{path} is no .sens file, or ends within its header; copy it again from where it was published")
    values = _CAMERAS.unpack(rest)
    codings, (width, height, depth_width, depth_height, scale, count) = values[64:66], values[66:]
    _refuse_codings(path, *codings)
    for sides in ((width, height), (depth_width, depth_height)):
        if not (min(sides) > 0 and sides[0] * sides[1] <= MAX_PIXELS):
            raise InputError(f"{path} announces pictures of {sides[0]}×{sides[1]} pixels, which cannot be; copy it again")
    if not (np.isfinite(scale) and scale > 0):
        raise InputError(f"{path} announces {scale:g} for each metre of depth, which cannot be; copy it again")
    begin = file.tell()
    if count > min((size - begin) // _FRAME.size, MOST_FRAMES):
        raise InputError(
            f"{path} announces {count} frames, more than its {size} bytes can hold, or than are read ({MOST_FRAMES}); copy it again"
        )
    poses, times, places = np.empty((count, 4, 4)), np.empty(count, np.uint64), np.empty((count, 3), np.int64)
    for index in range(count):
        frame = file.read(_FRAME.size)
        at = begin + _FRAME.size
        picture, depth = _FRAME.unpack(frame)[18:] if len(frame) == _FRAME.size else (size, 0)
        if at + picture + depth > size:
            raise InputError(f"{path} is cut short (it ends within frame {index} of {count}); copy it again")
        poses[index] = np.frombuffer(frame, "<f4", 16).reshape(4, 4)
        times[index], places[index] = _FRAME.unpack(frame)[16], (at, picture, depth)
        begin = at + picture + depth
        file.seek(begin)
    return Sens(
        path,
        np.array(values[:64], dtype=np.float64).reshape(4, 4, 4),
        (codings[0], codings[1]),
        (width, height),
        (depth_width, depth_height),
        float(scale),
        poses,
        times,
        places,
    )


def _refuse_codings(path: Path, colour: int, depth: int) -> None:
    for coding, known, what, told in ((colour, (RAW, PNG, JPEG), "pictures", "JPEG"), (depth, (RAW_DEPTH, ZLIB_DEPTH), "depth", "zlib")):
        if coding not in known:
            raise InputError(
                f"{path} holds {what} packed in way {coding}, which is not read (ScanNet's is {told}); "
                "export color/, depth/, pose/ and intrinsic/ by ScanNet's own reader and give their folder"
            )
