"""3D Scanner App's "All Data", of phones with a depth sensor: `frame_00000.json`, `.jpg`, `depth_00000.png`, `conf_00000.png` together.

Every frame has a JSON: `cameraPoseARFrame` (16 numbers, row by row: world_from_camera in OpenGL axes, metres, y up) and `intrinsics`
(nine numbers, row by row, for the sensor's own, lying picture). Key frames alone, about every sixth, have a picture, and they are used.
Depth is in millimetres, smaller than the picture, and kept by the app's "low res" mode; a confidence of 0 is the sensor's own word for a
guess.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from fieldfuse.camera import Array, Intrinsics, world_from_opengl
from fieldfuse.capture.calibration import from_matrix
from fieldfuse.capture.listing import assemble, is_file, pictures_in, read_object, require_folder
from fieldfuse.capture.poses import checked_pose, single_frame
from fieldfuse.capture.sizes import fitted, picture_header, size_of
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.errors import InputError

PICTURE = re.compile(r"frame_([0-9]+)\.jpe?g", re.IGNORECASE)
POSE, LENS = "cameraPoseARFrame", "intrinsics"
SENSOR = (1920, 1440)  # pixels that the intrinsics are for where pictures have been made smaller since
CENTRAL = 0.2  # how far twice a principal point may lie from its picture's size, as a share of that


def _pictures(root: Path) -> list[Path]:
    return [path for path in pictures_in(root, (".jpg", ".jpeg")) if PICTURE.fullmatch(path.name)]


def looks_like_scanner3d(path: Path) -> bool:
    return any(is_file(picture.with_suffix(".json")) for picture in _pictures(path))


def read_scanner3d(path: Path | str) -> Capture:
    """Key frames with poses in metres, and depth where the phone has a sensor. Pictures without a JSON are counted and left out.

    Raises:
        InputError: no frame has a picture and a JSON, or a camera is not usable.
    """
    root = require_folder(path)
    pictures = _pictures(root)
    used = [picture for picture in pictures if is_file(picture.with_suffix(".json"))]
    if not used:
        raise InputError(f'{root} holds no frame_*.jpg with its frame_*.json; export "All Data" of the scan')
    lost = len(pictures) - len(used)
    remarks = [f"{lost} of the {len(pictures)} pictures have no .json beside them and are left out"] if lost else []
    frames = []
    for picture in used:
        with single_frame(picture.stem):
            frames.append(_frame(picture, used))
    return assemble("scanner3d", root, frames, remarks, ordered=True, metric=True, up=(0.0, 1.0, 0.0))


def _frame(picture: Path, others: list[Path]) -> Frame:
    where = picture.with_suffix(".json")
    data = read_object(where)
    camera = _camera(_numbers(data, LENS, 9, where).reshape(3, 3), size_of(picture, others), str(where))
    number = PICTURE.fullmatch(picture.name)
    assert number is not None
    depth, confidence = (picture.with_name(f"{kind}_{number[1]}.png") for kind in ("depth", "conf"))
    there = is_file(depth)
    return Frame(
        name=picture.stem,
        image=picture,
        intrinsics=camera,
        world_from_camera=_pose(_numbers(data, POSE, 16, where).reshape(4, 4), str(where)),
        depth=depth if there else None,
        depth_intrinsics=fitted(camera, picture_header(depth).size, str(depth)) if there else None,
        confidence=confidence if there and is_file(confidence) else None,
    )


def _camera(matrix: Array, size: tuple[int, int], where: str) -> Intrinsics:
    """The camera of a picture of `size` (width, height): its own, or that of the sensor made smaller."""
    for told in (size, SENSOR):
        camera = from_matrix(matrix, *told, where, shift=0.0)
        if max(abs(2 * camera.cx / told[0] - 1), abs(2 * camera.cy / told[1] - 1)) <= CENTRAL:
            return fitted(camera, size, where)
    raise InputError(
        f"{where}: the intrinsics are of another picture than the {size[0]}×{size[1]} one beside it; give pictures that are not turned"
    )


def _pose(matrix: Array, where: str) -> Array:
    """(4, 4) in OpenCV axes. Some versions of the app write the matrix column by column, which shows by where its zeros are."""
    if np.any(matrix[3, :3] != 0) and not np.any(matrix[:3, 3] != 0):
        matrix = matrix.T
    return checked_pose(world_from_opengl(matrix), where)


def _numbers(data: dict[str, Any], key: str, count: int, where: Path) -> Array:
    try:
        values = np.array(data.get(key), dtype=np.float64).ravel()
    except (ValueError, TypeError, OverflowError) as error:
        raise InputError(f"{where}: {key!r} must hold {count} numbers; export the scan again") from error
    if values.size != count or not np.isfinite(values).all():
        raise InputError(f"{where}: {key!r} must hold {count} finite numbers; export the scan again")
    return values
