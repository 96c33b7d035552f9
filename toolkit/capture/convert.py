"""Images written once as JPEG, and cameras for the pixels as files hold them.

HEIF takes ten times as long to decode as JPEG, and camera raw a hundred times, which every stage would do again, and few other programs
read them; for photos that EXIF mirrors no camera could be exported. All of these are written anew. Photos are turned upright by EXIF before
anything is done with them; other programs, and captures that come with poses, take the pixels as they are stored.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from fieldfuse.camera import FISHEYE, Array, Intrinsics
from fieldfuse.capture.checks import check_capture
from fieldfuse.capture.headers import image_header, orientation_of
from fieldfuse.capture.heif import file_is_heif
from fieldfuse.capture.images import read_image, turns_by_exif, upright
from fieldfuse.capture.light import with_white
from fieldfuse.capture.listing import counted, unique_names
from fieldfuse.capture.raw import is_raw
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.errors import InputError, OutputError, first_line
from fieldfuse.files import atomic_path, fingerprint, read_json, write_json
from fieldfuse.progress import SILENT, Progress
from fieldfuse.threads import share

VERSION = 2  # of what is written
QUALITY = 97  # of the JPEG files, as of a video's frames
MOST_AT_ONCE, PIXELS_AT_ONCE = 8, 200e6  # images, and their pixels, on their way at a time: a pixel takes about ten bytes
RAW_TIMES = 3  # as much memory a pixel takes to be developed
CONVERTED = "converted"  # in `Capture.extra`: how many images were
MARKER = "converted.json"  # beside them: what each was made of
TURNS = {3: (-1, 0), 6: (0, 1), 8: (0, -1)}  # EXIF orientation → cosine and sine of the turn from the upright image to the stored one
MIRRORED = (2, 4, 5, 7)  # orientations that no camera has: rotations do not mirror


def to_convert(capture: Capture) -> list[int]:
    """Indices of the frames whose images are HEIF or camera raw, or photos that are to be mirrored."""
    exif = turns_by_exif(capture)
    return [
        i
        for i, frame in enumerate(capture.frames)
        if frame.video_index is None
        and (file_is_heif(frame.image) or is_raw(frame.image) or (exif and orientation_of(frame.image) in MIRRORED))
    ]


def all_converted(capture: Capture) -> bool:
    """Whether every image is one that `convert_images` wrote."""
    return CONVERTED in capture.extra and all((folder / MARKER).is_file() for folder in {frame.image.parent for frame in capture.frames})


def convert_images(capture: Capture, out: Path, threads: int, progress: Progress = SILENT) -> Capture:
    """The capture with every image of `to_convert` replaced by an upright JPEG (with alpha: PNG) of the same name in `out/frames`, in sRGB.

    What is there and is of the same file is not written again, so a killed run continues where it stopped.

    Returns:
        the capture, checked; `extra["converted"]` counts the images.

    Raises:
        InputError: an image is damaged, or the capture is unusable (see `check_capture`).
        OutputError: an image cannot be written.
    """
    indices = to_convert(capture)
    capture = with_white(capture, progress)
    folder = Path(out) / "frames"
    names = unique_names([capture.frames[i].image for i in indices])
    done = still_good(folder, {name: _state(capture.frames[i]) for name, i in zip(names, indices, strict=True)})
    finished = 0

    def convert(one: tuple[str, int]) -> tuple[int, Path]:
        nonlocal finished
        name, index = one
        progress.check()
        path = done.get(name) or write_image(capture.frames[index], folder / name)
        finished += 1
        progress.update(finished, len(indices), f"{finished} of {counted(len(indices), 'image')} as JPEG")
        return index, path.resolve()

    images = [capture.frames[i].image for i in indices]
    largest = max((math.prod(image_header(image).size) * (RAW_TIMES if is_raw(image) else 1) for image in images), default=1)
    at_once = max(1, min(threads, MOST_AT_ONCE, int(PIXELS_AT_ONCE / largest)))
    written = dict(share(convert, list(zip(names, indices, strict=True)), at_once))
    as_shown: dict[str, Any] = {"white": None, "linear": None, "balance": None}
    frames = [replace(frame, image=written[i], **as_shown) if i in written else frame for i, frame in enumerate(capture.frames)]
    return check_capture(replace(capture.with_frames(frames), extra={**capture.extra, CONVERTED: len(indices)}), progress)


def _state(frame: Frame) -> str:
    """What distinguishes the image that is written of a frame from others."""
    shown = [frame.white, frame.linear, frame.balance]
    return fingerprint(VERSION, frame.image, *(shown if any(value is not None for value in shown) else []))


def write_image(frame: Frame, target: Path) -> Path:
    """Write a frame's image, upright, as `save_image` does, and return its path."""
    return save_image(upright(*read_image(frame)), target, frame.image)


