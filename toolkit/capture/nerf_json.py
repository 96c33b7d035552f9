"""The pieces of instant-ngp's, nerfstudio's and Blender's JSON: numbers, cameras, poses and listed files, all checked."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from toolkit import files
from toolkit.camera import FISHEYE, OPENCV, PINHOLE, Array, Intrinsics, checked_pose, world_from_opengl
from toolkit.capture.listing import PICTURES, counted, is_file
from toolkit.errors import InputError

MAX_SIDE = 1_000_000  # pixels
SAME_FACTOR = 0.1  # how far a principal point may lie from a larger picture's centre to be taken for it
MODELS = {
    "OPENCV": OPENCV,
    "SIMPLE_RADIAL": OPENCV,
    "RADIAL": OPENCV,
    "FULL_OPENCV": OPENCV,
    "PERSPECTIVE": OPENCV,
    "OPENCV_FISHEYE": FISHEYE,
    "FISHEYE": FISHEYE,
    # nerfstudio and instant-ngp apply coefficients of these too, so a file that has some was made for that.
    "PINHOLE": OPENCV,
    "SIMPLE_PINHOLE": OPENCV,
}


def number(data: Mapping[str, Any], key: str, where: str) -> float | None:
    """`data[key]` as a finite float, None when absent.

    Raises:
        InputError: something else stands there.
    """
    value = data.get(key)
    if value is None:
        return None
    try:
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise ValueError
        return float(value)
    except (ValueError, OverflowError) as error:
        raise InputError(f"{where}: {key!r} must be a finite number, not {str(value)[:40]!r}; correct it") from error


def matrix(value: Any, where: str) -> Array:
    """A (4, 4) float64 matrix from nested lists of 3×4 or 4×4 numbers. Its values are not judged.

    Raises:
        InputError: something else stands there.
    """
    try:
        array = np.array(value, dtype=np.float64)
    except (ValueError, TypeError, OverflowError) as error:
        raise InputError(f"{where} is not a 4×4 matrix of numbers; correct it") from error
    if array.shape == (3, 4):
        array = np.concatenate([array, [[0.0, 0.0, 0.0, 1.0]]])
    if array.shape != (4, 4):
        raise InputError(f"{where} has shape {array.shape}, a 4×4 matrix is expected; correct it")
    return array


def frame_list(data: Mapping[str, Any], path: Path) -> list[dict[str, Any]]:
    """The entries of `frames`, each with a `file_path`.

    Raises:
        InputError: there is no such list, or it is empty.
    """
    frames = data.get("frames")
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{path} lists no frames; a list named 'frames' is expected")
    for index, entry in enumerate(frames):
        if not isinstance(entry, dict) or not isinstance(entry.get("file_path"), str) or not entry["file_path"].strip():
            raise InputError(f"{path}: frame {index} has no 'file_path'; correct it")
    return frames


def listed_file(root: Path, listed: Any, where: str) -> Path | None:
    """The file that an entry names, with its suffix or without; None when it does not exist.

    Raises:
        InputError: not a name, or it leads outside `root`.
    """
    if not isinstance(listed, str):
        raise InputError(f"{where}: a file's name is expected, not {str(listed)[:40]!r}; correct it")
    path = files.inside(root, listed.replace("\\", "/"))
    if is_file(path):
        return path
    for suffix in PICTURES:
        for variant in (suffix, suffix.upper()):
            candidate = Path(f"{path}{variant}")
            if is_file(candidate):
                return files.inside(root, str(candidate))
    return None


def pose(entry: Mapping[str, Any], where: str) -> Array:
    """world_from_camera (4, 4) in OpenCV axes from an entry's OpenGL `transform_matrix`.

    Raises:
        InputError: absent, not finite, singular or not rigid.
    """
    if entry.get("transform_matrix") is None:
        raise InputError(f"{where} has no 'transform_matrix'; remove this frame or add its pose")
    return checked_pose(world_from_opengl(matrix(entry["transform_matrix"], f"{where}: 'transform_matrix'")), where)


def camera(shared: Mapping[str, Any], entry: Mapping[str, Any], size: tuple[int, int], where: str) -> Intrinsics:
    """The camera that the JSON describes, for the picture size that it names (or `size` when it names none).

    What stands in the frame's entry goes before what all frames share. Focal lengths `fl_x`, `fl_y` go before
    `camera_angle_x`, `camera_angle_y` (full angles, radians): f = (w / 2) / tan(angle / 2).

    Raises:
        InputError: no focal length, a value that is not usable, or a lens that cannot be modelled.
    """

    def value(key: str) -> float | None:
        own = number(entry, key, where)
        return number(shared, key, where) if own is None else own

    width = round(value("w") or size[0])
    height = round(value("h") or size[1])
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE):
        raise InputError(f"{where}: the picture size {width:g}×{height:g} is not usable; correct 'w' and 'h'")
    fx = _focal(value("fl_x"), value("camera_angle_x"), width, where)
    fy = _focal(value("fl_y"), None if value("fl_x") else value("camera_angle_y"), height, where)
    fx, fy = (fy if fx is None else fx), (fx if fy is None else fy)
    if fx is None or fy is None:
        raise InputError(f"{where}: there is no focal length ('fl_x' or 'camera_angle_x'); add it, or use the pictures alone as photos")
    cx, cy = value("cx"), value("cy")
    lens, distortion = _lens(shared, entry, value, where)
    cx, cy = (width / 2 if cx is None else cx), (height / 2 if cy is None else cy)
    return Intrinsics(width, height, fx, fy, cx, cy, lens, distortion).checked(where)


def picture_camera(shared: Mapping[str, Any], entry: Mapping[str, Any], size: tuple[int, int], where: str) -> Intrinsics:
    """The same of a picture that is there, `size` (width, height) large: its principal point has to lie in it.

    Raises:
        InputError: as `camera`; the principal point lies outside, or the json seems to be for a picture of another size.
    """
    described = camera(shared, entry, size, where)
    if all(data.get(key) is None for data in (shared, entry) for key in ("w", "h")):
        # Without 'w' and 'h' nothing else tells that the pictures were made smaller since.
        factor = round(2 * described.cx / described.width)
        if factor >= 2 and all(
            abs(2 * at / length / factor - 1) < SAME_FACTOR
            for at, length in ((described.cx, described.width), (described.cy, described.height))
        ):
            raise InputError(
                f"{where}: the principal point ({described.cx:g}, {described.cy:g}) is the centre of a picture {factor} times as large as "
                f"the {described.width}×{described.height} one at hand; add 'w' and 'h', the size that the intrinsics are for"
            )
    return described.centred(where)


def says_pinhole(shared: Mapping[str, Any], entry: Mapping[str, Any]) -> bool:
    """Whether a camera model without a lens is named, whatever coefficients stand beside it."""
    return str(entry.get("camera_model", shared.get("camera_model"))).upper() in ("PINHOLE", "SIMPLE_PINHOLE")


def bent_remarks(count: int) -> list[str]:
    """What to say when `count` pictures have such a camera and a lens all the same."""
    if not count:
        return []
    return [
        f"{counted(count, 'picture')} with a PINHOLE camera and lens coefficients (k1, …), which are applied as in nerfstudio; "
        "remove them from the json if the pictures are undistorted already"
    ]


def _focal(focal: float | None, angle: float | None, length: int, where: str) -> float | None:
    if focal is not None:
        return focal
    if angle is None:
        return None
    if not 0 < angle < math.pi:
        raise InputError(f"{where}: the camera angle is {angle:g}, it must lie between 0 and π; correct it")
    return 0.5 * length / math.tan(0.5 * angle)


def _lens(shared: Mapping[str, Any], entry: Mapping[str, Any], value: Any, where: str) -> tuple[str, tuple[float, ...]]:
    name = entry.get("camera_model", shared.get("camera_model"))
    fisheye = bool(entry.get("is_fisheye", shared.get("is_fisheye", False)))
    if name is None:
        name = "OPENCV_FISHEYE" if fisheye else "OPENCV"
    if not isinstance(name, str) or name.upper() not in MODELS:
        raise InputError(f"{where}: the camera model {str(name)[:40]!r} is not known; undistort the pictures to PINHOLE or OPENCV first")
    k1, k2, k3, k4, k5, k6, p1, p2 = (value(key) or 0.0 for key in ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2"))
    if MODELS[name.upper()] == FISHEYE:
        return FISHEYE, (k1, k2, k3, k4)
    if name.upper() == "FULL_OPENCV":
        return OPENCV, (k1, k2, p1, p2, k3, k4, k5, k6)
    if k4:  # here an r⁸ term; OpenCV's fourth radial coefficient is another thing
        raise InputError(f"{where}: the lens coefficient k4 of an {name} camera cannot be modelled; undistort the pictures first")
    distortion = (k1, k2, p1, p2, k3) if k3 else (k1, k2, p1, p2)
    return (OPENCV, distortion) if any(distortion) else (PINHOLE, ())
