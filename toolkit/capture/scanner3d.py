"""3D Scanner App's "All Data", of phones with a depth sensor: `frame_00000.json`, `.jpg`, `depth_00000.png`, `conf_00000.png` together.

Every frame has a JSON: `cameraPoseARFrame` (16 numbers, row by row: world_from_camera in OpenGL axes, metres, y up) and `intrinsics`
(nine numbers, row by row, for the sensor's own, lying image). Key frames alone, about every sixth, have an image, and they are used.
Depth is in millimetres, smaller than the image, and stored by the app's "low res" mode; a confidence of 0 marks a guess.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from fieldfuse.camera import Array, Intrinsics, world_from_opengl
from fieldfuse.capture.calibration import from_matrix, off_centre, posed_frame
from fieldfuse.capture.headers import image_size
from fieldfuse.capture.listing import assemble, images_in, is_file, numbers, read_object, require_folder
from fieldfuse.capture.poses import single_frame
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.errors import InputError

IMAGE = re.compile(r"frame_([0-9]+)\.jpe?g", re.IGNORECASE)
SENSOR = (1920, 1440)  # pixels that the intrinsics are for where images have been made smaller since
CENTRAL = 0.2  # how far twice a principal point may lie from its image's size, as a share of that


def _images(root: Path) -> list[Path]:
    return [path for path in images_in(root, (".jpg", ".jpeg")) if IMAGE.fullmatch(path.name)]


def looks_like_scanner3d(path: Path) -> bool:
    return any(is_file(image.with_suffix(".json")) for image in _images(path))


def read_scanner3d(path: Path | str) -> Capture:
    """Key frames with poses in metres, and depth where the phone has a sensor. Images without a JSON are counted and left out.

    Raises:
        InputError: no frame has an image and a JSON, or a camera is not usable.
    """
    root = require_folder(path)
    images = _images(root)
    used = [image for image in images if is_file(image.with_suffix(".json"))]
    if not used:
        raise InputError(f'{root} holds no frame_*.jpg with its frame_*.json; export "All Data" of the scan')
    lost = len(images) - len(used)
    remarks = [f"{lost} of the {len(images)} images have no .json beside them and are left out"] if lost else []
    frames = []
    for image in used:
        with single_frame(image.stem):
            frames.append(_frame(image, used))
    return assemble("scanner3d", root, frames, remarks, ordered=True, metric=True, up=(0.0, 1.0, 0.0))


def _frame(image: Path, others: list[Path]) -> Frame:
    path = image.with_suffix(".json")
    data, where = read_object(path), str(path)
    again = "export the scan again"
    camera = _camera(numbers(data.get("intrinsics"), f"{where}: 'intrinsics'", 9, again).reshape(3, 3), image_size(image, others), where)
    pose = numbers(data.get("cameraPoseARFrame"), f"{where}: 'cameraPoseARFrame'", 16, again).reshape(4, 4)
    if np.any(pose[3, :3] != 0) and not np.any(pose[:3, 3] != 0):  # some versions of the app write the matrix column by column
        pose = pose.T
    digits = image.stem.split("_")[1]
    depth, confidence = (image.with_name(f"{kind}_{digits}.png") for kind in ("depth", "conf"))
    there = depth if is_file(depth) else None
    return posed_frame(image.stem, image, camera, world_from_opengl(pose), where, there, confidence=confidence)


def _camera(matrix: Array, size: tuple[int, int], where: str) -> Intrinsics:
    """The camera of an image of `size` (width, height), or of the sensor's own, which is then scaled to it."""
    for given in (size, SENSOR):
        camera = from_matrix(matrix, *given, where, shift=0.0)
        if off_centre(camera) <= CENTRAL:
            return camera
    raise InputError(
        f"{where}: the intrinsics are of another image than the {size[0]}×{size[1]} one beside it; give images that are not turned"
    )
