"""Intrinsics in small files of their own, and the cameras of sensors that captures leave out.

Sensors are calibrated with OpenCV or Open3D, whose pixel centres are whole numbers: half a pixel is added here.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.capture.listing import read_matrix, read_object
from fieldfuse.capture.nerf_json import MAX_SIDE, number
from fieldfuse.capture.sizes import fitted
from fieldfuse.errors import InputError

JSON_NAMES = (
    "camera_intrinsics.json",
    "camera_intrinsic.json",
    "camera.json",
    "intrinsics.json",
    "intrinsic.json",
    "camera_primesense.json",  # of Open3D's samples
)


def sensor(width: int, height: int, fx: float, fy: float, cx: float, cy: float) -> Intrinsics:
    """A pinhole camera from values with whole-number pixel centres."""
    return Intrinsics(width, height, fx, fy, cx + 0.5, cy + 0.5)


CENTRAL = 0.25  # how far twice the principal point of a sensor may lie from its picture's size, as a share of that
PRIMESENSE = sensor(640, 480, 525.0, 525.0, 319.5, 239.5)  # default of Open3D and of ROS


def from_matrix(matrix: Array, width: int, height: int, where: str, shift: float = 0.5) -> Intrinsics:
    """The camera of a 3×3 or 4×4 K whose pixel centres are at whole numbers (`shift` 0.5) or at +0.5 (`shift` 0).

    Raises:
        InputError: K is not the matrix of a camera.
    """
    intrinsics = Intrinsics(
        width, height, float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]) + shift, float(matrix[1, 2]) + shift
    ).checked(where)
    if not abs(matrix[0, 1]) <= 0.05 * intrinsics.fx:
        raise InputError(f"{where}: the camera matrix is skewed, which is not supported; undistort the pictures first")
    return intrinsics


def read_matrix_file(path: Path, width: int, height: int, shift: float = 0.5) -> Intrinsics:
    """The camera in a text file with a 3×3 or 4×4 (or 3×4) matrix.

    Raises:
        InputError: not such a file.
    """
    return from_matrix(read_matrix(path, (3, 3), (4, 4), (3, 4)), width, height, str(path), shift)


def read_matrix_for(path: Path, size: tuple[int, int], usual: tuple[int, int], shift: float = 0.5) -> tuple[Intrinsics, bool]:
    """The camera in such a file for pictures of `size` (width, height), and whether it had to be scaled from the sensor's `usual` size.

    The file does not say which of the two it is for; the size does whose centre is nearer to the principal point.

    Raises:
        InputError: not such a file, for pictures of another shape, or with a principal point outside the picture.
    """
    camera = read_matrix_file(path, *size, shift)
    whole = replace(camera, width=usual[0], height=usual[1])
    scaled = size != usual and _off_centre(whole) < min(_off_centre(camera), CENTRAL)
    return (fitted(whole, size, str(path)) if scaled else camera).centred(str(path)), scaled


def _off_centre(camera: Intrinsics) -> float:
    """How far twice the principal point lies from the picture's size, as a share of it."""
    return max(abs(2 * camera.cx / camera.width - 1), abs(2 * camera.cy / camera.height - 1))


def find_json(root: Path) -> tuple[Intrinsics, dict[str, Any]] | None:
    """The camera in one of `JSON_NAMES` and the whole object, or None when there is no such file.

    Either Open3D's form (`width`, `height`, `intrinsic_matrix` of nine numbers, column by column) or `fx`, `fy`, `cx`, `cy`.

    Raises:
        InputError: the file is there and is not usable.
    """
    path = next((root / name for name in JSON_NAMES if (root / name).is_file()), None)
    if path is None:
        return None
    data = read_object(path)
    where = str(path)
    width, height = number(data, "width", where), number(data, "height", where)
    if width is None or height is None or not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE):
        raise InputError(f"{where} tells no usable 'width' and 'height'; add the picture size that the camera is for")
    values: list[float | None]
    nine = data.get("intrinsic_matrix")
    if nine is not None:
        if not isinstance(nine, list) or len(nine) != 9:
            raise InputError(f"{where}: 'intrinsic_matrix' must be a list of nine numbers, column by column; correct it")
        entries = {str(i): value for i, value in enumerate(nine)}
        values = [number(entries, key, where) for key in ("0", "4", "6", "7")]
    else:
        values = [number(data, key, where) for key in ("fx", "fy", "cx", "cy")]
    fx, fy, cx, cy = values
    if fx is None or fy is None or cx is None or cy is None:
        raise InputError(f"{where} must hold 'fx', 'fy', 'cx', 'cy' or an 'intrinsic_matrix'; correct it")
    return sensor(round(width), round(height), fx, fy, cx, cy).checked(where).centred(where), data
