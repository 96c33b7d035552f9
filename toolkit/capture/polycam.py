"""Polycam's raw data, of phones with a depth sensor: `keyframes/` with `images/`, `cameras/`, `depth/`, `confidence/`, a file a key frame.

A camera is a JSON with `t_00` to `t_23` (world_from_camera in OpenGL axes, metres, y up), `fx`, `fy`, `cx`, `cy`, `width` and `height`.
Where the app closed loops, `corrected_images/` and `corrected_cameras/` are better and used. Depth is in millimetres, smaller than
the image; a confidence of 0 marks a guess.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fieldfuse.camera import Array, Intrinsics, world_from_opengl
from fieldfuse.capture.calibration import posed_frame, usable_size
from fieldfuse.capture.listing import assemble, files_in, images_in, is_file, number, read_object, require_folder, unique_names
from fieldfuse.capture.poses import single_frame
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.errors import InputError

KEYFRAMES = "keyframes"
POSE = [f"t_{row}{column}" for row in range(3) for column in range(4)]
KEYS = ("width", "height", "fx", "fy", "cx", "cy", *POSE)


def _folders(path: Path) -> tuple[Path, Path] | None:
    """Where the images and the cameras lie; `path` is what was exported, or its `keyframes/`."""
    root = path if path.name == KEYFRAMES else path / KEYFRAMES
    pairs = [(root / f"{prefix}images", root / f"{prefix}cameras") for prefix in ("corrected_", "")]
    usable = [(images, cameras) for images, cameras in pairs if images.is_dir() and cameras.is_dir() and files_in(cameras, "*.json")]
    return next((pair for pair in usable if images_in(pair[0])), usable[0] if usable else None)


def looks_like_polycam(path: Path) -> bool:
    return _folders(path) is not None


def read_polycam(path: Path | str) -> Capture:
    """Key frames with poses in metres, and depth where the phone has a sensor. Images without a camera are counted and left out.

    Raises:
        InputError: no key frame has an image and a camera, or a camera is not usable.
    """
    root = require_folder(path)
    folders = _folders(root)
    if folders is None:
        raise InputError(f"{root} has no {KEYFRAMES}/ with images/ and cameras/; export the raw data of the scan")
    images, cameras = folders
    found = images_in(images)
    used = [image for image in found if is_file(cameras / f"{image.stem}.json")]
    frames = []
    for image, name in zip(used, unique_names(used), strict=True):
        with single_frame(name):
            frames.append(_frame(image, cameras / f"{image.stem}.json", name))
    lost = len(found) - len(used)
    remarks = [f"{lost} of the {len(found)} images in {images.name}/ have no file in {cameras.name}/ and are left out"] if lost else []
    return assemble("polycam", root, frames, remarks, ordered=True, metric=True, up=(0.0, 1.0, 0.0))


def _frame(image: Path, camera: Path, name: str) -> Frame:
    data, where = read_object(camera), str(camera)
    values = {key: value for key in KEYS if (value := number(data, key, where)) is not None}
    if len(values) < len(KEYS):
        absent = next(key for key in KEYS if key not in values)
        raise InputError(f"{where} has no {absent!r}; export the raw data again, or remove this key frame")
    fx, fy, cx, cy = (values[key] for key in ("fx", "fy", "cx", "cy"))
    lens = Intrinsics(*usable_size(values["width"], values["height"], where), fx, fy, cx, cy)
    pose: Array = np.eye(4)
    pose[:3] = np.reshape([values[key] for key in POSE], (3, 4))
    depth, confidence = (image.parent.parent / kind / f"{image.stem}.png" for kind in ("depth", "confidence"))
    return posed_frame(
        name,
        image,
        lens.checked(where).centred(where),
        world_from_opengl(pose),
        where,
        depth if is_file(depth) else None,
        confidence=confidence,
    )