def save_image(image: Array, target: Path, source: Path) -> Path:
    """Write (H, W, 3 or 4) uint8, made of the file `source`, as `target` with `.jpg` added, or `.png` where it has alpha; its path."""
    alpha = image.shape[2] == 4
    path = target.with_name(f"{target.name}.{'png' if alpha else 'jpg'}")
    order = cv2.COLOR_RGBA2BGRA if alpha else cv2.COLOR_RGB2BGR
    coded, data = cv2.imencode(path.suffix, cv2.cvtColor(image, order), [] if alpha else [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    if not coded:
        raise OutputError(f"the image {source} cannot be encoded as {path.suffix[1:].upper()}; convert it by another program")
    with atomic_path(path) as temporary:
        temporary.write_bytes(data.tobytes())
    return path


def still_good(folder: Path, wanted: dict[str, str]) -> dict[str, Path]:
    """Of the images wanted (name → state of its source) those that an earlier attempt left there; what it left of other sources is
    removed, and what is wanted is noted down."""
    marker = folder / MARKER
    try:
        before = read_json(marker) if marker.is_file() else {}
    except InputError:
        before = {}
    found = {}
    for name, state in wanted.items():
        for path in (folder / f"{name}.jpg", folder / f"{name}.png"):
            if not path.is_file():
                continue
            if isinstance(before, dict) and before.get(name) == state:
                found[name] = path
                continue
            try:
                path.unlink()
            except OSError as error:
                raise OutputError(f"cannot replace {path}: {first_line(error)}; choose another --out folder") from error
    write_json(marker, wanted)
    return found


def stored_cameras(capture: Capture) -> tuple[list[Intrinsics], Array]:
    """Intrinsics and (N, 4, 4) world_from_camera of a posed capture's frames, for the pixels as their files hold them.

    Those of mirrored files stay as they are; `convert_images` writes such images anew.
    """
    turned = turns_by_exif(capture)
    found = [
        as_stored(frame.intrinsics, frame.world_from_camera, orientation_of(frame.image) if turned else 1)
        for frame in capture.frames
        if frame.intrinsics is not None and frame.world_from_camera is not None
    ]
    return [camera for camera, _ in found], np.array([pose for _, pose in found], dtype=np.float64).reshape(-1, 4, 4)


def as_stored(camera: Intrinsics, world_from_camera: Array, orientation: int) -> tuple[Intrinsics, Array]:
    """The camera of an upright image, for the file that EXIF `orientation` turns into it: x_stored = R · x_upright about the axis.

    A lens keeps its radial terms; the tangential ones are a vector across the image, (p2, p1), and turn with it.
    """
    if orientation not in TURNS:
        return camera, world_from_camera
    cosine, sine = TURNS[orientation]
    turn = np.array([[cosine, sine], [-sine, cosine]], dtype=np.float64)
    width, height = (camera.height, camera.width) if sine else (camera.width, camera.height)
    fx, fy = (camera.fy, camera.fx) if sine else (camera.fx, camera.fy)
    cx, cy = turn @ [camera.cx - camera.width / 2, camera.cy - camera.height / 2] + [width / 2, height / 2]
    lens = camera.distortion
    if camera.lens != FISHEYE and len(lens) >= 4:
        p2, p1 = turn @ [lens[3], lens[2]]
        lens = (*lens[:2], float(p1), float(p2), *lens[4:])
    pose = np.array(world_from_camera, dtype=np.float64)
    pose[:3, :2] = pose[:3, :2] @ turn.T
    return replace(camera, width=width, height=height, fx=fx, fy=fy, cx=float(cx), cy=float(cy), distortion=lens), pose
