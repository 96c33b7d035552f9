"""A COLMAP model with its images. Both may lie anywhere below the folder: `sparse/0` and `images/`, `dense/0/sparse` and `dense/0/images`,
the model in one folder and the images in its sibling.

A folder may hold several models, of the photos as they were taken and of undistorted ones, or parts that were not joined. Used is the one
that most images fit by name and by size.

Model files are `cameras`, `images`, `points3D`, as `.bin` or `.txt`; every length in them is checked. COLMAP's pixel centres are at +0.5
like ours.
"""

from __future__ import annotations

import mmap
import re
import struct
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fieldfuse.camera import EQUIRECTANGULAR, FISHEYE, OPENCV, PINHOLE, Array, Intrinsics, invert
from fieldfuse.capture.calibration import fits_shape, fitted, usable_size
from fieldfuse.capture.headers import image_header
from fieldfuse.capture.images import spread
from fieldfuse.capture.listing import assemble, counted, images_in, natural_key, read_text, require_folder, some_of, unique_names
from fieldfuse.capture.masks import masks_among
from fieldfuse.capture.poses import checked_place, rigid
from fieldfuse.capture.resolve import CaptureFiles, Found
from fieldfuse.capture.types import MODEL_NAMES, Capture, Frame
from fieldfuse.errors import InputError, first_line

USUAL = re.compile(r"((colmap|dense|distorted|undistorted)/(\d+/)?)*sparse(/\d+)?|\.")
MOST_MODELS = 20
LEAST_IMAGES = 6  # of a model that is compared with another
SAMPLED = 24  # images of a model whose sizes are compared with its cameras
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
    ("EQUIRECTANGULAR", 2, EQUIRECTANGULAR),
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


@dataclass(frozen=True)
class CandidateModel:
    """A model below a capture's folder, with those of its images that are there."""

    name: str  # of its folder, relative to the capture's
    model: Model
    images: dict[int, Path]  # index of an image of the model → its file
    fit: int  # images whose shape is their camera's, by those looked at
    exact: float  # share of those looked at whose size is their camera's to the pixel
    outside: int  # paths of images that lead outside the capture's folder
    remarks: tuple[str, ...] = ()


def model_folders(root: Path) -> list[Path]:
    """Folders at and below `root` that hold a model, those of fewest parts first."""
    found = [name for name in CaptureFiles(root).folders() if holds_model(root / name)]
    return [root / name for name in sorted(found, key=lambda name: (name.count("/") + bool(name), natural_key(name)))][:MOST_MODELS]


def looks_like_colmap(path: Path) -> bool:
    """Whether a model is where COLMAP and what is made for it put one."""
    return path in owners(path)


def owners(root: Path) -> list[Path]:
    """Folders at and below `root` whose models they are: `scene` of `scene/sparse/0`."""
    out = []
    for folder in model_folders(root):
        if root.name == "sparse" and folder.parent == root and folder.name.isdecimal():
            out.append(root)
            continue
        above = [root, *(root / parent for parent in reversed(folder.relative_to(root).parents)), folder]
        out.append(next(owner for owner in above if USUAL.fullmatch(folder.relative_to(owner).as_posix())))
    return list(dict.fromkeys(out))


def has_images(root: Path) -> bool:
    """Whether images lie where those of a model mostly do."""
    return any(images_in(folder) for folder in (root / "images", root))


def candidate_models(root: Path) -> list[CandidateModel]:
    """The models that can be read, best first: the one that most images fit, by name and size."""
    folders = model_folders(root)
    if not folders:
        raise InputError(f"{root} holds no COLMAP model (cameras and images as .bin or .txt in sparse/0); export one there")
    files = CaptureFiles(_above_model(root))
    candidates, errors, unused = [], [], []
    for folder in folders:
        try:
            candidates.append(_candidate(root, folder, files))
        except InputError as error:
            errors.append(error)
            unused.append(f"the model in {folder.relative_to(root).as_posix()} is not used: {error}")
    ranked = sorted(candidates, key=lambda one: (-one.fit, -one.exact, -len(one.images)))
    if errors and (not ranked or not ranked[0].images):
        raise errors[0]
    out = []
    for one in ranked:
        others = [other for other in ranked if other is not one]
        rest = [f"{other.name} ({counted(len(other.model.images), 'image')}, {other.fit} of which fit)" for other in others]
        remark = f"of several models that in {one.name} is used, which {one.fit} images fit; not used: {some_of(rest)}"
        out.append(replace(one, remarks=(*unused, *([remark] if rest else []), *one.remarks)))
    return out


