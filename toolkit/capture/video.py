"""Videos: what one holds, and an iterator over its frames, upright and in RGB."""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

# FFmpeg inside OpenCV reads this when the first video is opened; -8 is its "quiet". Damaged videos are reported by us, once.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")

import cv2
import numpy as np

from fieldfuse.camera import Array
from fieldfuse.capture.headers import end_of_boxes
from fieldfuse.capture.sens import is_sens, iterate_sens
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.errors import InputError
from fieldfuse.files import require_utf8

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".3gp", ".mts", ".wmv")
UNCOUNTED = (".mkv", ".webm")  # their headers have no number of frames: what is announced is their length times their rate
SQUARE = 0.01  # difference of a pixel's sides that is nothing
MOST_FRAMES = 2_000_000  # eighteen hours at 30 a second
SMALLEST_FRAME = 8  # bytes
OPENING = threading.Lock()  # one video is opened at a time: what OpenCV reads of the environment then is the whole process's
_OPTIONS, _EVERY_FRAME = "OPENCV_FFMPEG_CAPTURE_OPTIONS", "ignore_editlist;1"


def read_video(path: Path, *, as_stored: bool = False) -> Capture:
    """Describe a video: one `Frame` for each frame it announces, cameras and poses unknown.

    Only the header and the first frame are decoded; the announced number of frames is not a promise, `iterate_video` yields
    what can really be read. Frames are upright: rotation metadata is applied by the decoder, and is in `extra["rotation"]` for
    information. `extra` also has `fps`, `width`, `height` (upright) and `seconds`.

    `as_stored` is for videos whose frames were noted down one by one while they were taken: frames are then as they were written, not
    turned, and those count too that the file's edit list hides from a player.

    Raises:
        InputError: no such file, not a video, cut short, or no frame can be decoded.
    """
    path = Path(path).resolve()
    _check_container(path)
    stream = _open(path, as_stored)
    try:
        ok, first = stream.read()
        if not ok or first is None:
            raise InputError(
                f"not one frame of the video {path} can be decoded; convert it (for instance with ffmpeg to H.264 mp4) and try again"
            )
        announced = stream.get(cv2.CAP_PROP_FRAME_COUNT)
        fps = stream.get(cv2.CAP_PROP_FPS)
        rotation = stream.get(cv2.CAP_PROP_ORIENTATION_META)
        across, down = stream.get(cv2.CAP_PROP_SAR_NUM), stream.get(cv2.CAP_PROP_SAR_DEN)
        # A header may announce anything; what a file of this size cannot hold, or nobody would film, is counted instead.
        if math.isfinite(announced) and 0 < announced <= min(path.stat().st_size // SMALLEST_FRAME, MOST_FRAMES):
            count = int(announced)
        else:
            count = 1
            while stream.grab():
                count += 1
    finally:
        stream.release()
    warnings = []
    if across > 0 and down > 0 and abs(across / down - 1) > SQUARE:
        warnings.append(
            f"the pixels of the video {path.name} are not square ({across:g}:{down:g}) and are taken as if they were, so that all is "
            f"stretched; make them square first: ffmpeg -i {path.name} -vf scale=iw*sar:ih,setsar=1 new.mp4"
        )
    fps = float(fps) if math.isfinite(fps) and 0 < fps < 1e4 else 0.0
    frames = tuple(Frame(name=f"frame_{index:06d}", image=path, video_index=index, as_stored=as_stored) for index in range(count))
    extra = {
        "fps": fps,
        "rotation": int(rotation) % 360 if math.isfinite(rotation) else 0,
        "width": int(first.shape[1]),
        "height": int(first.shape[0]),
        "seconds": count / fps if fps else None,
    }
    return Capture(kind="video", root=path.parent, frames=frames, ordered=True, extra=extra, warnings=tuple(warnings))


def iterate_video(path: Path, indices: Collection[int] | None = None, *, as_stored: bool = False) -> Iterator[tuple[int, Array]]:
    """Decode a video from its start and yield (index, image), image (H, W, 3) uint8 RGB, upright (or `as_stored`, see `read_video`).

    Frames are counted in decoding order rather than sought by time, so an index always means the same image. With `indices`
    only those are converted and yielded, and decoding ends after the last of them. A `.sens` file is a video too.
    """
    if is_sens(Path(path)):
        yield from iterate_sens(Path(path), indices)
        return
    wanted = None if indices is None else set(indices)
    last = -1 if wanted is None else max(wanted, default=-1)
    stream = _open(Path(path), as_stored)
    try:
        index = 0
        while (wanted is None or index <= last) and stream.grab():
            if wanted is None or index in wanted:
                ok, image = stream.retrieve()
                if not ok or image is None:
                    break
                channels = 1 if image.ndim == 2 else image.shape[2]
                code = {1: cv2.COLOR_GRAY2RGB, 4: cv2.COLOR_BGRA2RGB}.get(channels, cv2.COLOR_BGR2RGB)
                yield index, np.asarray(cv2.cvtColor(image, code))
            index += 1
    finally:
        stream.release()


def _open(path: Path, as_stored: bool = False) -> cv2.VideoCapture:
    require_utf8(path)  # OpenCV would end the process
    # FFmpeg only: other backends would take a single image, or a name with "%03d", for a video.
    with OPENING, _options(as_stored):
        level = cv2.utils.logging.getLogLevel()
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        try:
            stream = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
        finally:
            cv2.utils.logging.setLogLevel(level)
    if not stream.isOpened():
        stream.release()
        raise InputError(
            f"{path} is not a video that can be read; give an mp4, mov, avi or mkv file (one that was not cut off while copying)"
        )
    # The one place where rotation metadata is applied: the decoder turns each frame before it hands it out.
    stream.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0 if as_stored else 1)
    return stream


