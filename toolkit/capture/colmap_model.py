"""COLMAP's model files, `cameras`, `images`, `points3D`, as `.bin` or `.txt`. Plain parsing with every length checked.

Only what a capture needs is kept: cameras, image names with poses, point positions. COLMAP's pixel centres are at +0.5 like ours.
"""

from __future__ import annotations

import mmap
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fieldfuse.camera import FISHEYE, OPENCV, PINHOLE, Array, Intrinsics, invert
from fieldfuse.capture.listing import read_text
from fieldfuse.capture.poses import checked_place, rigid
from fieldfuse.errors import InputError, first_line

MAX_TEXT = 2**30
MAX_SIDE = 1_000_000
BESIDE = 0.5  # of a picture's side by which a principal point may lie outside: pictures may have been cropped once their camera was known
# number, name, parameters
MODELS = (
    (0, "SIMPLE_PINHOLE", 3),
    (1, "PINHOLE", 4),
    (2, "SIMPLE_RADIAL", 4),
    (3, "RADIAL", 5),
    (4, "OPENCV", 8),
    (5, "OPENCV_FISHEYE", 8),
    (6, "FULL_OPENCV", 12),
    (7, "FOV", 5),
    (8, "SIMPLE_RADIAL_FISHEYE", 4),
    (9, "RADIAL_FISHEYE", 5),
    (10, "THIN_PRISM_FISHEYE", 12),
    (11, "RAD_TAN_THIN_PRISM_FISHEYE", 16),
    (12, "SIMPLE_DIVISION", 4),
    (13, "DIVISION", 5),
    (14, "SIMPLE_FISHEYE", 3),
    (15, "FISHEYE", 4),
    (16, "EUCM", 6),
    (17, "EQUIRECTANGULAR", 2),
)
NAME_OF = {number: name for number, name, _ in MODELS}
COUNT_OF = {name: count for _, name, count in MODELS}
ONE_FOCAL = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_FISHEYE")
LENS_OF = {
    "SIMPLE_PINHOLE": PINHOLE,
    "PINHOLE": PINHOLE,
    "SIMPLE_RADIAL": OPENCV,
    "RADIAL": OPENCV,
    "OPENCV": OPENCV,
    "FULL_OPENCV": OPENCV,
    "OPENCV_FISHEYE": FISHEYE,
    "SIMPLE_RADIAL_FISHEYE": FISHEYE,
    "RADIAL_FISHEYE": FISHEYE,
    "SIMPLE_FISHEYE": FISHEYE,
    "FISHEYE": FISHEYE,
}


@dataclass(frozen=True)
class ModelImage:
    """One registered image of a model."""

    name: str
    camera: int
    world_from_camera: Array  # (4, 4), OpenCV axes


@dataclass(frozen=True)
class Model:
    """A reconstruction as stored."""

    cameras: dict[int, Intrinsics]
    images: list[ModelImage]
    points: Array  # (N, 3) float64


def holds_model(folder: Path) -> bool:
    return any(all((folder / f"{part}{suffix}").is_file() for part in ("cameras", "images")) for suffix in (".bin", ".txt"))


def read_model(folder: Path) -> Model:
    """The model in `folder`; binary files go before text files.

    Raises:
        InputError: a file is cut short, holds counts that cannot be, an unsupported camera or an unusable pose.
    """
    suffix = ".bin" if all((folder / f"{part}.bin").is_file() for part in ("cameras", "images")) else ".txt"
    cameras, images, points = (folder / f"{part}{suffix}" for part in ("cameras", "images", "points3D"))
    empty = np.zeros((0, 3))
    if suffix == ".bin":
        found = points.is_file()
        model = Model(_cameras_bin(cameras), _images_bin(images), _points_bin(points) if found else empty)
    else:
        found = points.is_file()
        model = Model(_cameras_txt(cameras), _images_txt(images), _points_txt(points) if found else empty)
    if not model.images:
        raise InputError(f"the model in {folder} has no registered images; run structure from motion again")
    for image in model.images:
        if image.camera not in model.cameras:
            raise InputError(f"{images}: the image {image.name!r} uses camera {image.camera}, which {cameras.name} does not hold")
    return model


def intrinsics_of(model: str, width: int, height: int, values: list[float], where: str) -> Intrinsics:
    """A COLMAP camera as ours; its radial models are OpenCV's with the absent coefficients 0.

    Raises:
        InputError: the model has no counterpart here, or the values are no usable camera.
    """
    if model not in LENS_OF:
        raise InputError(f"{where}: the camera model {model} is not supported; run `colmap image_undistorter` and give its output")
    if len(values) != COUNT_OF[model]:
        raise InputError(
            f"{where}: the camera model {model} has {COUNT_OF[model]} parameters, not {len(values)}; check how the file was written"
        )
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE):
        raise InputError(f"{where}: the image size {width}×{height} is not usable; check how the file was written")
    head = [values[0], *values] if model in ONE_FOCAL else values
    fx, fy, cx, cy, *lens = head
    if LENS_OF[model] != PINHOLE:
        lens += [0.0] * (4 - len(lens))
    return Intrinsics(width, height, fx, fy, cx, cy, LENS_OF[model], tuple(lens)).checked(where).centred(where, BESIDE)


