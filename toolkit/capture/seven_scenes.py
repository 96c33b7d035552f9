"""7-Scenes: `frame-000000.color.png`, `.depth.png`, `.pose.txt`, in the folder itself or in `seq-01/`, `seq-02/`, …

`pose.txt` is world_from_camera in OpenCV axes, metres; depth in millimetres, 0 and 65535 mean missing. Frames whose tracking was lost have
a pose of -inf and are dropped.

The cameras are in `camera-intrinsics.txt` or BundleFusion's `info.txt`. 7-Scenes has one focal length, 585, which fits its depth; its
colour images are not registered to the depth and fit 525 (both are confirmed by reprojection in the tests). A file with that focal length
is 7-Scenes' own and holds for the depth alone; another one is of somebody's own recording, where both images share it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fieldfuse.camera import Intrinsics
from fieldfuse.capture.calibration import from_matrix, posed_frame, read_matrix_for, usable_size
from fieldfuse.capture.headers import image_size
from fieldfuse.capture.listing import (
    assemble,
    counted,
    images_in,
    numbers,
    read_matrix,
    read_text,
    require_folder,
    same_count,
    unique_names,
)
from fieldfuse.capture.poses import single_frame
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.errors import InputError

USUAL = (640, 480)
# Both are nominal: the principal point is the image's centre, so no half pixel is added.
DEPTH_CAMERA = Intrinsics(*USUAL, 585.0, 585.0, 320.0, 240.0)
COLOUR_CAMERA = Intrinsics(*USUAL, 525.0, 525.0, 320.0, 240.0)
STOCK = 0.5  # pixels by which a file's numbers may differ from the set's own
CAMERA_FILES = ("camera-intrinsics.txt", "camera_intrinsics.txt")
INFO = "info.txt"  # BundleFusion's, lines of `name = values`
MILLIMETRES = 1000.0


@dataclass(frozen=True)
class FrameFiles:
    """One frame: its image, its pose file and its depth when there is one."""

    stem: str
    colour: Path
    pose: Path
    depth: Path | None


@dataclass(frozen=True)
class Cameras:
    """Of one folder; images of other sizes get them scaled."""

    colour: Intrinsics
    depth: Intrinsics
    depth_scale: float = MILLIMETRES  # stored values to the metre
    warnings: tuple[str, ...] = ()


def frame_folders(root: Path) -> list[Path]:
    """The folders that hold `frame-*` files: the root itself, else its `seq-*` folders."""
    if next(root.glob("frame-*.color.*"), None) is not None:
        return [root]
    return sorted(folder for folder in root.glob("seq-*") if folder.is_dir() and next(folder.glob("frame-*.color.*"), None) is not None)


def frame_files(root: Path) -> list[FrameFiles]:
    """All frames below `root`, in the order of their folders and numbers."""
    found: list[FrameFiles] = []
    for folder in frame_folders(root):
        images = [path for path in images_in(folder) if path.name.startswith("frame-")]
        colours = [path for path in images if path.stem.endswith(".color")]
        depths = {path.name.split(".")[0]: path for path in images if path.stem.endswith(".depth")}
        poses = {path.name.split(".")[0]: path for path in folder.glob("frame-*.pose.txt")}
        same_count(len(colours), len(poses), folder)
        for colour in colours:
            stem = colour.name.split(".")[0]
            if stem not in poses:
                raise InputError(f"{colour} has no pose file {stem}.pose.txt beside it; add it or remove the image")
            found.append(FrameFiles(stem, colour, poses[stem], depths.get(stem)))
    if not found:
        raise InputError(f"{root} holds no frame-*.color images; give the folder of one scene or one sequence")
    return found


def frame_names(found: list[FrameFiles]) -> list[str]:
    """`frame-000000`, with the sequence before it where numbers repeat."""
    return unique_names([entry.colour.with_name(f"{entry.stem}{entry.colour.suffix}") for entry in found])


def posed_frames(
    found: list[FrameFiles], names: list[str], colour: Intrinsics, depth: Intrinsics, root: Path
) -> tuple[list[Frame], list[str]]:
    """The frames that have a pose, and a remark on those that were lost (-inf or NaN). The cameras are scaled to the images' sizes."""
    frames = []
    lost = 0
    for entry, name in zip(found, names, strict=True):
        with single_frame(name):
            pose = read_matrix(entry.pose, (4, 4))
            if not np.isfinite(pose).all():
                lost += 1
                continue
            frames.append(posed_frame(name, entry.colour, colour, pose, str(entry.pose), entry.depth, depth_intrinsics=depth))
    return frames, lost_frames(len(found), len(found) - lost, root)


