"""Redwood / Open3D: `trajectory.log`, pictures in `image/`, `color/` or `rgb/`, depth in `depth/`, a camera JSON.

Each entry of the log is a line `index index number` and a 4×4 world_from_camera in OpenCV axes, metres. The first number is the
frame; pictures and depth count from zero in natural order.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from toolkit.camera import Array, checked_pose
from toolkit.capture.calibration import PRIMESENSE, find_json
from toolkit.capture.listing import (
    assemble,
    counted,
    fitted,
    picture_header,
    pictures_in,
    read_numbers,
    require_folder,
    same_count,
    unique_names,
)
from toolkit.capture.nerf_json import number
from toolkit.capture.types import Capture, Frame
from toolkit.errors import InputError

LOG = "trajectory.log"
FOLDERS = ("image", "color", "rgb", "images")


def looks_like_redwood(path: Path) -> bool:
    return (path / LOG).is_file()


def read_redwood(path: Path | str) -> Capture:
    """RGB-D (or RGB) frames with poses in metres.

    Raises:
        InputError: the log or the camera is not usable, or pictures, depth and poses differ in number.
    """
    root = require_folder(path)
    poses = _read_log(root / LOG)
    pictures = next((found for folder in FOLDERS if (found := pictures_in(root / folder))), [])
    if not pictures:
        raise InputError(f"{root} has a {LOG} but no pictures in {', '.join(f'{folder}/' for folder in FOLDERS)}; put them there")
    same_count(len(pictures), len(poses), root)
    depths = pictures_in(root / "depth")
    if depths and len(depths) != len(pictures):
        raise InputError(
            f"{root} holds {counted(len(pictures), 'picture')} but {counted(len(depths), 'depth picture')}; "
            "add or remove what does not belong"
        )
    described = find_json(root)
    camera = described[0] if described else PRIMESENSE
    warnings = [] if described else ["no camera JSON was found; the PrimeSense default of 525 pixels is used"]
    scale = number(described[1], "depth_scale", str(root)) if described else None
    if scale is not None and scale <= 0:
        raise InputError(f"{root}: the camera's 'depth_scale' is {scale:g}, it must be positive; correct it")
    frames = []
    for index, (picture, name) in enumerate(zip(pictures, unique_names(pictures), strict=True)):
        size = picture_header(picture).size
        intrinsics = fitted(camera, size, str(picture))
        depth = depths[index] if depths else None
        depth_size = picture_header(depth).size if depth is not None else size
        frames.append(
            Frame(
                name=name,
                image=picture,
                intrinsics=intrinsics,
                world_from_camera=checked_pose(poses[index], f"{root / LOG}, entry {index}"),
                depth=depth,
                depth_intrinsics=None if depth_size == size else fitted(intrinsics, depth_size, str(depth)),
            )
        )
    return assemble("redwood", root, frames, warnings, ordered=True, metric=True, depth_scale=scale or 1000.0)


def _read_log(path: Path) -> Array:
    """(N, 4, 4), at each row the pose of that frame."""
    numbers = read_numbers(path)
    if numbers.size == 0 or numbers.size % 19:
        raise InputError(f"{path} does not hold whole entries (3 numbers and a 4×4 matrix each); check how it was written")
    entries = numbers.reshape(-1, 19)
    poses = entries[:, 3:].reshape(-1, 4, 4)
    order = entries[:, 0]
    if np.array_equal(np.sort(order), np.arange(len(order))):
        return poses[np.argsort(order)]
    return poses  # indices of another kind (from one, or of a longer video): the log's own order
