"""COLMAP's model files, `cameras`, `images`, `points3D`, as `.bin` or `.txt`. Plain parsing with every length checked.

Only what a capture needs is read: cameras, image names with poses, point positions. COLMAP's pixel centres are at +0.5 like ours.
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
from fieldfuse.capture.calibration import usable_size
from fieldfuse.capture.listing import read_text
from fieldfuse.capture.poses import checked_place, rigid
from fieldfuse.errors import InputError, first_line

MAX_TEXT = 2**30
BESIDE = 0.5  # of an image's side by which a principal point may lie outside: images may have been cropped once their camera was known
MODELS = (  # by COLMAP's numbers: name, parameters, and our lens, where it has one
    ("SIMPLE_PINHOLE", 3, PINHOLE),
    ("PINHOLE", 4, PINHOLE),
    ("SIMPLE_RADIAL", 4, OPENCV),
    ("RADIAL", 5, OPENCV),
    ("OPENCV", 8, OPENCV),
    ("OPENCV_FISHEYE", 8, FISHEYE),
    ("FULL_OPENCV", 12, OPENCV),
    ("FOV", 5, None),
    ("SIMPLE_RADIAL_FISHEYE", 4, FISHEYE),
    ("RADIAL_FISHEYE", 5, FISHEYE),
    ("THIN_PRISM_FISHEYE", 12, None),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16, None),
    ("SIMPLE_DIVISION", 4, None),
    ("DIVISION", 5, None),
    ("SIMPLE_FISHEYE", 3, FISHEYE),
    ("FISHEYE", 4, FISHEYE),
    ("EUCM", 6, None),
    ("EQUIRECTANGULAR", 2, None),
)
SUPPORTED = {name: (count, lens) for name, count, lens in MODELS if lens is not None}
ONE_FOCAL = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_FISHEYE")


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
    """The model in `folder`; binary files go before text files."""
    binary = all((folder / f"{part}.bin").is_file() for part in ("cameras", "images"))
    cameras, images, points = (folder / f"{part}.{'bin' if binary else 'txt'}" for part in ("cameras", "images", "points3D"))
    positions = np.zeros((0, 3))
    if points.is_file():
        positions = np.fromiter((_points_bin if binary else _points_txt)(points), dtype=np.dtype((np.float64, 3)))
    model = Model(
        dict((_cameras_bin if binary else _cameras_txt)(cameras)),
        list((_images_bin if binary else _images_txt)(images)),
        positions[np.isfinite(positions).all(axis=1)],
    )
    if not model.images:
        raise InputError(f"the model in {folder} has no registered images; run structure from motion again")
    for image in model.images:
        if image.camera not in model.cameras:
            raise InputError(f"{images}: the image {image.name!r} uses camera {image.camera}, which {cameras.name} does not hold")
    return model


def intrinsics_of(model: str, width: int, height: int, values: list[float], where: str) -> Intrinsics:
    """A COLMAP camera as ours; its radial models are OpenCV's with the absent coefficients 0."""
    if model not in SUPPORTED:
        raise InputError(f"{where}: the camera model {model} is not supported; run `colmap image_undistorter` and give its output")
    count, kind = SUPPORTED[model]
    if len(values) != count:
        raise InputError(f"{where}: the camera model {model} has {count} parameters, not {len(values)}; check how the file was written")
    fx, fy, cx, cy, *lens = [values[0], *values] if model in ONE_FOCAL else values
    if kind != PINHOLE:
        lens += [0.0] * (4 - len(lens))
    return Intrinsics(*usable_size(width, height, where), fx, fy, cx, cy, kind, tuple(lens)).checked(where).centred(where, BESIDE)


def _image(name: str, camera: int, values: list[float], where: str) -> ModelImage:
    """From the quaternion and translation of camera_from_world."""
    place = np.array(values[4:])
    if not np.isfinite(place).all():
        raise InputError(f"{where}: the pose of {name!r} holds a value that is not finite; remove this image from the model")
    where = f"{where}, image {name!r}"
    checked_place(place, where)
    return ModelImage(name, camera, invert(rigid(np.array(values[:4]), place, where)))


# --------------------------------------------------------------------------------------------------- binary


