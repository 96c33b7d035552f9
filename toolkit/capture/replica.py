"""Replica as it was rendered for iMAP and NICE-SLAM: `results/frame000000.jpg`, `results/depth000000.png`, `traj.txt`.

A line of `traj.txt` is a frame's world_from_camera, 16 numbers by rows, in OpenCV axes, metres, z up. `cam_params.json`, in the folder or,
as it is unpacked, in the one above for all scenes, tells the camera (pixel centres at whole numbers) and how many stored values of depth
make a metre. All scenes were rendered with one camera, which stands in where the file is not there and the pictures have its size.
"""

from __future__ import annotations

import re
from pathlib import Path

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.capture.calibration import sensor
from fieldfuse.capture.listing import assemble, pictures_in, posed_frame, read_numbers, read_object, require_folder, same_count
from fieldfuse.capture.nerf_json import MAX_SIDE, number
from fieldfuse.capture.poses import single_frame
from fieldfuse.capture.sizes import first_size
from fieldfuse.capture.types import Capture
from fieldfuse.errors import InputError

POSES, PICTURES, CAMERA = "traj.txt", "results", "cam_params.json"
KEYS = ("w", "h", "fx", "fy", "cx", "cy", "scale")
RENDERED = sensor(1200, 680, 600.0, 600.0, 599.5, 339.5)
DEPTH_SCALE = 6553.5  # stored values to the metre


def looks_like_replica(path: Path) -> bool:
    return (path / POSES).is_file() and (path / PICTURES).is_dir()


def camera_file(root: Path) -> Path | None:
    """The file that tells the camera, if there is one."""
    return next((path for folder in (root, root.parent) if (path := folder / CAMERA).is_file()), None)


def read_replica(path: Path | str) -> Capture:
    """RGB-D frames with poses in metres.

    Raises:
        InputError: no pictures, another number of poses, a pose is not rigid, or the camera is not known or not usable.
    """
    root = require_folder(path)
    found = pictures_in(root / PICTURES)
    pictures = [path for path in found if path.name.startswith("frame")]
    depths = {path.stem.removeprefix("depth"): path for path in found if path.name.startswith("depth")}
    if not pictures:
        raise InputError(f"{root / PICTURES} holds no pictures frame000000.jpg, frame000001.jpg, …; put them there")
    camera, scale, warnings = _camera(root, first_size(pictures))
    frames = []
    for picture, (line, pose) in zip(pictures, _poses(root, pictures), strict=True):
        with single_frame(picture.stem):
            depth = depths.get(picture.stem.removeprefix("frame"))
            frames.append(posed_frame(picture.stem, picture, camera, pose, f"{root / POSES}, pose {line + 1}", depth))
    return assemble("replica", root, frames, warnings, ordered=True, metric=True, depth_scale=scale, up=(0.0, 0.0, 1.0))


def _poses(root: Path, pictures: list[Path]) -> list[tuple[int, Array]]:
    """Number and matrix of each picture's pose. Where pictures were taken away, those that are left keep the lines of their numbers."""
    numbers = read_numbers(root / POSES)
    if numbers.size == 0 or numbers.size % 16:
        raise InputError(f"{root / POSES} does not hold whole poses (16 numbers a line); check how it was written")
    poses = numbers.reshape(-1, 4, 4)
    lines = list(range(len(pictures)))
    if len(poses) > len(pictures):
        counted = [int(digits[-1]) if (digits := re.findall("[0-9]{1,9}", picture.stem)) else -1 for picture in pictures]
        if len(set(counted)) == len(counted) and 0 <= min(counted) <= max(counted) < len(poses):
            return [(line, poses[line]) for line in counted]
    same_count(len(pictures), len(poses), root)
    return [(line, poses[line]) for line in lines]


def _camera(root: Path, size: tuple[int, int]) -> tuple[Intrinsics, float, list[str]]:
    """The camera, stored depth values to the metre, and a warning where nobody told them."""
    path = camera_file(root)
    if path is None:
        if size == (RENDERED.width, RENDERED.height):
            return RENDERED, DEPTH_SCALE, [f"no {CAMERA} was found; the camera that the published renderings of Replica share is used"]
        raise InputError(
            f"{root} has no {CAMERA}, and its pictures ({size[0]}×{size[1]}) are not those of the published renderings (1200×680); put one "
            'there: {"camera": {"w": …, "h": …, "fx": …, "fy": …, "cx": …, "cy": …, "scale": …}}, scale being stored depth for each metre'
        )
    data, where = read_object(path).get("camera"), f"{path}: 'camera'"
    if not isinstance(data, dict):
        raise InputError(f"{where} must be an object with {', '.join(KEYS)}; correct it")
    values = {key: number(data, key, where) for key in KEYS}
    absent = [key for key, value in values.items() if value is None]
    if absent:
        raise InputError(f"{where} has no {absent[0]!r}; add it")
    width, height, fx, fy, cx, cy, scale = (value for value in values.values() if value is not None)
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE and scale > 0):
        raise InputError(f"{where} tells a size of {width:g}×{height:g} and a 'scale' of {scale:g}, which cannot be; correct it")
    return sensor(round(width), round(height), fx, fy, cx, cy).checked(where).centred(where), scale, []
