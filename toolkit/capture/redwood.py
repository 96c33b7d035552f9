"""Redwood / Open3D: `trajectory.log`, images in `image/`, `color/` or `rgb/`, depth in `depth/`, a camera JSON.

Each entry of the log is a line `index index number` and a 4×4 world_from_camera in OpenCV axes, metres. The first number is the
frame; images and depth count from zero in natural order.

What is published has other names for the log: `livingroom1-traj.txt` (with `livingroom1-color/` and `livingroom1-depth-clean/` on Redwood's
site, `color/` and `depth/` from Open3D), `lounge_trajectory.log`, `bedroom.log`; Open3D's reconstruction system leaves it in `scene/`.
Such a file is recognised by how it begins, and one alone may do so. `odometry.log` holds steps between frames, not where they were taken.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from fieldfuse.camera import Array
from fieldfuse.capture.calibration import PRIMESENSE, find_json, posed_frame
from fieldfuse.capture.listing import (
    assemble,
    counted,
    files_in,
    images_in,
    number,
    read_numbers,
    require_folder,
    same_count,
    unique_names,
)
from fieldfuse.capture.poses import single_frame
from fieldfuse.capture.types import Capture
from fieldfuse.errors import InputError

LOG = "trajectory.log"
OTHERS = ("*.log", "*-traj.txt", "scene/trajectory.log", "scene/key.log")  # where there is no such file
FOLDERS = ("image", "color", "rgb", "images", "colors")
ENTRY = re.compile(r"(\d+)[ \t]+\1[ \t]+\d+(\s+[-+.\deE]+){16}\s")  # a frame twice, a number, sixteen more


def looks_like_redwood(path: Path) -> bool:
    if (path / LOG).is_file():
        return True
    if (path / "pose").is_dir():  # a pose a frame, of ScanNet: what Open3D found of the same images does not replace them
        return False
    # Folders of Redwood's site are called `livingroom1-color`.
    images = any((path / folder).is_dir() for folder in FOLDERS) or next(path.glob("*-color/"), None) is not None
    return images and bool(_logs(path))


def _logs(root: Path) -> list[Path]:
    """`trajectory.log`, else all files that begin as one does."""
    if (root / LOG).is_file():
        return [root / LOG]
    found = {path for pattern in OTHERS for path in files_in(root, pattern) if path.name != "odometry.log"}
    return sorted(path for path in found if _begins_as_log(path))


def _begins_as_log(path: Path) -> bool:
    try:
        with path.open(encoding="utf-8-sig") as file:
            return ENTRY.match(file.read(2000).lstrip()) is not None
    except (OSError, UnicodeDecodeError):
        return False


def read_redwood(path: Path | str) -> Capture:
    """RGB-D (or RGB) frames with poses in metres.

    Raises:
        InputError: there are several logs, the log or the camera is not usable, or images, depth and poses differ in number.
    """
    root = require_folder(path)
    logs = _logs(root)
    if len(logs) != 1:
        names = ", ".join(path.relative_to(root).as_posix() for path in logs) or "none"
        raise InputError(f"{root} must hold one trajectory and holds {names}; call the one that belongs to the images {LOG}")
    log = logs[0]
    poses = _read_log(log)
    scene = log.name.removesuffix("-traj.txt")
    folders = (*FOLDERS, *([f"{scene}-color"] if scene != log.name else []))
    images = next((found for folder in folders if (found := images_in(root / folder))), [])
    if not images:
        raise InputError(f"{root} has a {log.name} but no images in {', '.join(f'{folder}/' for folder in folders)}; put them there")
    same_count(len(images), len(poses), root)
    # Rendered scenes have clean depth and depth with a sensor's noise.
    places = ("depth", f"{scene}-depth-clean", f"{scene}-depth-simulated", "depth_noisy")
    there = {name: found for name in places if (found := images_in(root / name))}
    used = next((name for name in places[:3] if name in there), None)
    depths = there.pop(used) if used else []
    if depths and len(depths) != len(images):
        raise InputError(
            f"{root} holds {counted(len(images), 'image')} but {counted(len(depths), 'depth image')}; add or remove what does not belong"
        )
    described = find_json(root)
    camera, scale = described[0] if described else PRIMESENSE, None
    warnings = [] if described else ["no camera JSON was found; the PrimeSense default of 525 pixels is used"]
    if used and there:
        warnings.append(f"the depth in {used}/ is used, that in {', '.join(f'{name}/' for name in there)} is left out")
    if described and (scale := number(described[1], "depth_scale", str(root))) is not None and scale <= 0:
        raise InputError(f"{root}: the camera's 'depth_scale' is {scale:g}, it must be positive; correct it")
    frames = []
    for index, (image, name) in enumerate(zip(images, unique_names(images), strict=True)):
        with single_frame(name):
            depth = depths[index] if depths else None
            frames.append(posed_frame(name, image, camera, poses[index], f"{log}, entry {index}", depth))
    return assemble("redwood", root, frames, warnings, ordered=True, metric=True, depth_scale=scale or 1000.0)


def _read_log(path: Path) -> Array:
    """(N, 4, 4), at each row the pose of that frame; of indices of another kind (from one, or of a longer video) in the log's own order."""
    values = read_numbers(path)
    if values.size == 0 or values.size % 19:
        raise InputError(f"{path} does not hold whole entries (3 numbers and a 4×4 matrix each); check how it was written")
    entries = values.reshape(-1, 19)
    poses, order = entries[:, 3:].reshape(-1, 4, 4), entries[:, 0]
    return poses[np.argsort(order)] if np.array_equal(np.sort(order), np.arange(len(order))) else poses
