"""The two cameras of 7-Scenes' layout: of `camera-intrinsics.txt`, of BundleFusion's `info.txt`, else the set's usual ones.

7-Scenes ships one focal length, 585, which fits its depth; its colour pictures are not registered to the depth and fit 525. A file with
that focal length is 7-Scenes' own and tells of the depth alone; another one is of somebody's own recording, where both pictures share it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fieldfuse.camera import Intrinsics
from fieldfuse.capture.calibration import from_matrix, read_matrix_for
from fieldfuse.capture.listing import read_text
from fieldfuse.errors import InputError

USUAL = (640, 480)
# Both are nominal: the principal point is the picture's centre, so no half pixel is added.
DEPTH_CAMERA = Intrinsics(*USUAL, 585.0, 585.0, 320.0, 240.0)
COLOUR_CAMERA = Intrinsics(*USUAL, 525.0, 525.0, 320.0, 240.0)
STOCK = 0.5  # pixels by which a file's numbers may differ from the set's own
CAMERA_FILES = ("camera-intrinsics.txt", "camera_intrinsics.txt")
INFO = "info.txt"  # BundleFusion's, lines of `name = values`
MILLIMETRES = 1000.0


@dataclass(frozen=True)
class Cameras:
    """Of one folder; pictures of other sizes get them scaled (`listing.fitted`)."""

    colour: Intrinsics
    depth: Intrinsics
    depth_scale: float = MILLIMETRES  # stored values to the metre
    warnings: tuple[str, ...] = ()


def read_cameras(root: Path, colour_size: tuple[int, int], depth_size: tuple[int, int] | None) -> Cameras:
    """The cameras of the folder `root` whose pictures have these sizes (width, height); `depth_size` None: there is no depth.

    Raises:
        InputError: a file of cameras is there and is not usable.
    """
    file = next((path for name in CAMERA_FILES if (path := root / name).is_file()), None)
    if file is not None:
        given, _ = read_matrix_for(file, depth_size or colour_size, USUAL, shift=0.0)
        return Cameras(COLOUR_CAMERA if _is_stock(given) else given, given)
    told = _told(root / INFO)
    if "m_calibrationColorIntrinsic" in told:
        return _bundlefusion(root / INFO, told, colour_size, depth_size)
    warning = (
        f"no {CAMERA_FILES[0]} was found; the usual cameras of 7-Scenes are used "
        f"({COLOUR_CAMERA.fx:g} pixels for colour, {DEPTH_CAMERA.fx:g} for depth)"
    )
    return Cameras(COLOUR_CAMERA, DEPTH_CAMERA, warnings=(warning,))


def _is_stock(camera: Intrinsics) -> bool:
    at = camera.scaled(*USUAL)
    there, here = ((value.fx, value.fy, value.cx, value.cy) for value in (DEPTH_CAMERA, at))
    return bool(np.abs(np.subtract(there, here)).max() <= STOCK)


def _told(path: Path) -> dict[str, list[str]]:
    """Name → the words behind its `=`; nothing when there is no such file."""
    if not path.is_file():
        return {}
    lines = (line.partition("=") for line in read_text(path).splitlines())
    return {name.strip(): values.split() for name, _, values in lines}


def _bundlefusion(path: Path, told: dict[str, list[str]], colour_size: tuple[int, int], depth_size: tuple[int, int] | None) -> Cameras:
    colour = _camera(path, told, "Color", colour_size)
    # Without a camera of its own depth is registered to the colour picture.
    depth = _camera(path, told, "Depth", depth_size or USUAL) if "m_calibrationDepthIntrinsic" in told else colour
    scale = _numbers(path, told, "m_depthShift", 1)[0] if "m_depthShift" in told else MILLIMETRES
    if not scale > 0:
        raise InputError(f"{path}: 'm_depthShift' is {scale:g}, it must be positive; correct it")
    return Cameras(colour, depth, scale)


def _camera(path: Path, told: dict[str, list[str]], which: str, size: tuple[int, int]) -> Intrinsics:
    width, height = (
        _numbers(path, told, key, 1)[0] if (key := f"m_{which.lower()}{side}") in told else length
        for side, length in zip(("Width", "Height"), size, strict=True)
    )
    if not (1 <= width <= 1e6 and 1 <= height <= 1e6):
        raise InputError(f"{path}: the picture size {width:g}×{height:g} is not usable; correct 'm_{which.lower()}Width' and '…Height'")
    key = f"m_calibration{which}Intrinsic"
    matrix = np.array(_numbers(path, told, key, 16)).reshape(4, 4)
    camera = from_matrix(matrix, round(width), round(height), f"{path}: {key!r}", shift=0.0)
    if (camera.cx, camera.cy) != (camera.width / 2, camera.height / 2):  # calibrated, not nominal: pixel centres at whole numbers
        camera = replace(camera, cx=camera.cx + 0.5, cy=camera.cy + 0.5)
    return camera.centred(f"{path}: {key!r}")


def _numbers(path: Path, told: dict[str, list[str]], key: str, count: int) -> list[float]:
    try:
        numbers = [float(word) for word in told[key]]
    except ValueError:
        numbers = []
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise InputError(f"{path}: {key!r} must hold {count} finite {'number' if count == 1 else 'numbers'}; check how it was written")
    return numbers
