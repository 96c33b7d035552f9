"""ScanNet: the exported layout (`color/`, `depth/`, `pose/`, `intrinsic/`) and loose `frame-*.color.jpg` samples of it.

Poses are world_from_camera in OpenCV axes, metres, z up; frames whose tracking was lost have a pose of -inf and are dropped.
Depth is in millimetres, through a camera of its own. ScanNet's subset of 25,000 frames has `intrinsics_color.txt` and
`intrinsics_depth.txt` beside the folders. Samples come without cameras: the sensor's usual ones then stand in.
"""

from __future__ import annotations

from pathlib import Path

from toolkit.camera import Intrinsics
from toolkit.capture.calibration import read_matrix_for, sensor
from toolkit.capture.listing import assemble, files_in, picture_header, pictures_in, require_folder, same_count
from toolkit.capture.seven_scenes import FrameFiles, first_sizes, frame_files, frame_folders, frame_names, posed_frames
from toolkit.capture.seven_scenes_cameras import INFO
from toolkit.capture.types import Capture
from toolkit.errors import InputError

COLOUR_CAMERA = sensor(1296, 968, 1165.72, 1165.74, 647.5, 483.5)  # nominal centre
DEPTH_CAMERA = sensor(640, 480, 577.87, 577.87, 319.5, 239.5)


def looks_like_scannet(path: Path) -> bool:
    if (path / "pose").is_dir() and (path / "color").is_dir():
        return True
    if (path / INFO).is_file():  # BundleFusion's, which brings its cameras
        return False
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
    frames, remarks = posed_frames(found, names, colour_camera, depth_camera, root)
    return assemble(
        "scannet",
        root,
        frames,
        [*warnings, *remarks],
        ordered=True,
        metric=True,
        depth_scale=1000.0,
        up=(0.0, 0.0, 1.0),
        extra={"listed": len(found), "lost": len(found) - len(frames)},
    )


def _exported(root: Path) -> list[FrameFiles]:
    colours = pictures_in(root / "color")
    depths = {path.stem: path for path in pictures_in(root / "depth")}
    poses = {path.stem: path for path in files_in(root / "pose", "*.txt")}
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
        if scaled:  # pictures were exported smaller than the sensor's
            warnings.append(f"{file.name} is for {usual.width}×{usual.height} pictures; scaled to {size[0]}×{size[1]}")
        cameras.append(camera)
    return cameras[0], cameras[1], warnings
