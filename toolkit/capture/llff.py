"""LLFF: `poses_bounds.npy` and images in `images/`, `images_4/`, `images_8/`, …

Each row holds a 3×5 matrix (camera-to-world with axes down, right, back; then height, width, focal) and the nearest and farthest
depth. Rows belong to the images in plain alphabetical order. The principal point is the image's centre; there is no lens.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fieldfuse.camera import Array, Intrinsics, world_from_llff
from fieldfuse.capture.calibration import fitted, usable_size
from fieldfuse.capture.headers import image_header
from fieldfuse.capture.listing import assemble, counted, images_in, require_folder, unique_names
from fieldfuse.capture.masks import is_mask_folder, masks_among
from fieldfuse.capture.poses import checked_pose, single_frame
from fieldfuse.capture.resolve import BESIDE, CaptureFiles
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.errors import InputError, first_line

NAME = "poses_bounds.npy"


def looks_like_llff(path: Path) -> bool:
    return (path / NAME).is_file()


def read_llff(path: Path | str) -> Capture:
    """Posed images; `extra` has `near` and `far`, the extreme depth bounds.

    Raises:
        InputError: the array is not of this kind, no folder has one image a row, or a pose or focal length is not usable.
    """
    root = require_folder(path)
    file = root / NAME
    try:
        rows: Array = np.array(np.load(file, mmap_mode="r", allow_pickle=False))
        if rows.dtype.kind not in "fiu" or rows.ndim != 2 or rows.shape[1] != 17:
            raise ValueError(f"shape {rows.shape}, type {rows.dtype}")
    except Exception as error:  # NumPy's parser raises many families on broken files
        raise InputError(f"{file} is not an LLFF array of 17 numbers an image ({first_line(error)}); check how it was written") from error
    rows = rows.astype(np.float64)
    images, remarks = _images(root, len(rows))
    frames = []
    for index, (image, name) in enumerate(zip(images, unique_names(images), strict=True)):
        where = f"{file}, row {index} ({image.name})"
        with single_frame(name):
            matrix = rows[index, :15].reshape(3, 5)
            pose = checked_pose(world_from_llff(matrix[:, :4]), where)
            height, width, focal = matrix[:, 4].tolist()
            camera = Intrinsics(*usable_size(width, height, where), focal, focal, width / 2, height / 2).checked(where)
            intrinsics = fitted(camera, image_header(image).size, where, image)
            frames.append(Frame(name=name, image=image, intrinsics=intrinsics, world_from_camera=pose))
    bounds = rows[:, 15:]
    extra = {"near": float(bounds[:, 0].min()), "far": float(bounds[:, 1].max())} if np.isfinite(bounds).all() else {}
    return assemble("llff", root, frames, remarks, extra=extra)


def _images(root: Path, rows: int) -> tuple[list[Path], list[str]]:
    """One image a row, in alphabetical order: `images/` first, else the folder with the largest images, else the only one that fits."""
    counts: dict[str, int] = {}
    candidates: list[tuple[bool, int, list[Path]]] = []
    for folder in sorted(path for path in root.iterdir() if path.is_dir() and (path.name == "images" or path.name.startswith("images_"))):
        if is_mask_folder(folder.name):
            continue
        listed = images_in(folder)
        found = sorted(set(listed) - masks_among(listed), key=lambda path: path.name)
        counts[folder.name] = len(found)
        if found and len(found) == rows:
            candidates.append((folder.name == "images", image_header(found[0]).width, found))
    if candidates:
        return max(candidates, key=lambda candidate: candidate[:2])[2], []
    others = {name: sorted(images_in(root / name), key=lambda path: path.name) for name in CaptureFiles(root).folders()}
    fitting = [name for name, found in others.items() if len(found) == rows and not BESIDE.search(name.lower())]
    if len(fitting) == 1:
        return others[fitting[0]], [f"the images were found in {fitting[0] or '.'}/, which holds one for each pose"]
    held = ", ".join(f"{name}/ holds {counted(count, 'image')}" for name, count in counts.items()) or "there is no images/ folder"
    raise InputError(f"{root / NAME} has {counted(rows, 'pose')} but {held}; each pose needs exactly one image")
