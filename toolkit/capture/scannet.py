"""ScanNet: `.sens` files as the site publishes them, the layout that its reader exports (`color/`, `depth/`, `pose/`, `intrinsic/`), and
loose `frame-*.color.jpg` samples of that.

Poses are world_from_camera in OpenCV axes, metres, z up; frames whose tracking was lost have a pose of -inf and are dropped.
Depth is in millimetres, through a camera of its own. ScanNet's subset of 25,000 frames has `intrinsics_color.txt` and
`intrinsics_depth.txt` beside the folders. Samples come without cameras: the sensor's usual ones then stand in. Where a folder holds
frames as files, these go before its `.sens`: somebody exported them, perhaps on purpose not all.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fieldfuse.camera import Intrinsics
from fieldfuse.capture.calibration import fitted, from_matrix, read_matrix_for, sensor
from fieldfuse.capture.headers import image_header
from fieldfuse.capture.listing import assemble, counted, files_in, images_in, require_folder, same_count
from fieldfuse.capture.poses import checked_pose
from fieldfuse.capture.sens import SUFFIX, scan, sens_size
from fieldfuse.capture.seven_scenes import (
    INFO,
    FrameFiles,
    first_sizes,
    frame_files,
    frame_folders,
    frame_names,
    lost_frames,
    posed_frames,
)
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.errors import InputError

COLOUR_CAMERA = sensor(1296, 968, 1165.72, 1165.74, 647.5, 483.5)  # nominal centre
DEPTH_CAMERA = sensor(640, 480, 577.87, 577.87, 319.5, 239.5)
UP = (0.0, 0.0, 1.0)


def looks_exported(path: Path) -> bool:
    """Whether a folder holds what ScanNet's reader exports."""
    return (path / "pose").is_dir() and (path / "color").is_dir()


def packed(path: Path) -> list[Path]:
    """The `.sens` files directly in a folder that holds no frames as files."""
    return [] if looks_exported(path) or frame_folders(path) else images_in(path, (SUFFIX,))


def looks_like_scannet(path: Path) -> bool:
    if looks_exported(path) or packed(path):
        return True
    if (path / INFO).is_file():  # BundleFusion's, which has its cameras
        return False
    # A sample shares its file names with 7-Scenes; there colour and depth have one size, here they differ.
    for folder in frame_folders(path):
        for colour in sorted(folder.glob("frame-*.color.*")):
            depth = colour.with_name(f"{colour.name.split('.')[0]}.depth.png")
            if depth.is_file():
                return image_header(colour).size != image_header(depth).size
    return False


def read_scannet(path: Path | str) -> Capture:
    """RGB-D frames with poses in metres.

    Raises:
        InputError: no frames, images and poses differ in number, a pose is NaN or not rigid, or a camera file is not usable.
    """
    root = require_folder(path)
    inside = packed(root)
    if len(inside) > 1:
        raise InputError(f"{root} holds {len(inside)} .sens files; give one of them, for instance {inside[0]}")
    if inside:
        return read_sens(inside[0])
    exported = (root / "pose").is_dir()
    found = _exported(root) if exported else frame_files(root)
    names = [entry.stem for entry in found] if exported else frame_names(found)
    colour_camera, depth_camera, warnings = _cameras(root, found)
    frames, remarks = posed_frames(found, names, colour_camera, depth_camera, root)
    extra = {"listed": len(found), "lost": len(found) - len(frames)}
    return assemble("scannet", root, frames, [*warnings, *remarks], ordered=True, metric=True, up=UP, extra=extra)


def read_sens(path: Path) -> Capture:
    """The frames of a `.sens` file that have a pose, still inside it (`Capture.filmed`); named by their number, as they are exported.

    Raises:
        InputError: the file is not usable, all frames are lost, a pose or a camera in it is none, or its images have another shape.
    """
    found = scan(path)
    colour, depth = (
        from_matrix(found.matrices[which], *size, f"{path}: the {what} camera").centred(f"{path}: the {what} camera")
        for which, size, what in ((0, found.size, "colour"), (2, found.depth_size, "depth"))
    )
    seen = np.flatnonzero(found.places[:, 1])
    if not len(seen):
        raise InputError(f"{path} holds no image; copy it again from where it was published")
    tracked = [int(index) for index in seen if np.isfinite(found.poses[index]).all()]
    remarks = lost_frames(len(seen), len(tracked), path)
    if len(seen) < len(found):
        remarks.append(f"{counted(len(found) - len(seen), 'frame')} of {path.name} left out because no image belongs to it")
    if np.abs(found.matrices[[1, 3]] - np.eye(4)).max() > 1e-6:
        remarks.append(f"{path.name} has the offset between image and depth camera, which is not used: both are taken as one")
    colour = fitted(colour, sens_size(found, tracked[0]), f"{path}, frame {tracked[0]}")
    frames = [
        Frame(
            name=str(index),
            image=path,
            intrinsics=colour,
            world_from_camera=checked_pose(found.poses[index], f"{path}, frame {index}"),
            depth=path if found.places[index, 2] else None,
            depth_intrinsics=depth if found.places[index, 2] else None,
            video_index=index,
        )
        for index in tracked
    ]
    seconds = (float(found.times[-1]) - float(found.times[0])) / 1e6
    rate = (len(found) - 1) / seconds if seconds > 0 else 0.0
    extra = {"listed": len(found), "lost": len(seen) - len(tracked), "fps": rate if 1 <= rate <= 240 else 0.0}  # 0: unknown
    facts = {"ordered": True, "metric": True, "depth_scale": found.depth_scale, "up": UP, "extra": extra}
    return assemble("scannet", path.parent, frames, remarks, **facts)


def _exported(root: Path) -> list[FrameFiles]:
    colours = images_in(root / "color")
    depths = {path.stem: path for path in images_in(root / "depth")}
    poses = {path.stem: path for path in files_in(root / "pose", "*.txt")}
    same_count(len(colours), len(poses), root)
    for colour in colours:
        if colour.stem not in poses:
            raise InputError(f"{colour} has no pose {root / 'pose' / colour.stem}.txt; add it or remove the image")
    if not colours:
        raise InputError(f"{root / 'color'} holds no images; export the scan's colour images first")
    return [FrameFiles(colour.stem, colour, poses[colour.stem], depths.get(colour.stem)) for colour in colours]


def _cameras(root: Path, found: list[FrameFiles]) -> tuple[Intrinsics, Intrinsics, list[str]]:
    """Colour and depth camera, from `intrinsic/` (or beside the frames), else the sensor's usual ones with a warning."""
    colour_size, depth_size = first_sizes(found)
    warnings = []
    cameras: list[Intrinsics] = []
    for which, size, usual in (("color", colour_size, COLOUR_CAMERA), ("depth", depth_size or (640, 480), DEPTH_CAMERA)):
        name = f"intrinsic_{which}.txt"
        places = (root / "intrinsic" / name, root / name, root / f"intrinsics_{which}.txt")
        file = next((path for path in places if path.is_file()), None)
        if file is None:
            cameras.append(usual)
            warnings.append(f"no {name} was found; the sensor's usual {'colour' if which == 'color' else 'depth'} camera is used")
            continue
        camera, scaled = read_matrix_for(file, size, (usual.width, usual.height))
        if scaled:  # images were exported smaller than the sensor's
            warnings.append(f"{file.name} is for {usual.width}×{usual.height} images; scaled to {size[0]}×{size[1]}")
        cameras.append(camera)
    return cameras[0], cameras[1], warnings
