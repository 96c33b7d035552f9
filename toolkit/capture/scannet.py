"""ScanNet: the exported layout (`color/`, `depth/`, `pose/`, `intrinsic/`) and loose `frame-*.color.jpg` samples of it.

Poses are world_from_camera in OpenCV axes, metres, z up; frames whose tracking was lost have a pose of -inf and are dropped.
Depth is in millimetres, through a camera of its own. Samples come without cameras: the sensor's usual ones then stand in.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from toolkit.camera import Intrinsics, checked_pose
from toolkit.capture.calibration import read_matrix_file, sensor
from toolkit.capture.listing import assemble, counted, fitted, picture_header, pictures_in, read_matrix, require_folder, same_count
from toolkit.capture.seven_scenes import FrameFiles, frame_files, frame_folders, frame_names
from toolkit.capture.types import Capture, Frame
from toolkit.errors import InputError

COLOUR_CAMERA = sensor(1296, 968, 1165.72, 1165.74, 647.5, 483.5)  # nominal centre
DEPTH_CAMERA = sensor(640, 480, 577.87, 577.87, 319.5, 239.5)


def looks_like_scannet(path: Path) -> bool:
    if (path / "pose").is_dir() and (path / "color").is_dir():
        return True
    # A sample shares its file names with 7-Scenes; there colour and depth have one size, here they differ.
    for folder in frame_folders(path):
        for colour in sorted(folder.glob("frame-*.color.*")):
            depth = colour.with_name(f"{colour.name.split('.')[0]}.depth.png")
            if depth.is_file():
                return picture_header(colour).size != picture_header(depth).size
    return False


def read_scannet(path: Path | str) -> Capture:
    """RGB-D frames with poses in metres.

    Raises:
        InputError: no frames, pictures and poses differ in number, a pose is NaN or not rigid, or a camera file is not usable.
    """
    root = require_folder(path)
    found = _exported(root) if (root / "pose").is_dir() else frame_files(root)
    names = frame_names(found) if not (root / "pose").is_dir() else [entry.stem for entry in found]
    colour_camera, depth_camera, warnings = _cameras(root, found)
    frames, lost = [], 0
    for entry, name in zip(found, names, strict=True):
        pose = read_matrix(entry.pose, (4, 4))
        if np.isinf(pose).any():
            lost += 1
            continue
        frames.append(
            Frame(
                name=name,
                image=entry.colour,
                intrinsics=fitted(colour_camera, picture_header(entry.colour).size, str(entry.colour)),
                world_from_camera=checked_pose(pose, str(entry.pose)),
                depth=entry.depth,
                depth_intrinsics=None if entry.depth is None else fitted(depth_camera, picture_header(entry.depth).size, str(entry.depth)),
            )
        )
    if not frames:
        raise InputError(f"all {counted(lost, 'pose')} in {root} are -inf (tracking lost); no frame is left to use")
    if lost:
        warnings.append(f"{counted(lost, 'frame')} left out because tracking was lost there (pose -inf)")
    return assemble(
        "scannet",
        root,
        frames,
        warnings,
        ordered=True,
        metric=True,
        depth_scale=1000.0,
        up=(0.0, 0.0, 1.0),
        extra={"listed": len(found), "lost": lost},
    )


def _exported(root: Path) -> list[FrameFiles]:
    colours = pictures_in(root / "color")
    depths = {path.stem: path for path in pictures_in(root / "depth")}
    poses = {path.stem: path for path in (root / "pose").glob("*.txt")}
    same_count(len(colours), len(poses), root)
    found = []
    for colour in colours:
        if colour.stem not in poses:
            raise InputError(f"{colour} has no pose {root / 'pose' / colour.stem}.txt; add it or remove the picture")
        found.append(FrameFiles(colour.stem, colour, poses[colour.stem], depths.get(colour.stem)))
    if not found:
        raise InputError(f"{root / 'color'} holds no pictures; export the scan's colour pictures first")
    return found


def _cameras(root: Path, found: list[FrameFiles]) -> tuple[Intrinsics, Intrinsics, list[str]]:
    """Colour and depth camera, from `intrinsic/` (or beside the frames), else the sensor's usual ones with a warning."""
    colour_size = picture_header(found[0].colour).size
    depth_path = next((entry.depth for entry in found if entry.depth is not None), None)
    depth_size = picture_header(depth_path).size if depth_path is not None else (640, 480)
    warnings = []
    cameras: list[Intrinsics] = []
    for which, size, usual in (("color", colour_size, COLOUR_CAMERA), ("depth", depth_size, DEPTH_CAMERA)):
        name = f"intrinsic_{which}.txt"
        file = next((path for path in (root / "intrinsic" / name, root / name) if path.is_file()), None)
        if file is None:
            cameras.append(usual)
            warnings.append(f"no {name} was found; the sensor's usual {'colour' if which == 'color' else 'depth'} camera is used")
            continue
        camera = read_matrix_file(file, *size)
        if camera.cx > size[0] and which == "color":  # pictures were exported smaller than the sensor's 1296×968
            camera = fitted(read_matrix_file(file, COLOUR_CAMERA.width, COLOUR_CAMERA.height), size, str(file))
            warnings.append(f"{name} is for {COLOUR_CAMERA.width}×{COLOUR_CAMERA.height} pictures; scaled to {size[0]}×{size[1]}")
        cameras.append(camera)
    return cameras[0], cameras[1], warnings
