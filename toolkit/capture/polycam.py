"""Polycam's raw data, of phones with a depth sensor: `keyframes/` with `images/`, `cameras/`, `depth/`, `confidence/`, a file a key frame.

A camera is a JSON with `t_00` to `t_23` (world_from_camera in OpenGL axes, metres, y up), `fx`, `fy`, `cx`, `cy`, `width` and `height`.
Where the app closed loops, `corrected_images/` and `corrected_cameras/` are better and taken. Depth is in millimetres, smaller than
the picture; a confidence of 0 is the sensor's own word for a guess.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fieldfuse.camera import Array, Intrinsics, world_from_opengl
from fieldfuse.capture.listing import assemble, files_in, is_file, pictures_in, read_object, require_folder, unique_names
from fieldfuse.capture.nerf_json import MAX_SIDE, number
from fieldfuse.capture.poses import checked_pose, single_frame
from fieldfuse.capture.sizes import fitted, picture_header
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.errors import InputError

KEYFRAMES = "keyframes"
BETTER = "corrected_"  # prefix of what the app has improved
LENS = ("fx", "fy", "cx", "cy", "width", "height")


def _folders(path: Path) -> tuple[Path, Path] | None:
    """Where the pictures and the cameras lie; `path` is what was exported, or its `keyframes/`."""
    root = path if path.name == KEYFRAMES else path / KEYFRAMES
    pairs = [(root / f"{prefix}images", root / f"{prefix}cameras") for prefix in (BETTER, "")]
    usable = [(images, cameras) for images, cameras in pairs if images.is_dir() and cameras.is_dir() and files_in(cameras, "*.json")]
    return next((pair for pair in usable if pictures_in(pair[0])), usable[0] if usable else None)


def looks_like_polycam(path: Path) -> bool:
    return _folders(path) is not None


def read_polycam(path: Path | str) -> Capture:
    """Key frames with poses in metres, and depth where the phone has a sensor. Pictures without a camera are counted and left out.

    Raises:
        InputError: no key frame has a picture and a camera, or a camera is not usable.
    """
    root = require_folder(path)
    folders = _folders(root)
    if folders is None:
        raise InputError(f"{root} has no {KEYFRAMES}/ with images/ and cameras/; export the raw data of the scan")
    images, cameras = folders
    pictures = pictures_in(images)
    used = [picture for picture in pictures if is_file(cameras / f"{picture.stem}.json")]
    frames = []
    for picture, name in zip(used, unique_names(used), strict=True):
        with single_frame(name):
            frames.append(_frame(picture, cameras / f"{picture.stem}.json", name))
    lost = len(pictures) - len(used)
    remarks = [f"{lost} of the {len(pictures)} pictures in {images.name}/ have no file in {cameras.name}/ and are left out"] if lost else []
    return assemble("polycam", root, frames, remarks, ordered=True, metric=True, up=(0.0, 1.0, 0.0))


def _frame(picture: Path, camera: Path, name: str) -> Frame:
    data = read_object(camera)
    where = str(camera)
    values = {key: number(data, key, where) for key in (*LENS, *(f"t_{row}{column}" for row in range(3) for column in range(4)))}
    absent = [key for key, value in values.items() if value is None]
    if absent:
        raise InputError(f"{where} has no {absent[0]!r}; export the raw data again, or remove this key frame")
    told: dict[str, float] = {key: value for key, value in values.items() if value is not None}
    if not (1 <= told["width"] <= MAX_SIDE and 1 <= told["height"] <= MAX_SIDE):
        raise InputError(f"{where}: the picture's size {told['width']:g}×{told['height']:g} cannot be; correct it")
    lens = Intrinsics(round(told["width"]), round(told["height"]), told["fx"], told["fy"], told["cx"], told["cy"])
    pose: Array = np.eye(4)
    pose[:3] = [[told[f"t_{row}{column}"] for column in range(4)] for row in range(3)]
    intrinsics = fitted(lens.checked(where).centred(where), picture_header(picture).size, str(picture))
    root = picture.parent.parent
    depth: Path | None = root / "depth" / f"{picture.stem}.png"
    depth = depth if depth is not None and is_file(depth) else None
    confidence = root / "confidence" / f"{picture.stem}.png"
    return Frame(
        name=name,
        image=picture,
        intrinsics=intrinsics,
        world_from_camera=checked_pose(world_from_opengl(pose), where),
        depth=depth,
        depth_intrinsics=None if depth is None else fitted(intrinsics, picture_header(depth).size, str(depth)),
        confidence=confidence if depth is not None and is_file(confidence) else None,
    )
