"""What the `metadata` of a Record3D recording says of its cameras: lenses, poses, and how large its depth maps are (see `record3d`)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fieldfuse.camera import Array, Intrinsics, world_from_opengl
from fieldfuse.capture.calibration import from_matrix
from fieldfuse.capture.lzfse import MOST_PIXELS
from fieldfuse.capture.nerf_json import MAX_SIDE, number
from fieldfuse.capture.poses import checked_pose, rigid
from fieldfuse.capture.sizes import fitted
from fieldfuse.errors import InputError

LENS, POSE = 4, 7  # numbers of a frame: fx, fy, cx, cy; qx, qy, qz, qw, x, y, z
FAR = 0.1  # of a side: stabilisers move a principal point by less, and one of a picture that lies the other way is farther off
TURNED = 0.02  # radians by which a first frame is turned whose pose is not simply zero
SAME_SHAPE = 0.02  # difference of two aspect ratios


def number_of(data: dict[str, Any], key: str, where: str) -> int | None:
    """`data[key]` as a whole number from 1 to `MAX_SIDE`, None when absent.

    Raises:
        InputError: something else stands there.
    """
    value = number(data, key, where)
    if value is not None and not (1 <= value <= MAX_SIDE and value == int(value)):
        raise InputError(f"{where}: {key!r} is {value:g}, which cannot be; export the recording again")
    return None if value is None else int(value)


def shared_camera(data: dict[str, Any], size: tuple[int, int], where: str) -> Intrinsics | None:
    """The camera `K` for pictures of `size` (width, height); None where there is no `K`.

    Raises:
        InputError: it is no camera, or one for pictures of another shape.
    """
    if data.get("K") is None:
        return None
    values = _numbers(data["K"], f"{where}: 'K'")
    if values.size != 9:
        raise InputError(f"{where}: 'K' must hold nine numbers, column by column; export the recording again")
    camera = from_matrix(values.reshape(3, 3).T, *_told_size(data, size, where), where, shift=0.0)
    return fitted(camera.centred(where), size, where)


def cameras(data: dict[str, Any], places: list[int], size: tuple[int, int], where: str) -> tuple[list[Intrinsics], int]:
    """The camera of each of the frames `places` for pictures of `size`: its own where one is told, else that of all.

    Returns:
        and how many own ones contradict that of all so far that this was taken: they would be those of a turned picture.

    Raises:
        InputError: neither is told, or one is not usable.
    """
    shared, listed = shared_camera(data, size, where), data.get("perFrameIntrinsicCoeffs")
    told = _told_size(data, size, where)
    found, refused = [], 0
    for place in places:
        camera = shared
        if isinstance(listed, list) and place < len(listed):
            row = f"{where}, intrinsics {place}"
            values = _numbers(listed[place], row)
            if values.size < LENS:
                raise InputError(f"{row} must hold fx, fy, cx and cy; export the recording again")
            own = fitted(Intrinsics(*told, *values[:LENS].tolist()).checked(row).centred(row), size, row)
            agrees = shared is None or max(abs(own.cx - shared.cx) / own.width, abs(own.cy - shared.cy) / own.height) <= FAR
            camera, refused = (own, refused) if agrees else (shared, refused + 1)
        if camera is None:
            raise InputError(f"{where} tells no camera ('K'); export the recording again")
        found.append(camera)
    return found, refused


def poses(data: dict[str, Any], where: str) -> Array | None:
    """(N, 7) the poses as they are told, finite. None where there are none, or all are the same, as those of the front camera.

    Raises:
        InputError: something else stands there.
    """
    if not data.get("poses"):
        return None
    listed = _numbers(data["poses"], f"{where}: 'poses'")
    if listed.ndim != 2 or listed.shape[1] != POSE:
        raise InputError(f"{where}: 'poses' must hold seven numbers a frame (quaternion and place); export the recording again")
    return None if len(listed) > 1 and np.all(listed == listed[0]) else listed


def world_from_camera(pose: Array, where: str) -> Array:
    """(4, 4) in OpenCV axes from the seven numbers of a pose.

    Raises:
        InputError: they are no pose.
    """
    x, y, z, w = pose[:4]
    return checked_pose(world_from_opengl(rigid(np.array([w, x, y, z]), pose[4:], where)), where)


def up_of(listed: Array | None) -> tuple[float, float, float] | None:
    """Up, where the poses (N, 7) are ARKit's. None where the first is zero: then it is not told."""
    if listed is None:
        return None
    turned = 2 * math.atan2(float(np.linalg.norm(listed[0, :3])), abs(float(listed[0, 3])))
    return (0.0, 1.0, 0.0) if turned > TURNED else None


def depth_size(data: dict[str, Any], pixels: int | None, size: tuple[int, int], where: str) -> tuple[int, int]:
    """(width, height) of the depth maps: as told, else of `pixels` values the shape of the picture's `size`.

    Told sizes lie as the picture does: some programs that write recordings have the two the other way round.

    Raises:
        InputError: neither is told, or it has another shape than the picture.
    """
    width, height = number_of(data, "dw", where), number_of(data, "dh", where)
    if width is None or height is None:
        height = round(math.sqrt((pixels or 0) * size[1] / size[0]))
        width = (pixels or 0) // max(height, 1)
        if not pixels or width * height != pixels:
            raise InputError(f"{where} does not tell the size of the depth ('dw', 'dh'), and it is no smaller picture; export it again")
    if width * height > MOST_PIXELS:
        raise InputError(f"{where}: depth of {width}×{height} cannot be; export the recording again")
    for across, down in ((width, height), (height, width)):
        if abs(across * size[1] / (down * size[0]) - 1) < SAME_SHAPE:
            return across, down
    raise InputError(f"{where}: depth is {width}×{height} and pictures {size[0]}×{size[1]}, which is another shape; export it again")


def _told_size(data: dict[str, Any], size: tuple[int, int], where: str) -> tuple[int, int]:
    """What the cameras are for."""
    return number_of(data, "w", where) or size[0], number_of(data, "h", where) or size[1]


def _numbers(value: Any, where: str) -> Array:
    try:
        array = np.array(value, dtype=np.float64)
    except (ValueError, TypeError, OverflowError) as error:
        raise InputError(f"{where} must hold numbers only; export the recording again") from error
    if array.ndim == 0:
        raise InputError(f"{where} must be a list of numbers; export the recording again")
    if not np.isfinite(array).all():
        raise InputError(f"{where} holds values that are not finite numbers; export the recording again")
    return array
