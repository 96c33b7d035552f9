"""ARKitScenes' raw data and 3DOD scenes: `lowres_wide/`, `lowres_depth/`, `lowres_wide_intrinsics/*.pincam`, `lowres_wide.traj`.

A row of the trajectory is `time rx ry rz tx ty tz`: camera_from_world in OpenCV axes as axis times angle, and metres; z is up. Images,
depth (16 bits, mm), confidence (0 to 2) and `.pincam` (`width height fx fy cx cy`) are named by the video and their time to a
millisecond, which may be off by one. Format: https://github.com/apple/ARKitScenes/blob/main/DATA.md.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from fieldfuse.camera import Intrinsics, invert
from fieldfuse.capture.calibration import posed_frame, usable_size
from fieldfuse.capture.listing import assemble, counted, files_in, images_in, numbers, read_text, require_folder
from fieldfuse.capture.poses import single_frame
from fieldfuse.capture.types import Capture
from fieldfuse.errors import InputError

COLOUR, DEPTH, LENS, POSES, CONFIDENCE = "lowres_wide", "lowres_depth", "lowres_wide_intrinsics", "lowres_wide.traj", "confidence"
NEAR = 0.02  # seconds between an image and its pose, which come at 10 and 60 a second


def _root(path: Path) -> Path | None:
    """The folder that holds all of it: `path`, or what 3DOD scenes have below (`40958750_frames/`)."""
    found = [path, *(sorted(path.glob("*_frames")) if path.is_dir() else [])]
    return next((one for one in found if (one / POSES).is_file() and (one / COLOUR).is_dir() and (one / LENS).is_dir()), None)


def looks_like_arkitscenes(path: Path) -> bool:
    return _root(path) is not None


def read_arkitscenes(path: Path | str) -> Capture:
    """Frames with poses in metres, depth and confidence. Images without a pose or camera near their time are counted and left out.

    Raises:
        InputError: no image has a pose, or a file is broken.
    """
    given = require_folder(path)
    root = _root(given)
    if root is None:
        raise InputError(f"{given} must hold {COLOUR}/, {LENS}/ and {POSES}; download these assets of the scene")
    rows = numbers([line.split() for line in read_text(root / POSES).splitlines() if line.strip()], str(root / POSES))
    if rows.ndim != 2 or rows.shape[1] != 7:
        raise InputError(f"{root / POSES} must hold seven numbers a row (time, axis times angle, translation); download it again")
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    images = images_in(root / COLOUR, (".png", ".jpg"))
    lenses, depths, trusted = (
        _by_time(files_in(root / kind, pattern)) for kind, pattern in ((LENS, "*.pincam"), (DEPTH, "*.png"), (CONFIDENCE, "*.png"))
    )
    frames = []
    lost = 0
    for image in images:
        time = _time(image)
        lens = None if time is None else _nearest(lenses, time)
        at = None if time is None else int(np.abs(rows[:, 0] - time).argmin())
        if time is None or lens is None or at is None or abs(rows[at, 0] - time) > NEAR:
            lost += 1
            continue
        with single_frame(image.stem):
            where = f"{root / POSES}, row {at + 1}"
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec(rows[at, 1:4]).as_matrix(), rows[at, 4:]
            depth, confidence = _nearest(depths, time), _nearest(trusted, time)
            frames.append(posed_frame(image.stem, image, _lens(lens), invert(pose), where, depth, confidence=confidence))
    remarks = [f"{lost} of {counted(len(images), 'image')} have no pose or camera of their time and are left out"] if lost else []
    return assemble("arkitscenes", given, frames, remarks, ordered=True, metric=True, up=(0.0, 0.0, 1.0))


def _time(file: Path) -> float | None:
    """Seconds: of `41069021_305.377.png` 305.377."""
    try:
        return float(file.stem.rsplit("_", 1)[-1])
    except ValueError:
        return None


def _by_time(files: list[Path]) -> dict[int, Path]:
    """Files by their time in milliseconds."""
    return {round(1000 * time): file for file in files if (time := _time(file)) is not None and abs(time) < 1e9}


def _nearest(files: dict[int, Path], time: float) -> Path | None:
    wanted = round(1000 * time)
    return next((files[wanted + off] for off in (0, -1, 1, -2, 2) if wanted + off in files), None)


def _lens(file: Path) -> Intrinsics:
    width, height, fx, fy, cx, cy = numbers(read_text(file).split(), str(file), 6).tolist()
    return Intrinsics(*usable_size(width, height, str(file)), fx, fy, cx, cy).checked(str(file)).centred(str(file))
