"""A COLMAP model with its images: `sparse/0`, `sparse`, `colmap/sparse/0`, `colmap/sparse` or the folder itself.

Of several models below `sparse/`, the one with the most images is taken. Images are looked for in `images/`, else beside.
"""

from __future__ import annotations

from pathlib import Path

from toolkit.capture.colmap_model import Model, holds_model, read_model
from toolkit.capture.colmap_names import locate
from toolkit.capture.listing import (
    assemble,
    counted,
    fitted,
    natural_key,
    picture_header,
    pictures_in,
    require_folder,
    unique_names,
)
from toolkit.capture.masks import masks_among
from toolkit.capture.types import Capture, Frame
from toolkit.errors import InputError

PLACES = ("sparse", "colmap/sparse", ".")


def model_folders(root: Path) -> list[Path]:
    """Folders that hold a model: the numbered ones of the first place that has any, else that place itself."""
    for place in PLACES:
        folder = root / place
        if not folder.is_dir():
            continue
        numbered = [child for child in folder.iterdir() if child.name.isdecimal() and child.is_dir() and holds_model(child)]
        if numbered:
            return sorted(numbered, key=lambda child: natural_key(child.name))
        if holds_model(folder):
            return [folder]
    return []


def looks_like_colmap(path: Path) -> bool:
    return bool(model_folders(path))


def image_folders(root: Path) -> list[Path]:
    """Where the images of a model may lie; also above, when `root` is `…/sparse/0` itself."""
    bases = [root]
    while len(bases) < 4 and (bases[-1].name in ("sparse", "colmap") or bases[-1].name.isdecimal()):
        bases.append(bases[-1].parent)
    return [folder for base in bases for folder in (base / "images", base) if folder.is_dir()]


def read_colmap(path: Path | str) -> Capture:
    """The registered images that exist, with cameras, poses and sparse points in the model's frame.

    Raises:
        InputError: no model, a broken model, none of its images on disk, or an image of another shape than its camera.
    """
    root = require_folder(path)
    folders = model_folders(root)
    if not folders:
        raise InputError(f"{root} holds no COLMAP model (cameras and images as .bin or .txt in sparse/0); export one there")
    models = [read_model(folder) for folder in folders]
    best = max(range(len(models)), key=lambda index: len(models[index].images))
    model = models[best]
    warnings = []
    if len(models) > 1:
        warnings.append(f"{len(models)} models were found; {folders[best].name} has the most images ({len(model.images)}) and is used")
    images, located = _locate(root, model)
    frames, scaled = [], 0
    for index, name in zip(located, unique_names([images[index] for index in located]), strict=True):
        entry = model.images[index]
        described = model.cameras[entry.camera]
        intrinsics = fitted(described, picture_header(images[index]).size, f"{entry.name} in {folders[best]}")
        scaled += intrinsics is not described
        frames.append(Frame(name=name, image=images[index], intrinsics=intrinsics, world_from_camera=entry.world_from_camera))
    missing = len(model.images) - len(frames)
    if missing:
        warnings.append(f"{missing} of the {len(model.images)} images of the model do not exist; the other {len(frames)} are used")
    if scaled:
        warnings.append(f"{counted(scaled, 'picture')} of another size than the model tells; intrinsics were scaled to fit")
    used = set(images.values())
    unregistered = 0
    for folder in {image.parent for image in used}:
        pictures = pictures_in(folder)
        unregistered += len(set(pictures) - used - masks_among(pictures))
    if unregistered:
        warnings.append(f"{counted(unregistered, 'picture')} beside these are not in the model and are left out")
    extra = {"listed": len(model.images), "missing": missing, "unregistered": unregistered}
    return assemble("colmap", root, frames, warnings, points=model.points if len(model.points) else None, extra=extra)


def _locate(root: Path, model: Model) -> tuple[dict[int, Path], list[int]]:
    """Image index → its file, from the folder that holds most of them; and the indices that were found."""
    best: dict[int, Path] = {}
    for folder in image_folders(root):
        found = locate(folder, [entry.name for entry in model.images])
        if len(found) > len(best):
            best = found
    if not best:
        raise InputError(f"none of the {counted(len(model.images), 'image')} of the model in {root} exists; put them in {root / 'images'}")
    return best, sorted(best)
