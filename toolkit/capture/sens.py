"""`.sens` files, in which ScanNet is published: one file a scan, with all its images, depth and poses. Version 4, little-endian.

A header (sensor's name, the two cameras, codings of images and depth, their sizes), then frame by frame a 4×4 float32
world_from_camera by rows, two times in microseconds, the sizes of image and depth, and their bytes; readings of the phone's other
sensors may follow. A file has gigabytes: `scan` reads what stands between the images, and these are read when they are used.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np

from fieldfuse.camera import Array
from fieldfuse.capture.headers import MAX_PIXELS, read_header
from fieldfuse.errors import InputError

SUFFIX = ".sens"
VERSION, OTHER_VERSIONS = 4, 100
RAW, PNG, JPEG = 0, 1, 2  # codings of images
RAW_DEPTH, ZLIB_DEPTH = 0, 1  # and of depth, 16 bits a pixel; 2 is a coding of one maker's library
MAX_NAME = 4096  # bytes of the sensor's name
MOST_FRAMES = 50_000  # half an hour at 30 a second
_CAMERAS = struct.Struct("<64f2i4IfQ")  # four 4×4 matrices, two codings, two sizes, stored depth to the metre, number of frames
_FRAME = struct.Struct("<16f4Q")  # pose, time of image and depth, bytes of image and depth


@dataclass(frozen=True)
class Sens:
    """The headers in a file of N frames."""

    path: Path
    matrices: Array  # (4, 4, 4) float64: intrinsic and extrinsic of the image's camera, then of the depth's
    codings: tuple[int, int]  # of images and of depth
    size: tuple[int, int]  # of images, width and height
    depth_size: tuple[int, int]
    depth_scale: float  # stored values to the metre
    poses: Array  # (N, 4, 4) float64
    times: Array  # (N,) uint64 microseconds, of the images
    places: Array  # (N, 3) int64: where the image's bytes begin, how many they are, and how many of depth follow

    def __len__(self) -> int:
        return len(self.places)


def is_sens(path: Path) -> bool:
    """Whether a file is of this kind, by its name."""
    return path.suffix.lower() == SUFFIX


def scan(path: Path) -> Sens:
    """The headers of a file."""
    try:
        state = Path(path).stat()
        return _scan(Path(path), state.st_size, state.st_mtime_ns)
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from error


@lru_cache(maxsize=16)  # training draws from many files in turn
def _scan(path: Path, size: int, _: int) -> Sens:
    with path.open("rb", buffering=0) as file:  # a frame's headers are few bytes, far apart
        return _read(file, path, size)


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
    for coding, most, what, usual in ((codings[0], JPEG, "images", "JPEG"), (codings[1], ZLIB_DEPTH, "depth", "zlib")):
        if not 0 <= coding <= most:
            raise InputError(
                f"{path} holds {what} in coding {coding}, which is not read (ScanNet's is {usual}); "
                "export color/, depth/, pose/ and intrinsic/ by ScanNet's own reader and give their folder"
            )
    for sides in ((width, height), (depth_width, depth_height)):
        if not (min(sides) > 0 and sides[0] * sides[1] <= MAX_PIXELS):
            raise InputError(f"{path} announces images of {sides[0]}×{sides[1]} pixels, which cannot be; copy it again")
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
        image, depth = _FRAME.unpack(frame)[18:] if len(frame) == _FRAME.size else (size, 0)
        if at + image + depth > size:
            raise InputError(f"{path} is cut short (it ends within frame {index} of {count}); copy it again")
        poses[index] = np.frombuffer(frame, "<f4", 16).reshape(4, 4)
        times[index], places[index] = _FRAME.unpack(frame)[16], (at, image, depth)
        begin = at + image + depth
        file.seek(begin)
    matrices = np.array(values[:64], dtype=np.float64).reshape(4, 4, 4)
    sizes = (width, height), (depth_width, depth_height)
    return Sens(path, matrices, (codings[0], codings[1]), *sizes, float(scale), poses, times, places)


def iterate_sens(path: Path, indices: Collection[int] | None = None) -> Iterator[tuple[int, Array]]:
    """The images of a file (of `indices`; None: all that there are) as (index, (H, W, 3) uint8 RGB), in order."""
    found = scan(path)
    for index in range(len(found)) if indices is None else sorted(indices):
        if indices is not None or found.places[index, 1]:
            yield index, _image(found, index)


def sens_size(found: Sens, index: int, data: bytes | None = None) -> tuple[int, int]:
    """Width and height of image number `index` (its bytes are `data`, or read), which may be smaller than the file's header has it."""
    data = sens_bytes(found, index) if data is None else data
    if found.codings[0] == RAW:
        if len(data) != 3 * found.size[0] * found.size[1]:
            raise _damaged(found, index, "image")
        return found.size
    try:
        return read_header(data, found.path).size  # refuses what is cut short, too
    except InputError as error:
        raise _damaged(found, index, "image") from error


def _image(found: Sens, index: int) -> Array:
    data = sens_bytes(found, index)
    width, height = sens_size(found, index, data)
    if found.codings[0] == RAW:
        return np.frombuffer(data, np.uint8).reshape(height, width, 3)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        image = None
    if image is None:
        raise _damaged(found, index, "image")
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))


def sens_depth(path: Path, index: int) -> Array:
    """The depth of frame `index` as it is stored, (H, W) uint16; 0 = missing."""
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
    """The image or the depth of frame `index` as it is coded."""
    if not 0 <= index < len(found) or not found.places[index, 1 + depth]:
        what = "depth" if depth else "image"
        raise InputError(f"{found.path} holds no {what} of a frame {index}; give the file that the run began with")
    begin, image, deep = (int(value) for value in found.places[index])
    try:
        with found.path.open("rb") as file:
            file.seek(begin + depth * image)
            return file.read(deep if depth else image)
    except OSError as error:
        raise InputError(f"cannot read {found.path}: {error.strerror or error}") from error


def _damaged(found: Sens, index: int, what: str) -> InputError:
    return InputError(f"the {what} of frame {index} in {found.path} is damaged; copy the file again from where it was published")