def lost_frames(listed: int, tracked: int, where: Path) -> list[str]:
    """A remark on frames whose tracking was lost, none where none was."""
    lost = listed - tracked
    if not tracked:
        raise InputError(f"all {counted(lost, 'pose')} in {where} are -inf or NaN (tracking lost); no frame is left to use")
    return [f"{counted(lost, 'frame')} left out because tracking was lost there (pose -inf or NaN)"] if lost else []


def first_sizes(found: list[FrameFiles]) -> tuple[tuple[int, int], tuple[int, int] | None]:
    """Size (width, height) of the first image that can be read, and of the first depth image, if there is one."""
    colours, depths = [entry.colour for entry in found], [entry.depth for entry in found if entry.depth is not None]
    return image_size(colours[0], colours), image_size(depths[0], depths) if depths else None


def looks_like_seven_scenes(path: Path) -> bool:
    return any(next(folder.glob("frame-*.pose.txt"), None) is not None for folder in frame_folders(path))


def read_seven_scenes(path: Path | str) -> Capture:
    """RGB-D frames with poses in metres.

    Raises:
        InputError: no frames, a pose is missing or not rigid, all are lost, or the camera file is not usable.
    """
    root = require_folder(path)
    found = frame_files(root)
    cameras = _cameras(root, *first_sizes(found))
    frames, remarks = posed_frames(found, frame_names(found), cameras.colour, cameras.depth, root)
    return assemble("7scenes", root, frames, [*cameras.warnings, *remarks], ordered=True, metric=True, depth_scale=cameras.depth_scale)


def _cameras(root: Path, colour_size: tuple[int, int], depth_size: tuple[int, int] | None) -> Cameras:
    """The cameras of the folder whose images have these sizes (width, height); `depth_size` None: there is no depth."""
    file = next((path for name in CAMERA_FILES if (path := root / name).is_file()), None)
    if file is not None:
        given, _ = read_matrix_for(file, depth_size or colour_size, USUAL, shift=0.0)
        there, here = ((one.fx, one.fy, one.cx, one.cy) for one in (DEPTH_CAMERA, given.scaled(*USUAL)))
        return Cameras(COLOUR_CAMERA if np.abs(np.subtract(there, here)).max() <= STOCK else given, given)
    info = root / INFO
    lines = (line.partition("=") for line in read_text(info).splitlines()) if info.is_file() else ()
    values = {name.strip(): words.split() for name, _, words in lines}
    if "m_calibrationColorIntrinsic" not in values:
        warning = (
            f"no {CAMERA_FILES[0]} was found; the usual cameras of 7-Scenes are used "
            f"({COLOUR_CAMERA.fx:g} pixels for colour, {DEPTH_CAMERA.fx:g} for depth)"
        )
        return Cameras(COLOUR_CAMERA, DEPTH_CAMERA, warnings=(warning,))
    colour = _of_info(info, values, "Color", colour_size)
    # Without a camera of its own depth is registered to the colour image.
    depth = _of_info(info, values, "Depth", depth_size or USUAL) if "m_calibrationDepthIntrinsic" in values else colour
    scale = float(numbers(values.get("m_depthShift", [MILLIMETRES]), f"{info}: 'm_depthShift'", 1)[0])
    if not scale > 0:
        raise InputError(f"{info}: 'm_depthShift' is {scale:g}, it must be positive; correct it")
    return Cameras(colour, depth, scale)


def _of_info(path: Path, values: dict[str, list[str]], which: str, size: tuple[int, int]) -> Intrinsics:
    keys = [f"m_{which.lower()}{side}" for side in ("Width", "Height")]
    width, height = (numbers(values.get(key, [side]), f"{path}: {key!r}", 1)[0] for key, side in zip(keys, size, strict=True))
    where = f"{path}: 'm_calibration{which}Intrinsic'"
    matrix = numbers(values[f"m_calibration{which}Intrinsic"], where, 16).reshape(4, 4)
    camera = from_matrix(matrix, *usable_size(width, height, str(path)), where, shift=0.0)
    if (camera.cx, camera.cy) != (camera.width / 2, camera.height / 2):  # calibrated, not nominal: pixel centres at whole numbers
        camera = replace(camera, cx=camera.cx + 0.5, cy=camera.cy + 0.5)
    return camera.centred(where)
