"""7-Scenes: `frame-000000.color.png`, `.depth.png`, `.pose.txt`, in the folder itself or in `seq-01/`, `seq-02/`, …

`pose.txt` is world_from_camera in OpenCV axes, metres; depth in millimetres, 0 and 65535 mean missing. The set ships one focal
length, 585, which fits its depth; its colour pictures are not registered to the depth and fit 525 (both are confirmed by
reprojection in the tests). A `camera-intrinsics.txt` replaces the depth camera.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from toolkit.camera import Intrinsics, checked_pose
from toolkit.capture.calibration import read_matrix_file
from toolkit.capture.listing import assemble, fitted, picture_header, pictures_in, read_matrix, require_folder, same_count, unique_names
from toolkit.capture.types import Capture, Frame
from toolkit.errors import InputError

# Both are nominal: the principal point is the picture's centre, so no half pixel is added.
DEPTH_CAMERA = Intrinsics(640, 480, 585.0, 585.0, 320.0, 240.0)
COLOUR_CAMERA = Intrinsics(640, 480, 525.0, 525.0, 320.0, 240.0)
CAMERA_FILES = ("camera-intrinsics.txt", "camera_intrinsics.txt")


@dataclass(frozen=True)
class FrameFiles:
    """One `frame-…`: its picture, its pose file and its depth when there is one."""

    stem: str
    colour: Path
    pose: Path
    depth: Path | None


def frame_folders(root: Path) -> list[Path]:
    """The folders that hold `frame-*` files: the root itself, else its `seq-*` folders."""
    if next(root.glob("frame-*.color.*"), None) is not None:
        return [root]
    return sorted(folder for folder in root.glob("seq-*") if folder.is_dir() and next(folder.glob("frame-*.color.*"), None) is not None)


def frame_files(root: Path) -> list[FrameFiles]:
    """All frames below `root`, in the order of their folders and numbers.

    Raises:
        InputError: no frames, or not one pose for each picture.
    """
    found: list[FrameFiles] = []
    for folder in frame_folders(root):
        pictures = [path for path in pictures_in(folder) if path.name.startswith("frame-")]
        colours = [path for path in pictures if path.stem.endswith(".color")]
        depths = {path.name.split(".")[0]: path for path in pictures if path.stem.endswith(".depth")}
        poses = {path.name.split(".")[0]: path for path in folder.glob("frame-*.pose.txt")}
        same_count(len(colours), len(poses), folder)
        for colour in colours:
            stem = colour.name.split(".")[0]
            if stem not in poses:
                raise InputError(f"{colour} has no pose file {stem}.pose.txt beside it; add it or remove the picture")
            found.append(FrameFiles(stem, colour, poses[stem], depths.get(stem)))
    if not found:
        raise InputError(f"{root} holds no frame-*.color pictures; give the folder of one scene or one sequence")
    return found


def frame_names(found: list[FrameFiles]) -> list[str]:
    """`frame-000000`, with the sequence before it where numbers repeat."""
    return unique_names([entry.colour.with_name(f"{entry.stem}{entry.colour.suffix}") for entry in found])


def looks_like_seven_scenes(path: Path) -> bool:
    return any(next(folder.glob("frame-*.pose.txt"), None) is not None for folder in frame_folders(path))


def read_seven_scenes(path: Path | str) -> Capture:
    """RGB-D frames with poses in metres.

    Raises:
        InputError: no frames, a pose is missing or not rigid, or the camera file is not usable.
    """
    root = require_folder(path)
    found = frame_files(root)
    depth_camera = next((read_matrix_file(file, 640, 480, 0.0) for name in CAMERA_FILES if (file := root / name).is_file()), DEPTH_CAMERA)
    frames = []
    for entry, name in zip(found, frame_names(found), strict=True):
        depth_intrinsics = None
        if entry.depth is not None:
            depth_intrinsics = fitted(depth_camera, picture_header(entry.depth).size, str(entry.depth))
        frames.append(
            Frame(
                name=name,
                image=entry.colour,
                intrinsics=fitted(COLOUR_CAMERA, picture_header(entry.colour).size, str(entry.colour)),
                world_from_camera=checked_pose(read_matrix(entry.pose, (4, 4)), str(entry.pose)),
                depth=entry.depth,
                depth_intrinsics=depth_intrinsics,
            )
        )
    return assemble("7scenes", root, frames, ordered=True, metric=True, depth_scale=1000.0)
