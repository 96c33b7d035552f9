"""Pictures as an mp4 video, through OpenCV's FFmpeg writer."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np

from toolkit.camera import Array
from toolkit.errors import InputError, OutputError
from toolkit.files import atomic_path
from toolkit.tsdf.mesh import as_bytes

# In order of preference. The pip wheels of OpenCV carry no H.264 encoder; VP9 in mp4 is what browsers play, at some tenths of a second a
# picture; MPEG-4 part 2 is everywhere, a hundred times as fast, and plays in desktop players only.
CODECS = ("vp09", "mp4v")
PROBE = 2**16  # bytes


def write_video(path: Path | str, frames: Iterable[Array], fps: float = 30.0, codec: str = "auto") -> str:
    """Write (H, W, 3) RGB pictures (uint8, or floating point 0 to 1) of one size; an odd side is made even by repeating its last pixel.

    Returns:
        the codec used: "vp09" (browsers play it) or "mp4v".

    Raises:
        InputError: no pictures, sizes that differ, or not an .mp4 name.
        OutputError: no codec works, or the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".mp4":
        raise InputError(f"a video is written as .mp4, not {path.suffix or 'without a suffix'}; rename {path.name}")
    pictures = iter(frames)
    first = next(pictures, None)
    if first is None:
        raise InputError(f"there are no pictures to write to {path}")
    shape = np.asarray(first).shape
    with atomic_path(path) as temporary:
        temporary.touch()  # OpenCV's writer cannot say why a file cannot be made; this can
        writer, used = _open(temporary, shape, fps, CODECS if codec == "auto" else (codec,))
        try:
            count = _write(writer, first, shape, path)
            for picture in pictures:
                count += _write(writer, picture, shape, path)
        finally:
            writer.release()
        # OpenCV drops pictures without a word when the disk is full; a video that does not hold them all is not kept.
        if frame_count(temporary) != count:
            raise OutputError(f"the video {path} could not be written whole; free space or choose another --out folder")
    return used


def frame_count(path: Path) -> int:
    """Frames that a video's header promises, 0 when it cannot be opened."""
    reader = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        return int(reader.get(cv2.CAP_PROP_FRAME_COUNT)) if reader.isOpened() else 0
    finally:
        reader.release()


def _open(path: Path, shape: tuple[int, ...], fps: float, codecs: Iterable[str]) -> tuple[cv2.VideoWriter, str]:
    size = (shape[1] + shape[1] % 2, shape[0] + shape[0] % 2)
    for codec in codecs:
        writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*codec), fps, size)
        if writer.isOpened():
            return writer, codec
        writer.release()
    path.write_bytes(bytes(PROBE))  # a full disk is no fault of the codec, and this says what it is
    raise OutputError("this OpenCV writes no mp4 videos; `pip install --force-reinstall opencv-contrib-python-headless` helps")


def _write(writer: cv2.VideoWriter, picture: Array, shape: tuple[int, ...], path: Path) -> int:
    picture = as_bytes(picture)
    if picture.shape != shape or picture.ndim != 3 or shape[2] != 3:
        raise InputError(f"the pictures for {path.name} have the shapes {shape} and {picture.shape}; all must be alike, (H, W, 3)")
    height, width = shape[:2]
    if height % 2 or width % 2:
        picture = np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
    writer.write(cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
    return 1
