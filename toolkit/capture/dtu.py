"""DTU in the layout of IDR: `cameras*.npz` with `world_mat_i` (projection) and `scale_mat_i`, images beside or in `image/`.

The input's frame is the world of `world_mat_i`. `scale_mat_0` maps the unit sphere around the object into it; centre and radius are
in `extra["region"]`. Pixel centres of these projections are whole numbers: half a pixel is added. Where the images are smaller
than the projections are for, as a known crop of the 1600×1200 originals, the camera follows, with a warning.
"""

from __future__ import annotations

import re
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.capture.calibration import from_matrix, off_centre
from fieldfuse.capture.headers import image_size
from fieldfuse.capture.listing import assemble, counted, images_in, require_folder, same_count, unique_names
from fieldfuse.capture.poses import checked_pose, single_frame
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.errors import InputError, first_line

FOLDERS = ("image", "images", "rgb", ".")
PREFERRED = ("cameras_sphere.npz", "cameras.npz")  # others hold perturbed or rescaled cameras
ORIGINAL = (1600, 1200)
NEAR = 0.15  # how far twice the principal point may lie from the image's size
MAX_MEMBER = 2**20


def looks_like_dtu(path: Path) -> bool:
    return next(path.glob("cameras*.npz"), None) is not None


def read_dtu(path: Path | str) -> Capture:
    """Posed images, with masks where a `mask/` folder has one for each.

    Raises:
        InputError: the cameras are not readable, images and cameras differ in number, or a camera fits no known crop.
    """
    root = require_folder(path)
    source = next((root / name for name in PREFERRED if (root / name).is_file()), None) or min(
        root.glob("cameras*.npz"), default=root / PREFERRED[1]
    )
    matrices = _read_matrices(source)
    indices = sorted(int(key.removeprefix("world_mat_")) for key in matrices if re.fullmatch(r"world_mat_[0-9]{1,6}", key))
    images = next((found for folder in FOLDERS if (found := images_in(root / folder))), [])
    same_count(len(images), len(indices), root)
    images = _in_order(images, indices)
    masks = images_in(root / "mask")
    if masks and len(masks) != len(images):
        raise InputError(
            f"{root} holds {counted(len(images), 'image')} but {counted(len(masks), 'mask')}; add what is missing or remove mask/"
        )
    masks = _in_order(masks, indices)
    warnings: dict[str, None] = {}
    frames = []
    for position, (index, image, name) in enumerate(zip(indices, images, unique_names(images), strict=True)):
        where = f"world_mat_{index} of {source}"
        with single_frame(name):
            matrix, pose = decompose(matrices[f"world_mat_{index}"], where)
            intrinsics, warning = camera_for(matrix, image_size(image, images), where)
            if warning:
                warnings[warning] = None
            mask = masks[position] if masks else None
            frames.append(Frame(name=name, image=image, intrinsics=intrinsics, world_from_camera=pose, mask=mask))
    extra: dict[str, Any] = {}
    scale = matrices.get(f"scale_mat_{indices[0]}")
    if scale is not None and scale.shape == (4, 4) and np.isfinite(scale).all() and scale[0, 0] > 0:
        extra["region"] = {"centre": [float(value) for value in scale[:3, 3]], "radius": float(scale[0, 0])}
    return assemble("dtu", root, frames, list(warnings), extra=extra)


def decompose(projection: Array, where: str) -> tuple[Array, Array]:
    """(3 or 4, 4) projection, of any scale and sign → K (3, 3) with K[2, 2] = 1 and world_from_camera (4, 4)."""
    if projection.shape not in ((3, 4), (4, 4)):
        raise InputError(f"{where} has shape {projection.shape}, a 4×4 projection is expected; check how it was written")
    projection = projection[:3].astype(np.float64)
    if not np.isfinite(projection).all():
        raise InputError(f"{where} holds a value that is not finite; remove this image or correct it")
    scale = np.abs(projection[:, :3]).max()
    if not scale > 0 or np.linalg.matrix_rank(projection[:, :3]) < 3:
        raise InputError(f"{where} is singular; remove this image or correct it")
    if np.linalg.det(projection[:, :3] / scale) < 0:  # P and -P project alike; only one sign has a right-handed rotation
        projection = -projection
    camera, rotation, centre = cv2.decomposeProjectionMatrix(projection)[:3]
    pose = np.eye(4)
    pose[:3, :3] = rotation.T
    pose[:3, 3] = centre[:3, 0] / centre[3, 0]
    return camera / camera[2, 2], checked_pose(pose, where)


def camera_for(matrix: Array, size: tuple[int, int], where: str) -> tuple[Intrinsics, str | None]:
    """The camera of K for an image of `size`, and a warning when the image is a resized or cropped original.

    K is taken as it is when twice its principal point is near the image's size. When it is near DTU's 1600×1200 instead, the
    image is taken as that original resized (same shape) or cropped to its middle square and resized (square image).
    """
    width, height = size
    camera = from_matrix(matrix, width, height, where)
    if off_centre(camera) < NEAR:
        return camera, None
    full = replace(camera, width=ORIGINAL[0], height=ORIGINAL[1])
    square = width == height
    if off_centre(full) < NEAR and (square or abs(width * ORIGINAL[1] - height * ORIGINAL[0]) <= 2 * ORIGINAL[0]):
        crop = (ORIGINAL[0] - ORIGINAL[1]) / 2 if square else 0.0
        cropped = replace(full, width=ORIGINAL[1] if square else ORIGINAL[0], cx=full.cx - crop)
        what = f"the middle {ORIGINAL[1]}×{ORIGINAL[1]} of it" if square else "it"
        warning = f"the cameras are for {ORIGINAL[0]}×{ORIGINAL[1]} images; {width}×{height} was taken as {what}, resized"
        return cropped.scaled(width, height), warning
    raise InputError(
        f"{where} is for an image of about {2 * camera.cx:.0f}×{2 * camera.cy:.0f} but the image is {width}×{height}; "
        "give images of that size"
    )


def _read_matrices(path: Path) -> dict[str, Array]:
    try:
        with zipfile.ZipFile(path) as archive:
            if any(member.file_size > MAX_MEMBER for member in archive.infolist()):
                raise ValueError("an entry is far too large")
        with np.load(path, allow_pickle=False) as archive:
            keys = [key for key in archive.files if key.startswith(("world_mat_", "scale_mat_")) and "inv" not in key]
            out = {key: np.array(archive[key]) for key in keys}
        if any(value.dtype.kind not in "fiu" for value in out.values()):
            raise ValueError("an entry does not hold numbers")
    except Exception as error:  # NumPy's and zipfile's parsers raise many families on broken files
        raise InputError(f"{path} is not an archive of camera matrices ({first_line(error)}); check how it was written") from error
    if not any(key.startswith("world_mat_") for key in out):
        raise InputError(f"{path} holds no world_mat_0, world_mat_1, …; check how it was written")
    return out


def _in_order(images: list[Path], indices: list[int]) -> list[Path]:
    """By the number in the name when these are the cameras' numbers, else in alphabetical order as IDR does."""
    numbers = {int(found[0]): path for path in images if (found := re.findall(r"[0-9]{1,9}", path.stem))}
    if sorted(numbers) == indices:
        return [numbers[index] for index in indices]
    return sorted(images, key=lambda path: path.name)
