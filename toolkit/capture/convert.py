"""Pictures written once as JPEG. HEIF: it takes ten times as long to decode, which every stage would do again, and few other programs
read it. Photos that EXIF mirrors: no camera could be exported for what their files hold."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import cv2

from fieldfuse.capture.checks import check_capture
from fieldfuse.capture.headers import orientation_of
from fieldfuse.capture.heif import file_is_heif
from fieldfuse.capture.images import read_picture, turns_by_exif, upright
from fieldfuse.capture.listing import counted, unique_names
from fieldfuse.capture.sizes import picture_header
from fieldfuse.capture.stored import MIRRORED
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.errors import InputError, OutputError, first_line
from fieldfuse.files import atomic_path, fingerprint, read_json, write_json
from fieldfuse.progress import SILENT, Progress
from fieldfuse.threads import share

VERSION = 2  # of what is written
QUALITY = 97  # of the JPEG files, as of a video's frames
MOST_AT_ONCE, PIXELS_AT_ONCE = 8, 200e6  # pictures, and their pixels, on their way at a time: a pixel takes about ten bytes
CONVERTED = "converted"  # in `Capture.extra`: how many pictures were
MARKER = "converted.json"  # beside them: what each was made of


def to_convert(capture: Capture) -> list[int]:
    """Indices of the frames whose pictures are HEIF, or photos that are to be mirrored."""
    exif = turns_by_exif(capture)
    return [
        i
        for i, frame in enumerate(capture.frames)
        if frame.video_index is None and (file_is_heif(frame.image) or (exif and orientation_of(frame.image) in MIRRORED))
    ]


def all_converted(capture: Capture) -> bool:
    """Whether every picture is one that `convert_pictures` wrote."""
    return CONVERTED in capture.extra and all((folder / MARKER).is_file() for folder in {frame.image.parent for frame in capture.frames})


def convert_pictures(capture: Capture, out: Path, threads: int, progress: Progress = SILENT) -> Capture:
    """The capture with every picture that `to_convert` names replaced by an upright JPEG (with alpha: PNG) of the same name in
    `out/frames`, in sRGB.

    What is there and is of the same file is not written again, so a killed run goes on where it stopped.

    Returns:
        the capture, checked; `extra["converted"]` counts the pictures.

    Raises:
        InputError: a picture is damaged, or the capture is unusable (see `check_capture`).
        OutputError: a picture cannot be written.
    """
    indices = to_convert(capture)
    folder = Path(out) / "frames"
    names = unique_names([capture.frames[i].image for i in indices])
    done = _still_good(folder, {name: fingerprint(VERSION, capture.frames[i].image) for name, i in zip(names, indices, strict=True)})
    finished = 0

    def convert(one: tuple[str, int]) -> tuple[int, Path]:
        nonlocal finished
        name, index = one
        progress.check()
        path = done.get(name) or write_picture(capture.frames[index].image, folder / name)
        finished += 1
        progress.update(finished, len(indices), f"{finished} of {counted(len(indices), 'picture')} as JPEG")
        return index, path

    largest = max((math.prod(picture_header(capture.frames[i].image).size) for i in indices), default=1)
    at_once = max(1, min(threads, MOST_AT_ONCE, int(PIXELS_AT_ONCE / largest)))
    written = dict(share(convert, list(zip(names, indices, strict=True)), at_once))
    frames = tuple(_with_picture(frame, written.get(i)) for i, frame in enumerate(capture.frames))
    return check_capture(replace(capture, frames=frames, extra={**capture.extra, CONVERTED: len(indices)}), progress)


def write_picture(source: Path, target: Path) -> Path:
    """A picture, upright, as `target` with `.jpg` added, or `.png` where it has alpha; which of the two is told.

    Raises:
        InputError: it cannot be decoded.
        OutputError: it cannot be written.
    """
    picture = upright(*read_picture(source))
    alpha = picture.shape[2] == 4
    path = target.with_name(f"{target.name}.{'png' if alpha else 'jpg'}")
    order = cv2.COLOR_RGBA2BGRA if alpha else cv2.COLOR_RGB2BGR
    coded, data = cv2.imencode(path.suffix, cv2.cvtColor(picture, order), [] if alpha else [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    if not coded:
        raise OutputError(f"the picture {source} cannot be encoded as {path.suffix[1:].upper()}; convert it by another program")
    with atomic_path(path) as temporary:
        temporary.write_bytes(data.tobytes())
    return path


def _still_good(folder: Path, wanted: dict[str, str]) -> dict[str, Path]:
    """Of the pictures wanted (name → state of its source) those that an earlier attempt left there; what it left of other sources is
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


def _with_picture(frame: Frame, path: Path | None) -> Frame:
    return frame if path is None else replace(frame, image=path.resolve())