def model_captures(capture: Capture) -> list[Capture]:
    """The captures that the models in a COLMAP capture's folder make and that have about as many images, itself first; of others alone."""
    if capture.kind != "colmap":
        return [capture]
    out = [capture]
    for candidate in candidate_models(capture.root)[1:MOST_MODELS]:
        with suppress(InputError):
            if len(candidate.images) >= max(LEAST_IMAGES, len(capture.frames) // 2):
                out.append(candidate_capture(capture.root, candidate))
    return out


def read_colmap(path: Path | str) -> Capture:
    """The registered images that exist, with cameras, poses and sparse points in the model's frame.

    Raises:
        InputError: no model, a broken model, none of its images on disk, or an image of another shape than its camera.
    """
    root = require_folder(path)
    return candidate_capture(root, candidate_models(root)[0])


def candidate_capture(root: Path, candidate: CandidateModel) -> Capture:
    """The capture that one of the models makes."""
    model, images = candidate.model, candidate.images
    listed = len(model.images)
    if not images:
        raise CaptureFiles(_above_model(root)).none_exists(f"the model {candidate.name}", listed, Found([], outside=candidate.outside))
    located, warnings = sorted(images), list(candidate.remarks)
    frames, scaled, names = [], 0, {}
    for index, name in zip(located, unique_names([images[index] for index in located]), strict=True):
        entry = model.images[index]
        described = model.cameras[entry.camera]
        intrinsics = fitted(described, image_header(images[index]).size, f"{entry.name} in {root / candidate.name}", images[index])
        scaled += intrinsics is not described
        frames.append(Frame(name=name, image=images[index], intrinsics=intrinsics, world_from_camera=entry.world_from_camera))
        names[name] = entry.name
    missing = listed - len(frames)
    if missing:
        warnings.append(f"{missing} of the {listed} images of the model do not exist; the other {len(frames)} are used")
    if scaled:
        warnings.append(f"{counted(scaled, 'image')} of another size than in the model; intrinsics were scaled to fit")
    used = set(images.values())
    unregistered = 0
    for folder in {image.parent for image in used}:
        beside = images_in(folder)
        unregistered += len(set(beside) - used - masks_among(beside))
    if unregistered:
        warnings.append(f"{counted(unregistered, 'image')} beside these are not in the model and are left out")
    extra = {"listed": listed, "missing": missing, "unregistered": unregistered, MODEL_NAMES: names}
    return assemble("colmap", root, frames, warnings, points=model.points if len(model.points) else None, extra=extra)


def _candidate(root: Path, folder: Path, files: CaptureFiles) -> CandidateModel:
    """The model in `folder` with the images that fit it best: of the folders around it, nearest first, else of any other."""
    model = read_model(folder)
    names = [image.name for image in model.images]
    name = folder.relative_to(root).as_posix()
    found: Found | None = None
    best = (0, 0.0)
    for above in (folder.resolve(), *folder.resolve().parents):
        for base in (place.relative_to(files.root).as_posix() for place in (above / "images", above) if place.is_dir()):
            here = files.find(names, source=name, base=base, anywhere=False)
            fit = _fit(model, here)
            if here.count and (found is None or fit > best):
                found, best = here, fit
        if above == files.root or (found is not None and best[1] == 1 and found.count == len(names)):
            break
    remarks: list[str] = []
    if found is None:
        found = files.find(names, source=name, base="images", anywhere=files.root == root.resolve())
        best = _fit(model, found)
        places = sorted({path.parent.relative_to(files.root).as_posix() for path in found.files if path is not None})
        remarks += [f"the images of the model in {name} were found in {some_of(places)}"] if places else []
    else:
        remarks += found.remarks
    if not USUAL.fullmatch(name):
        remarks.append(f"the COLMAP model was found in {name}")
    there = {index: path for index, path in enumerate(found.files) if path is not None}
    return CandidateModel(name, model, there, *best, found.outside, tuple(remarks))


def _fit(model: Model, found: Found) -> tuple[int, float]:
    """How many images have their camera's shape, and the share of those looked at that have its very size."""
    there = [(image, path) for image, path in zip(model.images, found.files, strict=True) if path is not None]
    chosen = spread(there, SAMPLED)
    shapes = exact = 0
    for image, path in chosen:
        camera = model.cameras[image.camera]
        with suppress(InputError):
            size = image_header(path).size
            exact += size == (camera.width, camera.height)
            shapes += fits_shape(camera, size)
    return round(len(there) * shapes / max(len(chosen), 1)), exact / max(len(chosen), 1)


def _above_model(root: Path) -> Path:
    """The folder that holds a model's images: above `root` when this is the model's own folder (`sparse/0`, `colmap/sparse`,
    `distorted/sparse/1`)."""
    top = root.resolve()
    if top.name.isdecimal() and top.parent.name == "sparse":
        top = top.parent
    for name in ("sparse", "colmap", "distorted"):
        top = top.parent if top.name == name else top
    return top


# --------------------------------------------------------------------------------------------------- model files


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
    if kind == EQUIRECTANGULAR:  # its parameters are the image's size
        return Intrinsics.equirectangular(*usable_size(width, height, where))
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
