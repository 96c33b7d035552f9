"""7-Scenes: `frame-000000.color.png`, `.depth.png`, `.pose.txt`, in the folder itself or in `seq-01/`, `seq-02/`, …

`pose.txt` is world_from_camera in OpenCV axes, metres; depth in millimetres, 0 and 65535 mean missing. The set ships one focal
length, 585, which fits its depth; its colour pictures are not registered to the depth and fit 525 (both are confirmed by
reprojection in the tests). Other cameras: `seven_scenes_cameras`. Frames whose tracking was lost have a pose of -inf and are dropped.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fieldfuse.camera import Intrinsics
from fieldfuse.capture.listing import assemble, counted, pictures_in, read_matrix, require_folder, same_count, unique_names
from fieldfuse.capture.poses import checked_pose, single_frame
from fieldfuse.capture.seven_scenes_cameras import read_cameras
from fieldfuse.capture.sizes import first_size, fitted, picture_header
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.errors import InputError


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


def posed_frames(
    found: list[FrameFiles], names: list[str], colour: Intrinsics, depth: Intrinsics, root: Path
) -> tuple[list[Frame], list[str]]:
    """The frames that have a pose, and a remark on those that were lost (-inf or NaN). The cameras are scaled to the pictures' sizes.

    Raises:
        InputError: all are lost, a pose is not rigid, or a picture has another shape than its camera.
    """
    frames = []
    lost = 0
    for entry, name in zip(found, names, strict=True):
        with single_frame(name):
            pose = read_matrix(entry.pose, (4, 4))
            if not np.isfinite(pose).all():
                lost += 1
                continue
            frames.append(
                Frame(
                    name=name,
                    image=entry.colour,
                    intrinsics=fitted(colour, picture_header(entry.colour).size, str(entry.colour)),
                    world_from_camera=checked_pose(pose, str(entry.pose)),
                    depth=entry.depth,
                    depth_intrinsics=None if entry.depth is None else fitted(depth, picture_header(entry.depth).size, str(entry.depth)),
                )
            )
    return frames, lost_frames(len(found), len(found) - lost, root)


def lost_frames(listed: int, tracked: int, where: Path) -> list[str]:
    """A remark on frames whose tracking was lost, none where none was.

    Raises:
        InputError: all of them are.
    """
    lost = listed - tracked
    if not tracked:
        raise InputError(f"all {counted(lost, 'pose')} in {where} are -inf or NaN (tracking lost); no frame is left to use")
    return [f"{counted(lost, 'frame')} left out because tracking was lost there (pose -inf or NaN)"] if lost else []


def first_sizes(found: list[FrameFiles]) -> tuple[tuple[int, int], tuple[int, int] | None]:
    """Size (width, height) of the first picture that can be read, and of the first depth picture, if there is one."""
    depths = [entry.depth for entry in found if entry.depth is not None]
    return first_size([entry.colour for entry in found]), first_size(depths) if depths else None


def looks_like_seven_scenes(path: Path) -> bool:
    return any(next(folder.glob("frame-*.pose.txt"), None) is not None for folder in frame_folders(path))


def read_seven_scenes(path: Path | str) -> Capture:
    """RGB-D frames with poses in metres.

    Raises:
        InputError: no frames, a pose is missing or not rigid, all are lost, or the camera file is not usable.
    """
    root = require_folder(path)
    found = frame_files(root)
    cameras = read_cameras(root, *first_sizes(found))
    frames, remarks = posed_frames(found, frame_names(found), cameras.colour, cameras.depth, root)
    return assemble("7scenes", root, frames, [*cameras.warnings, *remarks], ordered=True, metric=True, depth_scale=cameras.depth_scale)