@contextmanager
def _options(every_frame: bool) -> Iterator[None]:
    """FFmpeg's options while a video is opened, which OpenCV takes from the environment only. Other options there stay."""
    before = os.environ.get(_OPTIONS)
    if every_frame:
        os.environ[_OPTIONS] = f"{before}|{_EVERY_FRAME}" if before else _EVERY_FRAME
    try:
        yield
    finally:
        if every_frame and before is None:
            del os.environ[_OPTIONS]
        elif every_frame and before is not None:
            os.environ[_OPTIONS] = before


# --------------------------------------------------------------------------------------------- is the file whole


def _check_container(path: Path) -> None:
    """Refuse what is no file, empty, a playlist, or shorter than its container announces.

    A cut-off video often opens, announces all its frames and stops half-way, so the sizes in the container are compared with
    the file's: the boxes of mp4 and mov, the RIFF header of avi, the segment of Matroska.
    """
    if not path.is_file():
        raise InputError(f"there is no video {path}; check the name")
    size = path.stat().st_size
    if size == 0:
        raise InputError(f"the video {path} is empty (0 bytes); copy it again from the camera")
    expected = None
    try:
        with path.open("rb") as file:
            head = file.read(16)
            if head.startswith((b"#EXTM3U", b"ffconcat")):  # text that makes FFmpeg open other files or addresses
                raise InputError(f"{path} is a playlist, not a video; give the video file itself")
            if head[4:8] in (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip", b"pnot"):
                expected = end_of_boxes(file, size)
            elif head[:4] == b"RIFF" and head[8:12] == b"AVI ":
                expected = 8 + int.from_bytes(head[4:8], "little")
            elif head[:4] == b"\x1a\x45\xdf\xa3":
                expected = _end_of_matroska(file)
    except OSError as error:
        raise InputError(f"cannot read the video {path}: {error.strerror or error}") from error
    if expected is not None and expected > size:
        raise InputError(
            f"the video {path} is cut short (it has {size} bytes and announces at least {expected}); copy it again from the camera"
        )


def _end_of_matroska(file: BinaryIO) -> int | None:
    """Where the segment ends (RFC 8794: an element is an id, a size of 1 to 8 bytes, then data), None for live streams."""
    position = 0
    for _ in range(2):  # the EBML header, then the segment that holds everything
        file.seek(position)
        raw = file.read(12)
        if len(raw) < 5 or raw[4] == 0:
            return None
        width = 9 - raw[4].bit_length()
        length = int.from_bytes(raw[4 : 4 + width], "big") & ((1 << (7 * width)) - 1)
        if length == (1 << (7 * width)) - 1:  # all ones: unknown
            return None
        position += 4 + width + length
    return position
