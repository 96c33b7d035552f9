"""Redwood / Open3D: `trajectory.log`, pictures in `image/`, `color/` or `rgb/`, depth in `depth/`, a camera JSON.

Each entry of the log is a line `index index number` and a 4×4 world_from_camera in OpenCV axes, metres. The first number is the
frame; pictures and depth count from zero in natural order.

What is published calls the log otherwise: `livingroom1-traj.txt` (with `livingroom1-color/` and `livingroom1-depth-clean/` on Redwood's
site, `color/` and `depth/` from Open3D), `lounge_trajectory.log`, `bedroom.log`; Open3D's reconstruction system leaves it in `scene/`.
Such a file is told by how it begins, and one alone may do so. `odometry.log` holds steps between frames, not where they were taken.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from fieldfuse.camera import Array
from fieldfuse.capture.calibration import PRIMESENSE, find_json
from fieldfuse.capture.listing import (
    assemble,
    counted,
    files_in,
    pictures_in,
    posed_frame,
    read_numbers,
    require_folder,
    same_count,
    unique_names,
)
from fieldfuse.capture.nerf_json import number
from fieldfuse.capture.poses import single_frame
from fieldfuse.capture.types import Capture
from fieldfuse.errors import InputError

LOG = "trajectory.log"
OTHERS = ("*.log", "*-traj.txt", "scene/trajectory.log", "scene/key.log")  # where there is no such file
STEPS = "odometry.log"
FOLDERS = ("image", "color", "rgb", "images", "colors")
ENTRY = re.compile(r"(\d+)[ \t]+\1[ \t]+\d+(\s+[-+.\deE]+){16}\s")  # a frame twice, a number, sixteen more
HEAD = 2000  # characters that hold one


def looks_like_redwood(path: Path) -> bool:
    if (path / LOG).is_file():
        return True
    if (path / "pose").is_dir():  # a pose a frame, of ScanNet: what Open3D found of the same pictures does not replace them
        return False
    # Folders of Redwood's site are called `livingroom1-color`.
    pictures = any((path / folder).is_dir() for folder in FOLDERS) or next(path.glob("*-color/"), None) is not None
    return pictures and bool(_logs(path))


def _logs(root: Path) -> list[Path]:
    """`trajectory.log`, else all files that begin as one does."""
    if (root / LOG).is_file():
        return [root / LOG]
    return sorted(path for pattern in OTHERS for path in files_in(root, pattern) if path.name != STEPS and _begins_as_log(path))


def _begins_as_log(path: Path) -> bool:
    try:
        with path.open(encoding="utf-8-sig") as file:
            return ENTRY.match(file.read(HEAD).lstrip()) is not None
    except (OSError, UnicodeDecodeError):
        return False


def read_redwood(path: Path | str) -> Capture:
    """RGB-D (or RGB) frames with poses in metres.

    Raises:
        InputError: there are several logs, the log or the camera is not usable, or pictures, depth and poses differ in number.
    """
    root = require_folder(path)
    logs = _logs(root)
    if len(logs) != 1:
        names = ", ".join(path.relative_to(root).as_posix() for path in logs) or "none"
        raise InputError(f"{root} must hold one trajectory and holds {names}; call the one that belongs to the pictures {LOG}")
    log = logs[0]
    poses = _read_log(log)
    scene = log.name.removesuffix("-traj.txt")
    folders = (*FOLDERS, *([f"{scene}-color"] if scene != log.name else []))
    pictures = next((found for folder in folders if (found := pictures_in(root / folder))), [])
    if not pictures:
        raise InputError(f"{root} has a {log.name} but no pictures in {', '.join(f'{folder}/' for folder in folders)}; put them there")
    same_count(len(pictures), len(poses), root)
    depths, left_out = _depths(root, scene)
    if depths and len(depths) != len(pictures):
        raise InputError(
            f"{root} holds {counted(len(pictures), 'picture')} but {counted(len(depths), 'depth picture')}; "
            "add or remove what does not belong"
        )
    described = find_json(root)
    camera = described[0] if described else PRIMESENSE
    warnings = [] if described else ["no camera JSON was found; the PrimeSense default of 525 pixels is used"]
    warnings += left_out
    scale = number(described[1], "depth_scale", str(root)) if described else None
    if scale is not None and scale <= 0:
        raise InputError(f"{root}: the camera's 'depth_scale' is {scale:g}, it must be positive; correct it")
    frames = []
    for index, (picture, name) in enumerate(zip(pictures, unique_names(pictures), strict=True)):
        with single_frame(name):
            depth = depths[index] if depths else None
            frames.append(posed_frame(name, picture, camera, poses[index], f"{log}, entry {index}", depth))
    return assemble("redwood", root, frames, warnings, ordered=True, metric=True, depth_scale=scale or 1000.0)


def _depths(root: Path, scene: str) -> tuple[list[Path], list[str]]:
    """The depth pictures, and a remark where there are others: rendered scenes have clean ones and ones with a sensor's noise."""
    places = ("depth", f"{scene}-depth-clean", f"{scene}-depth-simulated", "depth_noisy")
    there = {name: found for name in places[:3] if (found := pictures_in(root / name))}
    used = next(iter(there), None)
    if used is None:
        return [], []
    more = [f"{name}/" for name in places if name != used and (name in there or pictures_in(root / name))]
    return there[used], [f"the depth in {used}/ is used, that in {', '.join(more)} is left out"] if more else []


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
