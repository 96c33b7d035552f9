"""A COLMAP model with its images. Both may lie anywhere below the folder: `sparse/0` and `images/`, `dense/0/sparse` and `dense/0/images`,
the model in one folder and the images in its sibling.

A folder may hold several models, of the photos as they were taken and of undistorted ones, or parts that were not joined. Used is the one
that most images fit by name and by size.
"""

from __future__ import annotations

import re
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from fieldfuse.capture.calibration import fits_shape, fitted
from fieldfuse.capture.colmap_model import Model, holds_model, read_model
from fieldfuse.capture.headers import image_header
from fieldfuse.capture.images import spread
from fieldfuse.capture.listing import assemble, counted, images_in, natural_key, require_folder, some_of, unique_names
from fieldfuse.capture.masks import masks_among
from fieldfuse.capture.resolve import CaptureFiles, Found
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.errors import InputError

USUAL = re.compile(r"((colmap|dense|distorted|undistorted)/(\d+/)?)*sparse(/\d+)?|\.")
MOST_MODELS = 20
LEAST_IMAGES = 6  # of a model that is compared with another
SAMPLED = 24  # images of a model whose sizes are compared with its cameras


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
    frames, scaled = [], 0
    for index, name in zip(located, unique_names([images[index] for index in located]), strict=True):
        entry = model.images[index]
        described = model.cameras[entry.camera]
        intrinsics = fitted(described, image_header(images[index]).size, f"{entry.name} in {root / candidate.name}", images[index])
        scaled += intrinsics is not described
        frames.append(Frame(name=name, image=images[index], intrinsics=intrinsics, world_from_camera=entry.world_from_camera))
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
    extra = {"listed": listed, "missing": missing, "unregistered": unregistered}
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
    """The folder that holds a model's images: above `root` when this is the model's own folder (`sparse/0`, `colmap/sparse`)."""
    top = root.resolve()
    if top.name.isdecimal() and top.parent.name == "sparse":
        top = top.parent
    for name in ("sparse", "colmap"):
        top = top.parent if top.name == name else top
    return top