def _image(name: str, camera: int, quaternion: list[float], translation: list[float], where: str) -> ModelImage:
    if not np.isfinite(translation).all():
        raise InputError(f"{where}: the pose of {name!r} holds a value that is not finite; remove this image from the model")
    where = f"{where}, image {name!r}"
    checked_place(np.array(translation), where)
    camera_from_world = rigid(np.array(quaternion), np.array(translation), where)
    return ModelImage(name, camera, invert(camera_from_world))


# --------------------------------------------------------------------------------------------------- binary


class _Reader:
    """Reads little-endian values from a buffer, never beyond its end."""

    def __init__(self, buffer: mmap.mmap | bytes, path: Path) -> None:
        self.buffer, self.path, self.at, self.size = buffer, path, 0, len(buffer)

    def take(self, layout: str) -> tuple[float, ...]:
        length = struct.calcsize(layout)
        if self.at + length > self.size:
            raise self.short()
        values = struct.unpack_from(layout, self.buffer, self.at)
        self.at += length
        return values

    def skip(self, count: int, width: int) -> None:
        if count * width > self.size - self.at:
            raise self.short()
        self.at += count * width

    def count(self, smallest: int) -> int:
        """A number of records, each at least `smallest` bytes long."""
        value = int(self.take("<Q")[0])
        if value * smallest > self.size - self.at:
            raise self.short()
        return value

    def text(self) -> str:
        end = self.buffer.find(b"\0", self.at, min(self.size, self.at + 4096))
        if end < 0:
            raise InputError(f"{self.path} holds an image name without end; check how it was written")
        raw = bytes(self.buffer[self.at : end])
        self.at = end + 1
        try:
            return raw.decode("utf-8")
        except UnicodeDecodeError as error:
            raise InputError(f"{self.path} holds an image name that is not UTF-8; check how it was written") from error

    def short(self) -> InputError:
        return InputError(f"{self.path} ends before its own counts say (at byte {self.at} of {self.size}); copy or write the model again")


@contextmanager
def _opened(path: Path) -> Iterator[_Reader]:
    # Mapped, not read: `images.bin` holds every feature point and may be larger than memory.
    try:
        with path.open("rb") as stream:
            if path.stat().st_size == 0:
                raise InputError(f"{path} is empty; copy or write the model again")
            with mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as buffer:
                yield _Reader(buffer, path)
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from error


def _cameras_bin(path: Path) -> dict[int, Intrinsics]:
    out = {}
    with _opened(path) as reader:
        for _ in range(reader.count(24)):
            number, model, width, height = (int(value) for value in reader.take("<IiQQ"))
            name = NAME_OF.get(model)
            if name is None:
                raise InputError(f"{path}: camera {number} has the unknown model {model}; check how the file was written")
            out[number] = intrinsics_of(name, width, height, list(reader.take(f"<{COUNT_OF[name]}d")), f"{path}, camera {number}")
    return out


def _images_bin(path: Path) -> list[ModelImage]:
    out = []
    with _opened(path) as reader:
        for _ in range(reader.count(73)):
            values = reader.take("<I7dI")
            name = reader.text()
            reader.skip(reader.count(24), 24)
            out.append(_image(name, int(values[8]), list(values[1:5]), list(values[5:8]), str(path)))
    return out


def _points_bin(path: Path) -> Array:
    with _opened(path) as reader:
        count = reader.count(51)
        points = np.empty((count, 3))
        for index in range(count):
            values = reader.take("<QdddBBBdQ")
            points[index] = values[1:4]
            reader.skip(int(values[8]), 8)
    return points[np.isfinite(points).all(axis=1)]


# --------------------------------------------------------------------------------------------------- text


def _lines(path: Path) -> list[str]:
    return read_text(path, MAX_TEXT).splitlines()


def _broken(path: Path, number: int, error: Exception) -> InputError:
    return InputError(f"{path}, line {number + 1} cannot be read ({first_line(error)}); check how it was written")


def _cameras_txt(path: Path) -> dict[int, Intrinsics]:
    out = {}
    for number, line in enumerate(_lines(path)):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            camera, model, width, height = int(words[0]), words[1], int(words[2]), int(words[3])
            values = [float(word) for word in words[4:]]
        except (ValueError, IndexError) as error:
            raise _broken(path, number, error) from error
        out[camera] = intrinsics_of(model, width, height, values, f"{path}, camera {camera}")
    return out


def _images_txt(path: Path) -> list[ModelImage]:
    out = []
    numbered = iter(enumerate(_lines(path)))
    for number, line in numbered:
        words = line.strip().split(maxsplit=9)
        if not words or words[0].startswith("#"):
            continue
        next(numbered, None)  # the feature points of this image; the line may be blank
        try:
            values, camera, name = [float(word) for word in words[1:8]], int(words[8]), words[9]
        except (ValueError, IndexError) as error:
            raise _broken(path, number, error) from error
        out.append(_image(name, camera, values[:4], values[4:], str(path)))
    return out


def _points_txt(path: Path) -> Array:
    rows = []
    for number, line in enumerate(_lines(path)):
        words = line.split(maxsplit=4)
        if not words or words[0].startswith("#"):
            continue
        try:
            rows.append([float(words[1]), float(words[2]), float(words[3])])
        except (ValueError, IndexError) as error:
            raise _broken(path, number, error) from error
    points = np.array(rows, dtype=np.float64).reshape(-1, 3)
    return points[np.isfinite(points).all(axis=1)]