class _Reader:
    """Reads little-endian values from a buffer, never beyond its end."""

    def __init__(self, buffer: mmap.mmap | bytes, path: Path) -> None:
        self.buffer, self.path, self.at, self.size = buffer, path, 0, len(buffer)

    def skip(self, count: int, width: int) -> None:
        if count * width > self.size - self.at:
            raise InputError(
                f"{self.path} ends before its own counts (at byte {self.at} of {self.size}); copy or write the model again"
            )
        self.at += count * width

    def take(self, layout: str) -> tuple[float, ...]:
        self.skip(1, struct.calcsize(layout))
        return struct.unpack_from(layout, self.buffer, self.at - struct.calcsize(layout))

    def count(self, smallest: int) -> int:
        """A number of records, each at least `smallest` bytes long."""
        value, at = int(self.take("<Q")[0]), self.at
        self.skip(value, smallest)
        self.at = at
        return value

    def text(self) -> str:
        end = self.buffer.find(b"\0", self.at, min(self.size, self.at + 4096))
        raw = bytes(self.buffer[self.at : max(end, self.at)])
        self.at = end + 1
        try:
            if end < 0:
                raise ValueError
            return raw.decode("utf-8")
        except ValueError as error:
            raise InputError(f"{self.path} holds an image name without end, or not in UTF-8; check how it was written") from error


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


def _cameras_bin(path: Path) -> Iterator[tuple[int, Intrinsics]]:
    with _opened(path) as reader:
        for _ in range(reader.count(24)):
            number, model, width, height = (int(value) for value in reader.take("<IiQQ"))
            if not 0 <= model < len(MODELS):
                raise InputError(f"{path}: camera {number} has the unknown model {model}; check how the file was written")
            name, count, _ = MODELS[model]
            yield number, intrinsics_of(name, width, height, list(reader.take(f"<{count}d")), f"{path}, camera {number}")


def _images_bin(path: Path) -> Iterator[ModelImage]:
    with _opened(path) as reader:
        for _ in range(reader.count(73)):
            values = reader.take("<I7dI")
            name = reader.text()
            reader.skip(reader.count(24), 24)
            yield _image(name, int(values[8]), list(values[1:8]), str(path))


def _points_bin(path: Path) -> Iterator[tuple[float, ...]]:
    with _opened(path) as reader:
        for _ in range(reader.count(51)):
            values = reader.take("<QdddBBBdQ")
            yield values[1:4]
            reader.skip(int(values[8]), 8)


# --------------------------------------------------------------------------------------------------- text


@contextmanager
def _line(path: Path, number: int) -> Iterator[None]:
    """Around the parsing of a line, which is named where it fails."""
    try:
        yield
    except (ValueError, IndexError) as error:
        raise InputError(f"{path}, line {number + 1} cannot be read ({first_line(error)}); check how it was written") from error


def _cameras_txt(path: Path) -> Iterator[tuple[int, Intrinsics]]:
    for number, line in enumerate(read_text(path, MAX_TEXT).splitlines()):
        words = line.split()
        if words and not words[0].startswith("#"):
            with _line(path, number):
                camera, model, width, height = int(words[0]), words[1], int(words[2]), int(words[3])
                values = [float(word) for word in words[4:]]
            yield camera, intrinsics_of(model, width, height, values, f"{path}, camera {camera}")


def _images_txt(path: Path) -> Iterator[ModelImage]:
    numbered = iter(enumerate(read_text(path, MAX_TEXT).splitlines()))
    for number, line in numbered:
        words = line.strip().split(maxsplit=9)
        if words and not words[0].startswith("#"):
            next(numbered, None)  # the feature points of this image; the line may be blank
            with _line(path, number):
                values, camera, name = [float(word) for word in words[1:8]], int(words[8]), words[9]
            yield _image(name, camera, values, str(path))


def _points_txt(path: Path) -> Iterator[tuple[float, ...]]:
    for number, line in enumerate(read_text(path, MAX_TEXT).splitlines()):
        words = line.split(maxsplit=4)
        if words and not words[0].startswith("#"):
            with _line(path, number):
                yield float(words[1]), float(words[2]), float(words[3])
