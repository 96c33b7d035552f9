"""Replica as it was rendered for iMAP and NICE-SLAM: `results/frame000000.jpg`, `results/depth000000.png`, `traj.txt`.

A line of `traj.txt` is a frame's world_from_camera, 16 numbers by rows, in OpenCV axes, metres, z up. `cam_params.json`, in the folder or,
as it is unpacked, in the one above for all scenes, has the camera (pixel centres at whole numbers) and the stored values of depth for each
metre. All scenes were rendered with one camera, which stands in where the file is missing and the images have its size.
"""

from __future__ import annotations

import re
from pathlib import Path

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.capture.calibration import posed_frame, sensor, usable_size
from fieldfuse.capture.headers import image_size
from fieldfuse.capture.listing import assemble, images_in, number, read_numbers, read_object, require_folder, same_count
from fieldfuse.capture.poses import single_frame
from fieldfuse.capture.types import Capture
from fieldfuse.errors import InputError

POSES, RESULTS, CAMERA = "traj.txt", "results", "cam_params.json"
KEYS = ("w", "h", "fx", "fy", "cx", "cy", "scale")
RENDERED = sensor(1200, 680, 600.0, 600.0, 599.5, 339.5)
DEPTH_SCALE = 6553.5  # stored values to the metre


def looks_like_replica(path: Path) -> bool:
    return (path / POSES).is_file() and (path / RESULTS).is_dir()


def camera_file(root: Path) -> Path | None:
    """The file that has the camera, if there is one."""
    return next((path for folder in (root, root.parent) if (path := folder / CAMERA).is_file()), None)


def read_replica(path: Path | str) -> Capture:
    """RGB-D frames with poses in metres.

    Raises:
        InputError: no images, another number of poses, a pose is not rigid, or the camera is missing or not usable.
    """
    root = require_folder(path)
    found = images_in(root / RESULTS)
    images = [path for path in found if path.name.startswith("frame")]
    depths = {path.stem.removeprefix("depth"): path for path in found if path.name.startswith("depth")}
    if not images:
        raise InputError(f"{root / RESULTS} holds no images frame000000.jpg, frame000001.jpg, …; put them there")
    camera, scale, warnings = _camera(root, image_size(images[0], images))
    frames = []
    for image, (line, pose) in zip(images, _poses(root, images), strict=True):
        with single_frame(image.stem):
            depth = depths.get(image.stem.removeprefix("frame"))
            frames.append(posed_frame(image.stem, image, camera, pose, f"{root / POSES}, pose {line + 1}", depth))
    return assemble("replica", root, frames, warnings, ordered=True, metric=True, depth_scale=scale, up=(0.0, 0.0, 1.0))


def _poses(root: Path, images: list[Path]) -> list[tuple[int, Array]]:
    """Line and matrix of each image's pose. Where images were removed, those that are left keep the lines of their numbers."""
    values = read_numbers(root / POSES)
    if values.size == 0 or values.size % 16:
        raise InputError(f"{root / POSES} does not hold whole poses (16 numbers a line); check how it was written")
    poses = values.reshape(-1, 4, 4)
    lines = [int(digits[-1]) if (digits := re.findall("[0-9]{1,9}", image.stem)) else -1 for image in images]
    if len(poses) <= len(images) or len(set(lines)) < len(lines) or min(lines) < 0 or max(lines) >= len(poses):
        same_count(len(images), len(poses), root)
        lines = list(range(len(images)))
    return [(line, poses[line]) for line in lines]


def _camera(root: Path, size: tuple[int, int]) -> tuple[Intrinsics, float, list[str]]:
    """The camera, stored depth values to the metre, and a warning where no file has them."""
    path = camera_file(root)
    if path is None:
        if size == (RENDERED.width, RENDERED.height):
            return RENDERED, DEPTH_SCALE, [f"no {CAMERA} was found; the camera that the published renderings of Replica share is used"]
        raise InputError(
            f"{root} has no {CAMERA}, and its images ({size[0]}×{size[1]}) are not those of the published renderings (1200×680); put one "
            'there: {"camera": {"w": …, "h": …, "fx": …, "fy": …, "cx": …, "cy": …, "scale": …}}, scale being stored depth for each metre'
        )
    data, where = read_object(path).get("camera"), f"{path}: 'camera'"
    if not isinstance(data, dict):
        raise InputError(f"{where} must be an object with {', '.join(KEYS)}; correct it")
    values = {key: value for key in KEYS if (value := number(data, key, where)) is not None}
    if len(values) < len(KEYS):
        raise InputError(f"{where} has no {next(key for key in KEYS if key not in values)!r}; add it")
    width, height, *lens, scale = values.values()
    if not scale > 0:
        raise InputError(f"{where} has a 'scale' of {scale:g}, which cannot be; correct it")
    return sensor(*usable_size(width, height, where), *lens).checked(where).centred(where), scale, []
