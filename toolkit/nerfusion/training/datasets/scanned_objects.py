"""Google Scanned Objects as rendered by IBRNet: `<object>/{rgb,pose,intrinsics}/NNN.{png,txt}`.

Poses are world_from_camera in OpenCV axes, cameras are 4×4 matrices of 16 numbers, one text file a picture. Pictures are opaque, and white
where they show nothing of the object, whose largest side is about 1.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fieldfuse.capture.calibration import from_matrix
from fieldfuse.capture.headers import image_header
from fieldfuse.capture.listing import assemble, files_in, images_in, read_matrix, require_folder, same_count
from fieldfuse.capture.poses import checked_pose
from fieldfuse.capture.prepare import WHITE
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.errors import InputError
from fieldfuse.nerfusion.training.captured import CapturedScene
from fieldfuse.nerfusion.training.datasets.folders import scene_folders


def _is_scene(path: Path) -> bool:
    return all((path / name).is_dir() for name in ("rgb", "pose", "intrinsics"))


def scanned_object_folders(root: Path | str) -> list[Path]:
    """The objects under `root`.

    Raises:
        InputError: there is none.
    """
    return scene_folders(root, _is_scene, "Google Scanned Objects as IBRNet renders them", inside=("google_scanned_objects",))


def read_scanned_object(folder: Path | str) -> Capture:
    """One object's pictures.

    Raises:
        InputError: pictures, poses and cameras differ in number, or one cannot be used.
    """
    root = require_folder(folder)
    pictures = images_in(root / "rgb")
    same_count(len(pictures), len(files_in(root / "pose", "*.txt")), root)
    frames, alpha = [], 0
    for picture in pictures:
        pose, camera = root / "pose" / f"{picture.stem}.txt", root / "intrinsics" / f"{picture.stem}.txt"
        for file in (pose, camera):
            if not file.is_file():
                raise InputError(f"{picture} has no {file}; add it or remove the picture")
        header = image_header(picture)
        alpha += header.alpha
        matrix = read_matrix(camera, (4, 4), (3, 3))[:3, :3]
        frames.append(
            Frame(
                name=picture.stem,
                image=picture,
                intrinsics=from_matrix(matrix, *header.size, str(camera)),
                world_from_camera=checked_pose(read_matrix(pose, (4, 4)), str(pose)),
            )
        )
    return assemble("scanned_objects", root, frames, alpha=0 < alpha == len(frames))


def scanned_object_scene(folder: Path, long_side: int) -> CapturedScene:
    """One object before nothing, which is white. The renderings look at the origin from around it, so its distance is the depth.

    Raises:
        InputError: it cannot be read.
    """
    capture = read_scanned_object(folder)
    distance = [float(np.linalg.norm(frame.world_from_camera[:3, 3])) for frame in capture.frames if frame.world_from_camera is not None]
    return CapturedScene(capture, "object", long_side, depth_hint=float(np.median(distance)), background=WHITE)
